"""Accuracy, time, basin and verdicts of the second-order tracker, as the tables in README.md show.

    python benchmarks/second_order.py [RECORDING]

Maps and runs are kept with all others (`NBTRACK_RUNS`). RECORDING is a folder in the dataset's
layout; without one only the synthetic rooms of the `smoke` preset are run.
"""

import sys

import pandas as pd
import torch

from nbtrack.core.config import Preset
from nbtrack.core.settings import resolve_preset, with_settings
from nbtrack.experiments.basin import find_from_afar, score_verdicts, share_recovered
from nbtrack.experiments.beyond import ADAM_PLUS, BAKED, LM, METHODS, Method
from nbtrack.experiments.cells import MapCell, TrackCell
from nbtrack.experiments.parallel import Execution
from nbtrack.experiments.results import map_summary, obtain_map, obtain_track
from nbtrack.experiments.scenes import Scene, find_scene

MORE_POINTS = Method(
    "NeuS+ with SDF (LM), 2048 points", "neus_plus", "lm", ("tracking.lm.n_pixels=2048",)
)
LONGER = Method(
    "NeuS+ mapped for 4000 iterations (LM)", "neus_plus", "lm",
    ("mapping.neus_plus.iterations=4000",),
)  # fmt: skip
LONGER_BAKED = Method(
    "the same, baked (LM)", "neus_plus", "lm", (*LONGER.settings, *BAKED.settings)
)
# Method and steps a frame at most.
COMPARED = (
    (METHODS[2], 15.3), (ADAM_PLUS, 15.3), (LM, 30.0), (MORE_POINTS, 30.0), (BAKED, 30.0),
    (LONGER, 30.0), (LONGER_BAKED, 30.0), (METHODS[-1], 1.0),
)  # fmt: skip
TOO_FAST = ("::8", "::10", "::12", "::16")
"""So much of a recording is left out that some frames are lost: verdicts are scored there."""


def track_rows(preset: Preset, scene: Scene, frames: str) -> list[dict]:
    """One row a method: error, time and lost frames in a scene."""
    rows = []
    for method, steps in COMPARED:
        metrics = _track(preset, scene, method, steps, frames)
        rows.append(
            {
                "scene": f"{scene.name} {frames}", "method": method.label,
                "ATE, cm": 100 * metrics["ate_rmse_m"],
                "ms a frame": 1000 * metrics["seconds_per_frame"],
                "steps": metrics["steps_per_frame"], "lost": metrics["lost_frames"],
            }
        )  # fmt: skip
    return rows


def verdict_rows(preset: Preset, scene: Scene) -> list[dict]:
    """Whether LM and ICP know which frames they lost, where frames are far apart."""
    rows = []
    for frames in TOO_FAST:
        for method, steps in ((LM, 100.0), (BAKED, 100.0), (METHODS[-1], 1.0)):
            metrics = _track(preset, scene, method, steps, frames)
            rows.append(
                {
                    "frames": frames, "method": method.label, "tracked": metrics["frames"],
                    "lost": metrics["lost_frames"], "precision": metrics["lost_precision"],
                    "recall": metrics["lost_recall"],
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


def _track(preset: Preset, scene: Scene, method: Method, steps: float, frames: str) -> dict:
    map_cell = MapCell(scene, method.field_name, with_settings(preset, *method.settings))
    return obtain_track(TrackCell(map_cell, method.tracker_name, steps=steps, frames=frames))


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(1)
    preset = resolve_preset("smoke")
    rooms = [find_scene(name, preset.scenes) for name in preset.scenes.names]
    recordings = [find_scene(name, preset.scenes) for name in sys.argv[1:]]
    rows = [row for room in rooms for row in track_rows(preset, room, ":120")]
    for scene in recordings:
        rows += [row for step in (":", "::2", "::3") for row in track_rows(preset, scene, step)]
    print(pd.DataFrame(rows).round(2).to_string(index=False))
    for scene in recordings:
        print(pd.DataFrame(verdict_rows(preset, scene)).round(2).to_string(index=False))
    print(pd.DataFrame(map_rows(preset, rooms[0])).round(2).to_string(index=False))
    searches = find_from_afar(preset, rooms[0], execution=Execution(workers=1))
    print((100 * share_recovered(searches)).round().to_string())
    for method, score in score_verdicts(searches).items():
        print(method, score)


if __name__ == "__main__":
    main()
