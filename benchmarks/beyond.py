"""The larger results that notebook 6 reads: CSV files in paper_tables/beyond.

    python benchmarks/beyond.py [convergence|map_and_start|units]

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

from nbtrack import Method, load_preset, make_tracker, open_scenes, track_scenes
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


def write(name: str, table: pd.DataFrame) -> None:
    """Write a table to a CSV in paper_tables/beyond."""
    print(f"{write_csv(tables_folder() / 'beyond' / f'{name}.csv', table)}: {len(table)} rows")


def beyond(scenes: Sequence[Scene], preset: Preset) -> None:
    """Table III, the time a frame, how fast maps get right, and both trackers in the same maps."""
    results = track_scenes(scenes, TABLE_3, preset, RATES_3_HZ, frames=":")
    write("table_3_cells", results[_COLUMNS])
    device = device_name(choose_device())
    note = f"Preset: {described(preset)}; budget: {preset.step_counts}; whole path; {device}."
    write_table_3(tables_folder() / "beyond", results, note)
    # Times are measured: one run after the other. The slice is spelled otherwise, so that none of
    # the runs above is taken from the cache.
    speed = track_scenes(scenes, TABLE_3, preset, [10], frames="0:", execution=Execution(workers=1))
    write("speed", speed[_COLUMNS])
    write("convergence", convergence(scenes, preset))
    write("map_and_start", map_and_start(scenes, preset))


def convergence(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """Time and accuracy of maps of a scene by field and number of iterations, with three seeds.

    `seconds` are those of a core. `near_m` and `free_m` are errors of the distance near surfaces
    and in free space. `lm_m` is the ATE of LM with 2,048 points in the sampled map, without
    correction, at every fourth frame.
    """
    scene, rows = scenes[0], []
    sequence, tracked = scene.read(), scene.read("::4")
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


def map_and_start(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """SDF and LM at 10 Hz in the same maps and from the same starts."""
    runs, keys = [], ["map", "tracker", "start"]
    starts = "previous_pose", "constant_velocity"
    for field, tracker, start in product(("neus", "neus_plus"), ("sdf", "lm"), starts):
        setting = f"tracking.{tracker}.motion_model={start}"
        method = Method(f"{tracker} in {field}, {start}", field, tracker, (setting,))
        trials = track_scenes(scenes, [method], preset, [10], frames=":")
        runs.append(trials.assign(map=field, tracker=tracker, start=start))
    return pd.concat(runs)[[*keys, "scene", "frames", "steps_per_frame", "still_ate_m", "ate_m"]]


def units(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """VR and SDF at 10 Hz with learning rates in metres, and in units of the map: longer steps."""
    runs = []
    for unit in ("metre", "map"):
        rates = [f"tracking.{name}.position_unit={unit}" for name in TABLE_1]
        trials = track_scenes(scenes, TABLE_1, with_settings(preset, *rates), [10], frames=":")
        runs.append(trials.assign(position_unit=unit))
    kept = [name for name in _COLUMNS if name != "seconds_per_frame"]
    return pd.concat(runs)[["position_unit", *kept, "reach_m", "greedy_ate_m"]]


PARTS = {"convergence": convergence, "map_and_start": map_and_start, "units": units}


if __name__ == "__main__":
    smoke = load_preset("smoke", settings=HAND_HELD)
    rooms = open_scenes(smoke)
    for part in sys.argv[1:]:
        write(part, PARTS[part](rooms, smoke))
    if not sys.argv[1:]:
        beyond(rooms, smoke)
