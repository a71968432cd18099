"""The larger results that notebook 6 reads: CSV files in paper_tables/beyond.

    python benchmarks/beyond.py [convergence|units]

They are of the two rooms of the preset `smoke`, with the paper's numbers of steps, and take an hour
on one CPU core. Maps and runs are kept with all others (`NBTRACK_RUNS`), so that a killed run
resumes.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import pandas as pd
import torch
from motions import HAND_HELD

from nbtrack import METHODS, Method, load_preset, make_tracker, open_scenes, track_scenes
from nbtrack.experiments.bench import described
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_1, TABLE_3
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.quality import score_map
from nbtrack.experiments.scenes import Scene
from nbtrack.machinery.device import choose_device, device_name
from nbtrack.machinery.files import tables_folder
from nbtrack.machinery.settings import with_settings
from nbtrack.mapping.fit import map_sequence
from nbtrack.tables import write_csv, write_table_3
from nbtrack.tracking import StepBudget, track_sequence
from nbtrack.tracking.metrics import trajectory_metrics

_COLUMNS = ["rate_hz", "method", "n_pixels", "scene", "frames"]
_COLUMNS += ["steps_per_frame", "seconds_per_frame", "still_ate_m", "ate_m"]

_CHANGES = {
    "without colour": "tracking.lm.lambda_intensity=0",
    "from the previous pose": "tracking.lm.motion_model=previous_pose",
    "from constant velocity": "tracking.lm.motion_model=constant_velocity",
    "with four times the points": "tracking.lm.n_pixels=2048",
    "in NeuS+ without rendering": "mapping.neus_plus.lambda_rendering=0",
}
# LM in NeuS+, and the same with one change at a time.
INGREDIENTS = [
    METHODS["baked"],
    *(Method(label, "neus_plus", "lm", (setting,)) for label, setting in _CHANGES.items()),
    Method("in NeuS, as in the paper", "neus", "lm"),
]


def write(name: str, table: pd.DataFrame) -> None:
    """Write a table to a CSV in paper_tables/beyond."""
    print(f"{write_csv(tables_folder() / 'beyond' / f'{name}.csv', table)}: {len(table)} rows")


def beyond(scenes: Sequence[Scene], preset: Preset) -> None:
    """Table III, the time a frame, how fast maps get right, and what each ingredient of LM adds."""
    results = track_scenes(scenes, TABLE_3, preset, RATES_3_HZ, frames=":")
    write("table_3_cells", results[_COLUMNS])
    device = device_name(choose_device())
    note = f"Preset: {described(preset)}; budget: {preset.step_counts}; whole path; {device}."
    write_table_3(tables_folder() / "beyond", results, note)
    # Times are measured: one run after the other. The slice is spelled otherwise, so that none of
    # the runs above is taken from the cache.
    speed = track_scenes(scenes, TABLE_3, preset, [10], frames="0:", execution=Execution(workers=1))
    write("speed", speed[_COLUMNS])
    write("convergence", convergence(scenes[0], preset))
    parts = [
        track_scenes(scenes[:1], INGREDIENTS, preset, steps=30, frames=frames).assign(kept=frames)
        for frames in (":", "::8")
    ]
    kept = ["method", "scene", "kept", "steps_per_frame", "still_ate_m", "ate_m"]
    write("ingredients", pd.concat(parts)[kept])


def convergence(scene: Scene, preset: Preset) -> pd.DataFrame:
    """Time and accuracy of maps by field and number of iterations, with three seeds.

    `seconds` are those of a core. `near_m` and `free_m` are errors of the distance near surfaces
    and in free space. `lm_m` is the ATE of LM with 2,048 points in the sampled map, without
    correction, at every fourth frame.
    """
    sequence, tracked, rows = scene.read(), scene.read("::4"), []
    fields = "neus", "neus_plus", "grid_plus"
    torch.set_num_threads(1)
    for seed, name, iterations in product(range(3), fields, (30, 60, 125, 250, 500, 1000)):
        longer = with_settings(preset, f"mapping.{name}.iterations={iterations}")
        how = longer.network_of(name), longer.mapping_of(name), seed
        began = time.process_time()
        made = map_sequence(name, sequence, *how)
        seconds = time.process_time() - began
        scores = score_map(made, sequence, scene.room)
        settings = replace(longer.tracking_of("lm"), n_pixels=2048)
        start = tracked.T_world_camera[0], StepBudget(30), settings
        run = track_sequence(make_tracker("lm", made.field, *start), tracked)
        lm_m = trajectory_metrics(run.T_estimated, run.T_true)["ate_rmse_m"]
        errors_m = scores["sdf_near_m"], scores["sdf_free_m"], lm_m
        rows.append((seed, name, iterations, seconds, *errors_m))
    columns = ["seed", "field", "iterations", "seconds", "near_m", "free_m", "lm_m"]
    return pd.DataFrame(rows, columns=columns)


def units(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """VR and SDF at 10 Hz with learning rates in metres, and in units of the map: longer steps."""
    runs = []
    for unit in ("metre", "map"):
        rates = [f"tracking.{name}.position_unit={unit}" for name in TABLE_1]
        trials = track_scenes(scenes, TABLE_1, with_settings(preset, *rates), [10], frames=":")
        runs.append(trials.assign(position_unit=unit))
    kept = [name for name in _COLUMNS if name != "seconds_per_frame"]
    return pd.concat(runs)[["position_unit", *kept, "reach_m", "greedy_ate_m"]]


if __name__ == "__main__":
    smoke = load_preset("smoke", settings=HAND_HELD)
    rooms = open_scenes(smoke)
    if sys.argv[1:] == ["convergence"]:
        write("convergence", convergence(rooms[0], smoke))
    elif sys.argv[1:] == ["units"]:
        write("units", units(rooms, smoke))
    else:
        beyond(rooms, smoke)
