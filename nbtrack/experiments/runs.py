"""Results on disk: where commands may write, the files of finished runs, and means over rooms.

Nothing is written into a recording, and nothing over files that nbtrack did not write.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.special import ndtri, stdtrit

from nbtrack.beyond.verdict import score_detection
from nbtrack.machinery import files
from nbtrack.machinery.errors import ConfigError, MissingError
from nbtrack.machinery.inputs import read_object
from nbtrack.mapping.files import HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.plots.style import in_house_style
from nbtrack.recordings.formats import holds_recording
from nbtrack.recordings.pose_files import read_tum, shifted, tum_text
from nbtrack.tracking.metrics import trajectory_metrics
from nbtrack.tracking.trajectories import Trajectory

METRICS_FILE = "metrics.json"  # written last: where it stands, a run is complete
OVERVIEW_FILE = "overview.png"
CHECK_FILE = "check.png"
MARK = ".nbtrack"
"""An empty file in every folder given with --out, where nbtrack may replace its results."""
# The last one of each tells that the others are there.
FILES_OF_RUN = ("trajectory.txt", "groundtruth.txt", "frames.csv", OVERVIEW_FILE, METRICS_FILE)
FILES_OF_MAP = (HISTORY_FILE, MESH_FILE, MAP_FILE)
_RESULTS = (*FILES_OF_RUN, *FILES_OF_MAP, CHECK_FILE, "table_[123]*")


def is_own_output(folder: Path) -> bool:
    """Whether nbtrack has written results into a folder."""
    return (folder / MARK).exists()


def prepare(folder: Path | None) -> None:
    """Mark a folder, before the work, as one for nbtrack's results. For None nothing is done.

    Raises ConfigError where it holds a recording, or files of somebody else that are named like
    results; OSError where nothing can be written.
    """
    if folder is None:
        return
    check_no_recording(folder)
    foreign = [path.name for name in _RESULTS for path in sorted(folder.glob(name))]
    if foreign and not is_own_output(folder):
        raise ConfigError(f"{folder} has a {foreign[0]} that may not be nbtrack's: move it away")
    files.write_atomic(folder / MARK, "")


def deliver(cached: Path, names: Sequence[str], folder: Path | None) -> Path:
    """Copy a result's files from the cache to a folder, if one is given.

    Returns the folder where the result then is. A file that an earlier result left there, and that
    this one lacks, is removed. The last of `names` is written last, as the sign that all are there.
    """
    if folder is None:
        return cached
    contents = {}
    for name in names:
        path = cached / name
        contents[name] = path.read_bytes() if path.is_file() else None
    files.write_together(folder, contents)
    return folder


def check_no_recording(path: Path) -> None:
    """Raises ConfigError if a path that is to be written is a recording, or lies within one."""
    for folder in (path, *files.resolved(path).parents):
        if folder.is_dir() and holds_recording(folder):
            raise ConfigError(f"{folder} holds a recording, where nothing is written: take another")


def save_picture(figure: Figure, path: Path, dpi: float | str = "figure") -> None:
    """Writes a figure as a PNG, by default with the dots per inch of the figure itself."""
    content = io.BytesIO()
    with in_house_style():
        figure.savefig(content, dpi=dpi)
    files.write_atomic(path, content.getvalue())


def write_run(folder: Path, run: Trajectory) -> None:
    """Writes the files of a finished run.

    Its poses are relative to the origin that its metrics name, those in the files are in the world
    of the recording. `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without
    a first one whose pose was given: so public tools report the error of the paper's formula. Where
    no true pose is known there is no `groundtruth.txt`.
    """
    times, origin = run.frames["time"].to_numpy(), np.array(run.metrics["origin"])
    texts = {
        "trajectory.txt": tum_text(times, shifted(run.T_estimated, origin)),
        "groundtruth.txt": tum_text(times, shifted(run.T_true, origin)),
        "frames.csv": run.frames.to_csv(index=False),
        METRICS_FILE: files.json_text(run.metrics),
    }
    if "ate_rmse_m" not in run.metrics:
        del texts["groundtruth.txt"]
    files.write_together(folder, texts)


def read_trajectory(folder: Path) -> Trajectory:
    """A finished run from its folder, its poses relative to the map's origin, as in tracking.

    Raises MissingError if there is none.
    """
    if not (folder / METRICS_FILE).is_file():
        raise MissingError(f"no finished run in {folder}: give a folder that `track` wrote")
    times, T_estimated = read_tum(folder / "trajectory.txt")
    T_true = np.full_like(T_estimated, np.nan)
    truth = folder / "groundtruth.txt"
    if truth.is_file():
        times_known, T_known = read_tum(truth)
        T_true[np.searchsorted(times, times_known)] = T_known  # in the rows of the same times
    metrics = read_object(folder / METRICS_FILE)
    with files.naming_damaged(folder / "frames.csv", "table of frames", "track again"):
        frames = pd.read_csv(folder / "frames.csv")
        if len(frames) != len(T_estimated):
            raise ValueError(f"{len(frames)} rows for {len(T_estimated)} poses")
    back = -np.array(metrics.get("origin", [0, 0, 0]))
    return Trajectory(shifted(T_estimated, back), shifted(T_true, back), frames, metrics)


def scores_of(tracked: Trajectory) -> dict[str, Any]:
    """Errors of a run, how well the tracker's own verdicts tell them, and its speed.

    Verdicts, the column `lost`, are compared in frames with a true pose only.
    """
    rows = tracked.frames
    metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
    if "lost" in rows:
        rated = rows.dropna(subset="translation_error_m")
        errors_m = rated["translation_error_m"].to_numpy()
        metrics["flagged_frames"] = int(rated["lost"].sum())
        metrics |= score_detection(rated["lost"].to_numpy(dtype=bool), errors_m)
    steps = int(rows["steps"].sum())
    seconds = rows["seconds"]
    return {
        **metrics,
        "frames_without_depth": int(rows["without_depth"].sum()),
        "steps_per_frame": steps / len(rows),
        "seconds_per_step": float(seconds.sum()) / max(steps, 1),
        "seconds_per_frame": float(seconds.mean()),
    }


def over_rooms(results: pd.DataFrame, by: list[str], value: str = "ate_m") -> pd.DataFrame:
    """Geometric mean of a positive column by groups, and its 95 % interval: columns `from`, `to`.

    A room counts once, with the mean of its seeds' logarithms: rooms differ more than seeds do.
    The interval is Student's, of the means of the rooms' logarithms, and NaN for a single room (our
    choice).
    """
    logarithms = np.log(results.set_index([*by, "scene"])[value])
    of_rooms = logarithms.groupby([*by, "scene"], sort=False).mean()
    groups = of_rooms.groupby(by, sort=False)
    mean, half = groups.mean(), groups.sem() * stdtrit(groups.size() - 1, 0.975)
    return np.exp(pd.DataFrame({value: mean, "from": mean - half, "to": mean + half})).reset_index()


def shares(results: pd.DataFrame, by: list[str], value: str) -> pd.DataFrame:
    """Share (%) of rows whose value is true, by groups, and its 95 % interval: `from`, `to` (%).

    The interval is Wilson's (1927), as if rows were independent. Columns `true` and `size` count.
    """
    groups = results.groupby(by, sort=False, observed=True)[value]
    true, size, z = groups.sum(), groups.size(), ndtri(0.975)
    middle = (true + z**2 / 2) / (size + z**2)
    half = z / (size + z**2) * np.sqrt(true * (size - true) / size + z**2 / 4)
    columns = {value: true / size, "from": middle - half, "to": middle + half}
    return (100 * pd.DataFrame(columns).clip(0, 1)).assign(true=true, size=size).reset_index()
