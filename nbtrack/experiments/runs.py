"""Tracked runs as cells: one tracker in one map, under one budget."""

import shlex
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from nbtrack.core import files
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.settings import as_dict, changed_settings
from nbtrack.experiments.cells import SHARED_SOURCES, Cell, MapCell, Report
from nbtrack.experiments.presets import PRESETS
from nbtrack.experiments.scenes import Scene
from nbtrack.fields.grid import BakedField
from nbtrack.mapping.quality import check_belongs
from nbtrack.synthetic import ROOMS
from nbtrack.tables import PAPER_SCENE_LABELS
from nbtrack.tracking import Trajectory, make_budget, make_tracker, track_sequence, tracker_class
from nbtrack.tracking.metrics import score_detection, trajectory_metrics
from nbtrack.tracking.trajectories import tum_text

RUN_FILE, METRICS_FILE = "run.pt", "metrics.json"


@dataclass(frozen=True)
class TrackCell(Cell):
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    needs: MapCell
    scene: Scene  # the mapped one, or another recording of the same room
    tracker: str
    steps: float | int | None = None
    rate_hz: float | int | None = None
    frames: str = ":"
    seed: int = 0
    out: Path | None = None

    kind = "tracks"

    @property
    def settings(self) -> Any:
        """Settings of the tracker."""
        return self.needs.preset.tracking_of(self.tracker)

    @cached_property
    def key(self) -> str:
        """Of code, map, tracker, budget, frames and seed; by the clock, of the machine too."""
        machine = (device_name(choose_device()), torch.get_num_threads())
        clock = None if self.rate_hz is None else (self.rate_hz, *machine)
        code = files.sources_fingerprint(*SHARED_SOURCES, "tracking")
        return files.fingerprint(
            code, files.foreign_source(tracker_class(self.tracker)), self.needs.key, self.tracker,
            self.settings, self.steps, clock, self.frames, self.seed, self.scene.fingerprint,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """Scene, method and budget, and the seed if it is not the first."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        method = f"{self.needs.field}-{self.tracker}{'-unmapped' * self.is_elsewhere}"
        return f"{self.scene.name}-{method}-{budget}" + f"-seed{self.seed}" * bool(self.seed)

    @property
    def is_elsewhere(self) -> bool:
        """Whether the map was made from another recording."""
        return self.needs.is_given or self.scene.folder != self.needs.scene.folder

    @property
    def is_done(self) -> bool:
        """Whether the run is finished; in a folder of the user's it is always made anew."""
        return self.out is None and (self.folder / METRICS_FILE).is_file()

    def result(self) -> dict[str, Any]:
        """What a finished run keeps: errors, speed, device, versions, settings."""
        return files.read_json(self.folder / METRICS_FILE)

    def compute(self, report: Report) -> dict[str, Any]:
        """Track, or take a killed run up where its last checkpoint stands; write the files.

        `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without the first
        one, whose pose was given: so public tools report the error of the paper's formula. Raises
        DataError where a given map does not fit the first frame at its given pose.
        """
        made, sequence = self.needs.map(), self.scene.read(self.frames)
        notes = {"map_from": made.made} if self.is_elsewhere else {}
        if self.needs.is_given:  # another path of a room we know may begin where no map reaches
            notes["map_warning"] = check_belongs(made, sequence[0])
        budget, start = make_budget(self.steps, self.rate_hz), time.perf_counter()
        tracker = make_tracker(
            self.tracker, made.field, sequence.T_world_camera[0], budget, self.settings, self.seed
        )
        if isinstance(tracker.field, BakedField):
            notes["bake_seconds"] = time.perf_counter() - start
            notes["grid_bytes"] = tracker.field.n_bytes
        checkpoint = self.cache / RUN_FILE  # a folder of the user's holds results alone

        def tell(done: int, error_m: float) -> None:
            report(done / len(sequence), f"off by {100 * error_m:.1f} cm")

        tracked = track_sequence(tracker, sequence, checkpoint, tell)
        notes |= {"map_seconds": made.made["seconds"], "budget": str(budget)}
        metrics = self._metrics(tracked) | notes
        ids = tracked.frames["frame_id"].to_numpy()[1:]
        # The metrics come last: where they stand, the run is complete.
        files.write_together(self.folder, {
            "trajectory.txt": tum_text(ids, tracked.T_estimated[1:]),
            "groundtruth.txt": tum_text(ids, tracked.T_true[1:]),
            "frames.csv": tracked.frames.to_csv(index=False),
            METRICS_FILE: files.json_text(metrics),
        })  # fmt: skip
        checkpoint.unlink(missing_ok=True)
        return metrics

    def _metrics(self, tracked: Trajectory) -> dict[str, Any]:
        metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
        rows = tracked.frames.iloc[1:]
        if "lost" in rows:
            errors = rows["translation_error_m"].to_numpy()
            metrics |= score_detection(rows["lost"].to_numpy(dtype=bool), errors)
        steps, seconds, map_cell = int(rows["steps"].sum()), rows["seconds"], self.needs
        return {
            **metrics,
            "frames_without_depth": int(rows["without_depth"].sum()),
            "steps_per_frame": steps / len(rows),
            "seconds_per_step": float(seconds.sum()) / max(steps, 1),
            "seconds_per_frame": float(seconds.mean()),
            "device": device_name(choose_device()),
            "threads": torch.get_num_threads(),
            "scene": self.scene.name,
            "field": map_cell.field,
            "tracker": self.tracker,
            "seed": self.seed,
            "key": self.key,
            "versions": files.versions(),
            "command": self._command(),
            "config": {
                "preset": as_dict(map_cell.preset),
                "map_frames": map_cell.frames,
                "map_seed": map_cell.seed,
                **{name: getattr(self, name) for name in ("frames", "steps", "rate_hz")},
            },
        }

    def _command(self) -> str:
        """What makes this run anew, and its map where that is not cached."""
        cell, preset = self.needs, self.needs.preset
        is_known = self.scene.name in (*ROOMS, *PAPER_SCENE_LABELS) and not self.is_elsewhere
        made = {"field": cell.field, "map-frames": cell.frames}
        options = {
            "format": self.scene.format,
            **({"map-from": cell.folder} if self.is_elsewhere else made),
            "tracker": self.tracker, "rate": self.rate_hz, "steps": self.steps,
            "frames": self.frames, "seed": self.seed, "device": choose_device().type,
            "threads": torch.get_num_threads(), "preset": preset.name,
        }  # fmt: skip
        given = [f"--{name}={value}" for name, value in options.items() if value is not None]
        settings = [f"--set={text}" for text in changed_settings(preset, PRESETS[preset.name])]
        sequence = self.scene.name if is_known else str(self.scene.folder)
        words = ["python", "-m", "nbtrack", "track", sequence, *settings, *given]
        return shlex.join([*words, "--out", f"again_{self.name}"])
