"""Results on disk: where commands may write, the files of finished runs, and means over rooms.

nbtrack writes nothing into a recording, and overwrites only files that it has written itself.
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
from nbtrack.machinery.errors import ConfigError, MissingError, check_argument
from nbtrack.machinery.inputs import read_object
from nbtrack.mapping.files import HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.plots.style import in_house_style
from nbtrack.recordings.formats import holds_recording
from nbtrack.recordings.pose_files import read_tum, shifted, tum_text
from nbtrack.tracking.metrics import trajectory_metrics
from nbtrack.tracking.trajectories import Trajectory

METRICS_FILE = "metrics.json"  # written last: a run is complete if this file is there
OVERVIEW_FILE = "overview.png"
CHECK_FILE = "check.png"
MARK = ".nbtrack"
"""An empty file in every folder that was given with --out: nbtrack may replace its results there.
"""
# The last file of each is written last, as the sign that the others are there.
FILES_OF_RUN = ("trajectory.txt", "groundtruth.txt", "frames.csv", OVERVIEW_FILE, METRICS_FILE)
FILES_OF_MAP = (HISTORY_FILE, MESH_FILE, MAP_FILE)
# What exports use of a run: columns of its frames, and entries of its metrics.
_COLUMNS = ["frame_id", "time", "translation_error_m", "without_depth"]
_ENTRIES = dict.fromkeys(("map", "map_key", "recording", "recording_key", "scene", "tracker"), str)
_ENTRIES |= {"format": str | None, "origin": tuple[float, float, float]}
_RESULTS = (*FILES_OF_RUN, *FILES_OF_MAP, CHECK_FILE, "table_[123]*")


def is_own_output(folder: Path) -> bool:
    """Whether a folder is marked as one into which nbtrack writes results."""
    return (folder / MARK).exists()


def prepare(folder: Path | None) -> None:
    """Mark a folder as one for nbtrack's results, before any work. None means no folder.

    Raises ConfigError if it is a file, if it holds a recording, or if it is not marked yet and
    holds files with the names of results; OSError if nothing can be written.
    """
    if folder is None:
        return
    check_no_recording(folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder} is a file: --out takes a folder")
    foreign = [path.name for name in _RESULTS for path in sorted(folder.glob(name))]
    if foreign and not is_own_output(folder):
        raise ConfigError(f"{folder} has a {foreign[0]} that may not be nbtrack's: move it away")
    files.write_atomic(folder / MARK, "")


def deliver(cached: Path, names: Sequence[str], folder: Path | None) -> Path:
    """Copy the files of a result from the cache to a folder, if one is given.

    Returns the folder that then holds the result. A file that this result lacks is removed: an
    earlier result may have left it there. The last of `names` is written last, as the sign that all
    are there.
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
    """Raises ConfigError if a path to be written is a recording's folder or lies within one."""
    for folder in (path, *files.resolved(path).parents):
        if folder.is_dir() and holds_recording(folder):
            raise ConfigError(f"{folder} holds a recording, where nothing is written: take another")


def save_picture(figure: Figure, path: Path, dpi: float | str = "figure") -> None:
    """Writes a figure as a PNG file; `dpi` are dots per inch, by default those of the figure."""
    content = io.BytesIO()
    with in_house_style():
        figure.savefig(content, dpi=dpi)
    files.write_atomic(path, content.getvalue())


def write_run(folder: Path, run: Trajectory) -> None:
    """Writes the files of a finished run.

    Poses of `run` are relative to the origin in its metrics; poses in the files are in the world of
    the recording. `trajectory.txt` and `groundtruth.txt` are in TUM format. They leave out a first
    frame whose pose was given, so that public tools report the error of the paper's formula. If no
    true pose is known, there is no `groundtruth.txt`.
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
    """Read a finished run from its folder; its poses are relative to the map's origin.

    Raises MissingError if there is none, and DataError if its files are damaged.
    """
    if not (folder / METRICS_FILE).is_file():
        raise MissingError(f"no finished run in {folder}: give a folder that `track` wrote")
    with files.naming_damaged(folder, "run", "track again"):
        times, T_estimated = read_tum(folder / "trajectory.txt")
        T_true = np.full_like(T_estimated, np.nan)
        truth = folder / "groundtruth.txt"
        if truth.is_file():
            times_known, T_known = read_tum(truth)
            T_true[np.searchsorted(times, times_known)] = T_known  # rows of the same times
        frames = pd.read_csv(folder / "frames.csv")
        frames[_COLUMNS].astype(float)  # raises for other columns
        # pandas numbers the rows, but not if they have more entries than the header.
        if not frames.index.equals(pd.RangeIndex(len(T_estimated))):
            raise ValueError("frames.csv has no row of its columns for each pose")
        metrics = read_object(folder / METRICS_FILE)
        for name, kind in _ENTRIES.items():
            check_argument(f"{name} in {folder / METRICS_FILE}", metrics[name], kind)
        to_origin = -np.array(metrics["origin"])
    return Trajectory(shifted(T_estimated, to_origin), shifted(T_true, to_origin), frames, metrics)


def scores_of(tracked: Trajectory) -> dict[str, Any]:
    """The errors of a run, its speed, and how well the tracker told which frames were lost.

    What the tracker told is the column `lost`, which not all trackers have. `flagged_frames` counts
    it in all frames; it is compared with the errors in those with a true pose.
    """
    rows = tracked.frames
    metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
    if "lost" in rows:
        rated = rows.dropna(subset="translation_error_m")  # the frames with a true pose
        errors_m = rated["translation_error_m"].to_numpy()
        metrics["flagged_frames"] = int(rows["lost"].sum())
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
    """Geometric mean over rooms of a positive column, for groups of rows, and its 95 % interval.

    `results` has a row for each run, with a column `scene`; rows with equal values in the columns
    `by` are a group. Rows without a value count nowhere. Returns a row for each group with the
    columns `by`, `value`, `from` and `to`.

    Each room counts once, by the mean over its seeds, since rooms differ more than seeds do. Means
    and the interval, Student's over rooms, are of logarithms (our choice). The interval is NaN for
    a single room.
    """
    logarithms = np.log(results.set_index([*by, "scene"])[value])
    of_rooms = logarithms.groupby([*by, "scene"], sort=False).mean()
    groups = of_rooms.groupby(by, sort=False)
    mean, half = groups.mean(), groups.sem() * stdtrit(groups.count() - 1, 0.975)  # half the width
    return np.exp(pd.DataFrame({value: mean, "from": mean - half, "to": mean + half})).reset_index()


def shares(results: pd.DataFrame, by: list[str], value: str) -> pd.DataFrame:
    """Share (%) of rows in which the column `value` is true, for groups of rows.

    Rows with equal values in the columns `by` are a group. Returns a row for each group with the
    columns `by`, `value` (the share), `from` and `to` (its 95 % interval, in %), `true` (the number
    of such rows) and `size` (the number of all). The interval is Wilson's (1927), as if rows were
    independent.
    """
    groups = results.groupby(by, sort=False, observed=True)[value]
    true, size, z = groups.sum(), groups.size(), ndtri(0.975)
    middle = (true + z**2 / 2) / (size + z**2)
    half_width = z / (size + z**2) * np.sqrt(true * (size - true) / size + z**2 / 4)
    columns = {value: true / size, "from": middle - half_width, "to": middle + half_width}
    # Rounding errors alone may lead out of [0, 1].
    return (100 * pd.DataFrame(columns).clip(0, 1)).assign(true=true, size=size).reset_index()
