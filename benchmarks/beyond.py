"""The larger results that notebook 6 reads: CSV in paper_tables/beyond.

    python benchmarks/beyond.py [convergence]

On the two rooms of the `smoke` preset, with the paper's step counts; an hour on one CPU core.
Maps and runs are kept with all others (`NBTRACK_RUNS`), so that a killed run goes on.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import pandas as pd
import torch
from basin import find_from_afar
from motions import HAND_HELD
from turns import in_turns
from variants import FusedDistance

from nbtrack import METHODS, Method, load_preset, make_tracker, map_scene, open_scenes, track_scenes
from nbtrack.beyond.grid import BakedField
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder, write_atomic
from nbtrack.core.settings import with_settings
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_3
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.quality import score_map
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import Field
from nbtrack.mapping.fit import map_sequence
from nbtrack.mapping.holdout import split_holdout
from nbtrack.tables import write_table_3
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
# LM with one thing changed at a time.
INGREDIENTS = [
    METHODS["baked"],
    *(Method(label, "neus_plus", "lm", (setting,)) for label, setting in _CHANGES.items()),
    Method("in NeuS, as in the paper", "neus", "lm"),
]


def write(name: str, table: pd.DataFrame) -> None:
    """One file of paper_tables/beyond/."""
    path = tables_folder() / "beyond" / f"{name}.csv"
    write_atomic(path, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    print(f"{path.name}: {len(table)} rows")


def beyond(scenes: Sequence[Scene], preset: Preset) -> None:
    """Table III, the basin of convergence, and what each ingredient of LM adds."""
    results = track_scenes(scenes, TABLE_3, preset, RATES_3_HZ, frames=":")
    write("table_3_cells", results[_COLUMNS])
    device = device_name(choose_device())
    note = f"Preset: smoke; budget: {preset.step_counts}; whole path; {device}."
    write_table_3(tables_folder() / "beyond", results, note)
    # Times count: one run after the other. The slice reads otherwise, so that none is cached.
    speed = track_scenes(scenes, TABLE_3, preset, [10], frames="0:", execution=Execution(workers=1))
    write("speed", speed[_COLUMNS])
    write("convergence", convergence(scenes[0], preset))
    write("points", points_time_and_bytes(scenes, preset))
    searches = find_from_afar(scenes[0], {"sdf_plus": 79, "baked": 30}, preset)
    write("basin", searches)
    parts = [
        track_scenes(scenes[:1], INGREDIENTS, preset, steps=30, frames=frames).assign(kept=frames)
        for frames in (":", "::8")
    ]
    kept = ["method", "scene", "kept", "steps_per_frame", "still_ate_m", "ate_m"]
    ingredients = pd.concat(parts)[kept]
    write("ingredients", ingredients)


def convergence(scene: Scene, preset: Preset) -> pd.DataFrame:
    """Seconds of a core that longer maps take, and how good they are, three seeds.

    `near_m` and `free_m` are the errors of the distance near surfaces and in free space, `lm_m` is
    the ATE of LM with 2,048 points in the map as sampled, at every fourth frame.
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
        told = scores["sdf_near_m"], scores["sdf_free_m"], lm_m
        rows.append((seed, name, iterations, seconds, *told))
    columns = ["seed", "field", "iterations", "seconds", "near_m", "free_m", "lm_m"]
    return pd.DataFrame(rows, columns=columns)


def points_time_and_bytes(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """LM and ICP with fewer and more points a frame, in maps of several kinds, all in turns.

    `milliseconds` is the median over the frames, `map_mb` what a map's numbers take, in millions of
    bytes.
    """
    rows = []
    for scene in scenes:
        sequence, maps = scene.read("::4"), dict(_maps(scene, preset))
        for n_pixels in (128, 512, 2048, 4096):
            runs = {}
            for label, (_, field, tracker, settings) in maps.items():
                drawn = *settings, f"tracking.{tracker}.n_pixels={n_pixels}"
                settings = with_settings(preset, *drawn).tracking_of(tracker)
                how = field, sequence.T_world_camera[0], StepBudget(30), settings
                runs[label] = make_tracker(tracker, *how), sequence
            for label, found in in_turns(runs).groupby("run", sort=False):
                ate_m = float(found["error_m"].pow(2).mean() ** 0.5)
                told = label, n_pixels, scene.name, maps[label][0] / 1e6
                rows.append((*told, found["milliseconds"].median(), ate_m))
    columns = ["method", "n_pixels", "scene", "map_mb", "milliseconds", "ate_m"]
    return pd.DataFrame(rows, columns=columns)


def _maps(scene: Scene, preset: Preset) -> Iterator[tuple[str, tuple[int, Field, str, tuple]]]:
    """Labels; with each the bytes of a map, the map, a tracker and settings."""
    methods = [METHODS["baked"], METHODS["corrected"]]
    for cm in (2, 5, 10):
        settings = (f"mapping.points.voxel={cm / 100}",)
        methods.append(Method(f"ICP, cells of {cm} cm", "points", "icp", settings))
    for method in methods:
        field = map_scene(scene, method.field, with_settings(preset, *method.settings)).field
        n_bytes = sum(part.nbytes for part in field.state_dict().values())
        yield method.label, (n_bytes, field, method.tracker, method.settings)
    whole = scene.read()
    mapped, bounds = split_holdout(len(whole), 10)[0], observed_bounds(whole)
    fused = FusedDistance(whole, mapped, bounds, voxel=0.04)
    # In a grid of the same vertices, so that its search is compiled too; colours it has none.
    uncoloured = ("tracking.lm.lambda_intensity=0",)
    yield "fused voxels (LM)", (fused.values.nbytes, BakedField(fused, 0.04), "lm", uncoloured)


if __name__ == "__main__":
    smoke = load_preset("smoke", settings=HAND_HELD)
    rooms = open_scenes(smoke)
    if sys.argv[1:] == ["convergence"]:
        write("convergence", convergence(rooms[0], smoke))
    else:
        beyond(rooms, smoke)
