"""Searches in corrected maps: from starts that are off, and without a start.

    python benchmarks/searches.py

Writes searches.csv to paper_tables/corrected: LM from 20 cm and 15° off, without and with
restarts; without a start (`track --start unknown`) on a second path through two rooms and on walks
through nine; and told a pose at another place. Ten minutes on one core. Times count: run nothing
else.
"""

import time

import numpy as np
import pandas as pd
import torch
from basin import find_from_afar
from corrected import WRONG_DEG, WRONG_M, write_rows
from motions import HAND_HELD
from walks import MAPPED
from walks import PRESET as WALKS

from nbtrack import METHODS, Method, load_preset, make_tracker, open_scenes
from nbtrack.core.arrays import Pose
from nbtrack.core.progress import ProgressBar
from nbtrack.core.settings import with_settings
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.grid import run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.tracking import StepBudget
from nbtrack.tracking.metrics import pose_errors

OFF = [(20, 15)]  # cm, degrees
METHODS_OF_SEARCHES = {"": METHODS["corrected_dense"], ", map on grids": METHODS["grid_corrected"]}
N_VIEWS = 50
MAX_STEPS = 1000  # more than there are places to look at


def main() -> None:
    """Measure and write everything."""
    torch.set_num_threads(1)
    preset = load_preset("smoke", settings=HAND_HELD)
    second = open_scenes(with_settings(preset, "scenes.seed=1"))
    rows = []
    for room, other in zip(open_scenes(preset), second, strict=True):
        for n_restarts, steps in ((0, 60), (8, MAX_STEPS)):
            how = {"corrected_dense": steps}, preset, OFF, 100
            afar = find_from_afar(room, *how, n_restarts=n_restarts)
            told = afar["offset"] + (", with restarts" if n_restarts else "")
            rows.append(afar.assign(offset=told, scene=room.name))
        elsewhere = room.read().T_world_camera[-1]
        for grid, method in METHODS_OF_SEARCHES.items():
            for name, T_told in (("no start", None), ("told another place", elsewhere)):
                found = find(room, method, preset, other.read(), T_told)
                rows.append(found.assign(offset=name + grid))
    for room in open_scenes(WALKS):
        unmapped = room.read("2::4")
        found = find(room, METHODS["corrected_dense"], WALKS, unmapped, None, MAPPED)
        rows.append(found.assign(offset="no start, a walk"))
    found = pd.concat(rows)
    write_rows("searches.csv", found)
    print(found.groupby(["scene", "offset"])[["recovered", "seconds"]].mean().to_string())


def find(
    room: Scene,
    method: Method,
    preset: Preset,
    sequence: RgbdSequence,
    T_told: Pose | None,
    mapped: str = ":",
) -> pd.DataFrame:
    """Frames of a sequence, each found by itself: told nothing, or a pose at another place."""
    preset = with_settings(preset, *method.settings)
    job = MapJob.of(room, method.field, preset, mapped)
    run_jobs([job])
    field, settings = job.map().field, preset.tracking_of(method.tracker)
    views, rows = np.linspace(0, len(sequence) - 1, N_VIEWS).round().astype(int).tolist(), []
    with ProgressBar(f"searches, {room.name}", N_VIEWS) as bar:
        for done, view in enumerate(views, start=1):
            frame = sequence[view]
            T_first = np.eye(4) if T_told is None else T_told
            tracker = make_tracker(method.tracker, field, T_first, StepBudget(MAX_STEPS), settings)
            start = time.perf_counter()
            if T_told is None:
                tracker.restart_anywhere()
            found = tracker.track(frame)
            seconds = time.perf_counter() - start
            errors = pose_errors(found.T_world_camera[None], frame.T_world_camera[None])
            error_m, error_deg = (float(error[0]) for error in errors)
            is_found = error_m < WRONG_M and error_deg < WRONG_DEG
            rows.append((method.label, error_m, error_deg, is_found, found.lost, seconds))
            bar.move_to(done)
    columns = ["method", "error_m", "error_deg", "recovered", "lost", "seconds"]
    return pd.DataFrame(rows, columns=columns).assign(scene=room.name)


if __name__ == "__main__":
    main()
