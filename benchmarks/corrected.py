"""Tracking in corrected maps: accuracy and time.

    python benchmarks/corrected.py [RECORDING ...]
    python benchmarks/corrected.py fast

The first writes tracking.csv, times.csv, agreement.csv and odd_frames.csv to
paper_tables/corrected, the second fast.csv.
RECORDING is a folder in the dataset's layout. The paper's methods and `agreement` are computed for
the first one alone. Times are measured: run nothing else.
"""

import sys
import time
from datetime import UTC, datetime
from itertools import combinations, product

import numpy as np
import pandas as pd
import torch
from motions import HAND_HELD

from nbtrack import METHODS, load_preset, make_tracker, open_scene, open_scenes, read_run
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.grid import Execution, map_scene, run_jobs, track_scenes
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.methods import TABLE_1
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.machinery.device import choose_device, device_name
from nbtrack.machinery.files import tables_folder
from nbtrack.machinery.settings import with_settings
from nbtrack.tables import write_csv
from nbtrack.tracking import StepBudget, Tracker

ALONE = Execution(workers=1)
COMPARED = [
    METHODS[name]
    for name in (
        "baked", "corrected_sparse", "corrected", "corrected_dense", "neus_corrected",
        "grid_corrected", "icp", "icp_middle", "icp_dense",
    )
]  # fmt: skip
# The paper's methods run in a recording alone. Their learning rates are in the map's units, as in
# Table I.
IN_UNITS = "tracking.vr.position_unit=map", "tracking.sdf.position_unit=map"
ON_RECORDINGS = [method for method in COMPARED if method != METHODS["neus_corrected"]]
SEEDS = range(3)  # of map and tracker
COLUMNS = [
    "frames", "path", "scene", "method", "n_pixels", "seed", "ate_m", "still_ate_m", "max_error_m",
    "lost_frames", "seconds_per_frame", "steps_per_frame", "map_seconds", "median_error_m",
    "wrong_frames", "longest_wrong", "called_lost", "missed_frames", "frames_lost_in_vain",
]  # fmt: skip
SAID = [
    "frame_id", "translation_error_m", "rotation_error_deg", "fitting_ratio", "known_ratio",
    "intensity_ratio", "innovation", "position_std_m", "last_step", "p_lost",
]  # fmt: skip
WRONG_M = 0.05  # a pose in a room, whose truth is known, is wrong if its error is larger
WRONG_IN_RECORDING_M = 0.2  # larger in a recording, whose reference poses are off, too


def main() -> None:
    """Measure and write everything."""
    torch.set_num_threads(1)
    if sys.argv[1:] == ["fast"]:
        write_rows("fast.csv", fast())
        return
    preset = load_preset("smoke", settings=[*HAND_HELD, *IN_UNITS])
    second = with_settings(preset, "scenes.seed=1")
    rooms, elsewhere = open_scenes(preset), open_scenes(second)
    recordings = [open_scene(folder, preset) for folder in sys.argv[1:]]
    runs = []
    for tracked, path in ((rooms, "mapped"), (elsewhere, "second")):
        for frames in (":", "::4"):
            runs.append(_track(rooms, COMPARED, preset, frames, path, tracked))
    write_rows("tracking.csv", pd.concat(runs))
    write_rows("times.csv", frame_times(rooms, preset))
    for recording in recordings:
        for frames in (":", "::2", "::4"):
            how = preset, frames, "mapped"
            runs.append(_track([recording], ON_RECORDINGS, *how))
            if recording is recordings[0]:
                runs.append(_track([recording], TABLE_1, *how, steps=None, seeds=SEEDS[:1]))
        runs += [_held_out(recording, preset, seed) for seed in SEEDS]
        write_rows("tracking.csv", pd.concat(runs))
    if recordings:
        write_rows("agreement.csv", agreement(recordings[0], preset))
        write_rows("odd_frames.csv", odd_frames(pd.concat(runs)))


def _track(scenes, methods, preset, frames, path, tracked=None, steps=30, seeds=SEEDS):
    """Rows of runs with at most `steps` steps a frame; with None, the paper's steps at 2 Hz.

    `scenes` are mapped. `tracked` are tracked in their maps; with None, these are `scenes`, too.
    """
    how = {"steps": steps, "frames": frames, "seeds": seeds, "execution": ALONE}
    rates_hz = [2] if steps is None else None
    found = track_scenes(scenes, methods, preset, rates_hz, tracked=tracked, **how)
    wrong_m = WRONG_M if scenes[0].room else WRONG_IN_RECORDING_M
    counts = pd.DataFrame([_judged(run, wrong_m) for run in found["run"]])
    return found.assign(path=path, frames=frames, **counts)[[*COLUMNS, "run"]]


def _judged(run: str, wrong_m: float) -> dict[str, float]:
    """The median error of a run, and how many of its frames are wrong or called lost.

    A frame is wrong if it is off by more than `wrong_m`. Wrong frames that are not called lost are
    missed, and right frames that are called lost are lost in vain. The paper's methods have no
    verdict, so that none of their frames is called lost.
    """
    frames = read_run(run).frames
    is_wrong = (frames["translation_error_m"] > wrong_m).to_numpy()
    is_lost = frames["lost"].to_numpy(bool) if "lost" in frames else np.zeros_like(is_wrong)
    stretches = np.split(is_wrong, np.flatnonzero(np.diff(is_wrong)) + 1)
    return {
        "median_error_m": float(frames["translation_error_m"].median()),
        "wrong_frames": int(is_wrong.sum()),
        "longest_wrong": max(int(stretch.sum()) for stretch in stretches),
        "called_lost": int(is_lost.sum()),
        "missed_frames": int((is_wrong & ~is_lost).sum()),
        "frames_lost_in_vain": int((is_lost & ~is_wrong).sum()),
    }


def frame_times(rooms, preset) -> pd.DataFrame:
    """Medians of a frame's milliseconds and error, for LM and ICP, in turns on the same frames."""
    rows = []
    for room, n_pixels in product(rooms, (512, 2048, 4096)):
        sequence, trackers = room.read(":120"), {}
        for method in (METHODS["corrected"], METHODS["icp"]):
            drawn = f"tracking.{method.tracker}.n_pixels={n_pixels}"
            changed = with_settings(preset, *method.settings, drawn)
            field = map_scene(room, method.field, changed).field
            settings = changed.tracking_of(method.tracker)
            how = field, sequence.T_world_camera[0], StepBudget(30), settings
            trackers[method.label] = make_tracker(method.tracker, *how), sequence
        rows.append(in_turns(trackers).assign(scene=room.name, n_pixels=n_pixels))
    kept = ["scene", "method", "n_pixels"], ["milliseconds", "error_m"]
    return pd.concat(rows).groupby(kept[0])[kept[1]].median().reset_index()


def in_turns(runs: dict[str, tuple[Tracker, RgbdSequence]]) -> pd.DataFrame:
    """Track every frame but the first by each tracker in turn, on sequences of equal length.

    A machine that slows down then slows all trackers alike. Returns a row for each frame and
    method: milliseconds, without the reading of files, and the position's error (m).
    """
    rows = []
    n_frames = {len(sequence) for _, sequence in runs.values()}
    for index, (name, (tracker, sequence)) in product(range(1, min(n_frames)), runs.items()):
        frame, start = sequence[index], time.perf_counter()
        found = tracker.track(frame)
        milliseconds = 1000 * (time.perf_counter() - start)
        off = found.T_world_camera[:3, 3] - sequence.T_world_camera[index, :3, 3]
        rows.append((name, milliseconds, float(np.linalg.norm(off))))
    return pd.DataFrame(rows, columns=["method", "milliseconds", "error_m"])


def fast() -> pd.DataFrame:
    """Runs in nine rooms on a path that was not mapped, at every fourth and every eighth frame."""
    preset, second = (
        load_preset("nine_rooms", settings=[*HAND_HELD, f"scenes.seed={n}"]) for n in (0, 1)
    )
    rooms, elsewhere = open_scenes(preset), open_scenes(second)
    methods = [method for method in ON_RECORDINGS if method != METHODS["baked"]]
    runs = [_track(rooms, methods, preset, f"::{n}", "second", elsewhere) for n in (4, 8)]
    return pd.concat(runs)


def odd_frames(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows of frames that LM's map left out: errors, and the numbers of LM's report."""
    runs = runs[(runs["frames"] == "1::2") & (runs["method"] == METHODS["corrected"].label)]
    tables = []
    for run in runs.itertuples():
        tables.append(read_run(run.run).frames[SAID].assign(scene=run.scene, seed=run.seed))
    return pd.concat(tables)


def agreement(scene, preset) -> pd.DataFrame:
    """RMS distances (m) between all paths: of LM and ICP with two seeds, and the reference."""
    methods, seeds = [METHODS["corrected_dense"], METHODS["icp_dense"]], [0, 1]
    how = {"steps": 30, "frames": ":", "seeds": seeds}
    found = track_scenes([scene], methods, preset, **how, execution=ALONE)
    runs = {f"{row.method}, seed {row.seed}": read_run(row.run) for row in found.itertuples()}
    paths = {name: run.T_estimated[:, :3, 3] for name, run in runs.items()}
    paths["reference"] = read_run(found["run"].iloc[0]).T_true[:, :3, 3]
    rows = [
        (a, b, float(np.sqrt(np.mean(np.sum((paths[a] - paths[b]) ** 2, axis=-1)))))
        for a, b in combinations(paths, 2)
    ]
    return pd.DataFrame(rows, columns=["path", "other", "apart_m"]).assign(scene=scene.name)


def _held_out(scene, preset, seed: int) -> pd.DataFrame:
    """Rows of runs in maps of the even frames, tracked at the odd ones."""
    rows = []
    for method in ON_RECORDINGS:
        changed = with_settings(preset, *method.settings)
        made = MapJob.of(scene, method.field, changed, "::2", seed)
        settings = changed.tracking_of(method.tracker)
        job = TrackJob(made, scene, method.tracker, settings, 30, frames="1::2", seed=seed)
        (found,) = run_jobs([job], ALONE)
        row = {name: found[name] for name in COLUMNS if name in found}
        row |= {"ate_m": found["ate_rmse_m"], "method": method.label}
        row |= {"n_pixels": settings.n_pixels, **_judged(job.folder.name, WRONG_IN_RECORDING_M)}
        row |= {"scene": scene.name, "frames": "1::2", "path": "odd, mapped even"}
        rows.append({**row, "run": job.folder.name})
    return pd.DataFrame(rows)[[*COLUMNS, "run"]]


def write_rows(name: str, rows: pd.DataFrame) -> None:
    """Write rows with machine and date to a CSV in paper_tables/corrected."""
    made = {"device": device_name(choose_device()), "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    rows = rows.drop(columns="run", errors="ignore")
    write_csv(tables_folder() / "corrected" / name, rows.assign(**made))


if __name__ == "__main__":
    main()
