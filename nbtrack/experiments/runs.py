"""Tracked runs as cells: each is named by all that it depends on, and made once."""

import shlex
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from nbtrack.core.device import advise_on_memory, choose_device, device_name
from nbtrack.core.files import (
    fingerprint,
    foreign_source,
    json_text,
    read_json,
    runs_folder,
    sources_fingerprint,
    versions,
    write_together,
)
from nbtrack.core.settings import as_dict, changed_settings
from nbtrack.experiments.board import Cell, Report
from nbtrack.experiments.cells import SHARED_SOURCES, MapCell, cell_lock, seed_suffix
from nbtrack.experiments.presets import PRESETS
from nbtrack.experiments.scenes import DATASET_SCENES, Scene
from nbtrack.fields import Field, PointCloud
from nbtrack.fields.grid import BakedField
from nbtrack.mapping.files import Map
from nbtrack.mapping.quality import check_belongs
from nbtrack.synthetic import ROOMS
from nbtrack.tracking import Trajectory, make_budget, make_tracker, track_sequence, tracker_class
from nbtrack.tracking.metrics import score_detection, trajectory_metrics
from nbtrack.tracking.trajectories import tum_text

RUN_FILE, METRICS_FILE = "run.pt", "metrics.json"
# Where a single run gets these from its own options.
_NOT_PASSED_ON = ("scenes.names", "scenes.track_frames", "tables.")


@dataclass(frozen=True)
class TrackCell(Cell):
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    map_cell: MapCell
    tracker: str
    steps: float | int | None = None
    rate_hz: float | int | None = None
    frames: str = ":"
    seed: int = 0
    out: Path | None = None  # where to write the results instead of in the cache

    @property
    def settings(self) -> Any:
        """Settings of the tracker."""
        return self.map_cell.preset.tracking_of(self.tracker)

    @cached_property
    def key(self) -> str:
        """Changes with everything that the run depends on; by the clock, with the machine too."""
        machine = (device_name(choose_device()), torch.get_num_threads())
        clock = None if self.rate_hz is None else (self.rate_hz, *machine)
        code = sources_fingerprint(*SHARED_SOURCES, "tracking")
        return fingerprint(
            code, foreign_source(tracker_class(self.tracker)), self.map_cell.key, self.tracker,
            self.settings, self.steps, clock, self.frames, self.seed,
        )  # fmt: skip

    @property
    def needs(self) -> MapCell:
        """The map."""
        return self.map_cell

    @property
    def scene(self) -> Scene:
        """The tracked scene."""
        return self.map_cell.scene

    @property
    def name(self) -> str:
        """A readable name: scene, method and budget, and the seed if it is not the first."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        method = f"{self.map_cell.field}-{self.tracker}"
        return f"{self.scene.name}-{method}-{budget}{seed_suffix(self.seed)}"

    @property
    def cache(self) -> Path:
        """Where a run of the cache is kept, and the checkpoint of any."""
        return runs_folder() / "tracks" / f"{self.name}-{self.key}"

    @property
    def folder(self) -> Path:
        """Where the run's files are kept."""
        return self.out or self.cache

    @property
    def is_done(self) -> bool:
        """Whether the run is finished; in a folder of the user's it is always made anew."""
        return self.out is None and (self.folder / METRICS_FILE).is_file()

    @cached_property
    def units(self) -> int:
        """Frames to track, after the first one, whose pose is given."""
        return self.scene.count(self.frames) - 1

    @property
    def cost(self) -> float:
        """Points that the network is asked for with a step budget; seconds with the clock."""
        if self.rate_hz is not None:
            return self.units / self.rate_hz
        samples = 1
        if tracker_class(self.tracker).renders:
            samples = 2 * self.settings.n_stratified + self.settings.n_importance
        return float(self.units * self.steps * self.settings.n_pixels * samples)

    def result(self) -> dict[str, Any]:
        """What a finished run keeps: errors, speed, device, versions, settings."""
        return read_json(self.folder / METRICS_FILE)

    def make(self, report: Report) -> dict[str, Any]:
        """Track now, or wait for the process that does; returns `result`."""
        with cell_lock(self.cache, report):
            return self.result() if self.is_done else self._make(report)

    def _make(self, report: Report) -> dict[str, Any]:
        """Track, or take a killed run up where its last checkpoint stands; write the files.

        `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without the first
        one, whose pose was given: so public tools report the error of the paper's formula.

        Raises:
            DataError: a given map does not fit the first frame at its given pose.
        """
        made = self.map_cell.map()
        with advise_on_memory(f"frames {self.frames} of {self.scene.name}"):
            sequence = self.scene.read(self.frames)
        notes = {}
        if self.map_cell.given:
            notes = {"map_from": made.made, "map_warning": check_belongs(made, sequence[0])}
        field, baking = _field_to_track(made.field, self.settings)
        budget = make_budget(self.steps, self.rate_hz)
        tracker = make_tracker(
            self.tracker, field, sequence.T_world_camera[0], budget, self.settings, self.seed
        )
        checkpoint = self.cache / RUN_FILE
        tracked = track_sequence(
            tracker, sequence, checkpoint, lambda done, m: report(done, f"off by {100 * m:.1f} cm")
        )
        metrics = {**self._metrics(tracked, made), "budget": str(budget), **baking, **notes}
        ids = tracked.frames["frame_id"].to_numpy()[1:]
        # The metrics come last: where they stand, the run is complete.
        write_together(self.folder, {
            "trajectory.txt": tum_text(ids, tracked.T_estimated[1:]),
            "groundtruth.txt": tum_text(ids, tracked.T_true[1:]),
            "frames.csv": tracked.frames.to_csv(index=False),
            METRICS_FILE: json_text(metrics),
        })  # fmt: skip
        checkpoint.unlink(missing_ok=True)
        return metrics

    def _metrics(self, tracked: Trajectory, made: Map) -> dict[str, Any]:
        metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
        rows = tracked.frames.iloc[1:]
        if "lost" in rows:
            errors = rows["translation_error_m"].to_numpy()
            metrics |= score_detection(rows["lost"].to_numpy(dtype=bool), errors)
        steps, device = int(rows["steps"].sum()), choose_device()
        return {
            **metrics,
            "frames_without_depth": int(rows["without_depth"].sum()),
            "steps_per_frame": steps / len(rows),
            "seconds_per_step": float(rows["seconds"].sum()) / max(steps, 1),
            "seconds_per_frame": float(rows["seconds"].mean()),
            "map_seconds": made.seconds,
            "device": device_name(device),
            "threads": torch.get_num_threads(),
            "scene": self.scene.name,
            "field": self.map_cell.field,
            "tracker": self.tracker,
            "seed": self.seed,
            "key": self.key,
            "versions": versions(),
            "command": self._command(device),
            "config": {
                "preset": as_dict(self.map_cell.preset),
                "map_frames": self.map_cell.frames,
                "map_seed": self.map_cell.seed,
                "frames": self.frames,
                "steps": self.steps,
                "rate_hz": self.rate_hz,
            },
        }

    def _command(self, device: torch.device) -> str:
        """What makes this run anew, and its map where that is not cached."""
        cell, preset = self.map_cell, self.map_cell.preset
        is_known = self.scene.name in (*ROOMS, *DATASET_SCENES)
        words = ["python", "-m", "nbtrack", "track"]
        words += [self.scene.name if is_known else str(self.scene.folder)]
        words += ["--format", self.scene.format] if self.scene.format else []
        words += ["--map-from", str(cell.given_path)] if cell.given else [
            "--field", cell.field, "--map-frames", cell.frames]  # fmt: skip
        words += ["--tracker", self.tracker]
        words += ["--rate", repr(self.rate_hz)] if self.rate_hz else ["--steps", repr(self.steps)]
        words += ["--frames", self.frames, "--seed", str(self.seed), "--device", device.type]
        words += ["--threads", str(torch.get_num_threads()), "--preset", preset.name]
        for setting in changed_settings(preset, PRESETS[preset.name]):
            if not setting.startswith(_NOT_PASSED_ON):
                words += ["--set", setting]
        return shlex.join([*words, "--out", f"again_{self.name}"])


def _field_to_track(field: Field | PointCloud, settings: Any) -> tuple[Any, dict[str, Any]]:
    """The field that a tracker asks: the map itself, or its copy on a grid; and what that took."""
    if not getattr(settings, "bake_voxel", 0):
        return field, {}
    start = time.perf_counter()
    baked = BakedField(field, settings.bake_voxel)
    return baked, {"bake_seconds": time.perf_counter() - start, "grid_bytes": baked.n_bytes}
