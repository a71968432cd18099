"""Accuracy, time and basin of the second-order tracker, as the tables in README.md show them.

    python benchmarks/second_order.py [RECORDING]

Maps and runs are kept with all others (`NBTRACK_RUNS`). RECORDING is a folder in the dataset's
layout; without one only the synthetic rooms of the `smoke` preset are run.
"""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from nbtrack.cells import MapCell, TrackCell
from nbtrack.config import Preset
from nbtrack.experiments import field_to_track, map_summary, obtain_map, obtain_track
from nbtrack.geometry import rotation_angle
from nbtrack.registration import moved
from nbtrack.sampling import PixelSampler
from nbtrack.scenes import Scene, find_scene
from nbtrack.settings import resolve_preset, with_settings
from nbtrack.trackers import tracker_class

BAKED = "tracking.lm.bake_voxel=0.04"
# Row, field, tracker, settings, steps a frame at most.
METHODS = (
    ("NeuS with SDF (Adam)", "neus", "sdf", (), 15.3),
    ("NeuS+ with SDF (Adam)", "neus_plus", "sdf", (), 15.3),
    ("NeuS+ with SDF (LM)", "neus_plus", "lm", (), 30),
    ("NeuS+ baked (LM)", "neus_plus", "lm", (BAKED,), 30),
    ("ICP", "points", "icp", (), 1),
)
OFFSETS = ((1, 1), (2, 2), (4, 4), (8, 6), (12, 9), (20, 15), (30, 20), (50, 30))  # cm, degrees
STARTS = 24
RECOVERED_M, RECOVERED_DEG = 0.02, 1.0


def track_rows(preset: Preset, scene: Scene, frames: str) -> list[dict]:
    """One row a method: error, time and lost frames in a scene."""
    rows = []
    for label, field, tracker, settings, steps in METHODS:
        map_cell = MapCell(scene, field, with_settings(preset, *settings))
        metrics = obtain_track(TrackCell(map_cell, tracker, steps=steps, frames=frames))
        rows.append(
            {
                "scene": f"{scene.name} {frames}", "method": label,
                "ATE, cm": 100 * metrics["ate_rmse_m"],
                "ms a frame": 1000 * metrics["seconds_per_frame"],
                "steps": metrics["steps_per_frame"], "lost": metrics["lost_frames"],
            }
        )  # fmt: skip
    return rows


def map_rows(preset: Preset, scene: Scene) -> list[dict]:
    """Mapping seconds and errors of the distance of NeuS and NeuS+, also after part of the time."""
    rows = []
    for field, iterations in (("neus", 2000), ("neus_plus", 1400), ("neus_plus", 500)):
        cell = MapCell(
            scene, field, with_settings(preset, f"mapping.{field}.iterations={iterations}")
        )
        obtain_map(cell)
        summary = map_summary(cell)
        quality = {name: summary["quality"][name] for name in ("sdf_near_m", "sdf_free_m")}
        rows.append({"field": field, "iterations": iterations, "seconds": summary["seconds"]})
        rows[-1] |= {name: 100 * value for name, value in quality.items() if value is not None}
    return rows


def basin_rows(preset: Preset, scene: Scene) -> list[dict]:
    """Share of starts that come within 2 cm and 1 degree of the truth, by how far off they are."""
    sequence = scene.read(slice(0, 240, 10))
    sampler, rows = PixelSampler(sequence, torch.device("cpu")), []
    for label, field_name, tracker_name, settings, steps in METHODS[1:4]:
        changed = with_settings(preset, *settings)
        config = replace(changed.tracking_of(tracker_name), n_restarts=0)
        fitted = obtain_map(MapCell(scene, field_name, preset))
        field, _ = field_to_track(fitted.field, config)
        tracker = tracker_class(tracker_name)(
            field, sampler, config, torch.Generator().manual_seed(0)
        )
        steps = 79 if tracker_name == "sdf" else steps
        row = {"method": f"{label}, {steps} steps"}
        for offset in tqdm(OFFSETS, label):
            found = [_recovers(tracker, sequence, start, offset, steps) for start in range(STARTS)]
            row["{} cm {}°".format(*offset)] = f"{np.mean(found):.0%}"
        rows.append(row)
    return rows


def _recovers(tracker, sequence, start: int, offset: tuple[int, int], steps: int) -> bool:
    generator = torch.Generator().manual_seed(start)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    twist = torch.cat([np.radians(offset[1]) * directions[0], 0.01 * offset[0] * directions[1]])
    frame = start % len(sequence)
    T_true = torch.from_numpy(sequence.T_world_camera[frame]).float()
    tracker.start_frame(frame, moved(T_true, twist)[None])
    for _ in range(steps):
        if tracker.is_converged:
            break
        tracker.step()
    T_found = tracker.T_world_camera
    turn = rotation_angle(T_true[:3, :3].T @ T_found[:3, :3]).rad2deg()
    distance = (T_found[:3, 3] - T_true[:3, 3]).norm()
    return bool(distance < RECOVERED_M and turn < RECOVERED_DEG)


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(1)
    preset = resolve_preset("smoke")
    rooms = [find_scene(name, preset.scenes) for name in preset.scenes.names]
    rows = [row for room in rooms for row in track_rows(preset, room, ":120")]
    for recording in sys.argv[1:]:
        scene = find_scene(recording, preset.scenes)
        rows += [row for step in (":", "::2", "::3") for row in track_rows(preset, scene, step)]
    print(pd.DataFrame(rows).round(2).to_string(index=False))
    print(pd.DataFrame(map_rows(preset, rooms[0])).round(2).to_string(index=False))
    print(pd.DataFrame(basin_rows(preset, rooms[0])).to_string(index=False))


if __name__ == "__main__":
    main()
