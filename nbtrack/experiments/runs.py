"""Tracked runs as jobs: one tracker in one map, under one budget."""

import shlex
import time
from dataclasses import dataclass
from functools import cached_property
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nbtrack.core import files
from nbtrack.core.device import choose_device, device_name, threads
from nbtrack.core.settings import as_dict, changed_settings
from nbtrack.experiments.jobs import Job, MapJob, Report
from nbtrack.experiments.presets import PRESETS
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.fields.grid import BakedField
from nbtrack.mapping.quality import check_belongs
from nbtrack.tracking import Trajectory, make_budget, make_tracker, track_sequence, tracker_class
from nbtrack.tracking.metrics import score_detection, still_metrics, trajectory_metrics
from nbtrack.tracking.trajectories import METRICS_FILE, shifted, tum_text

RUN_FILE = "run.pt"
OF_MAPS = ("network.", "mapping.")
"""How keys of settings begin that only matter where a map is made."""


@dataclass(frozen=True)
class TrackJob(Job):
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    needs: MapJob
    scene: Scene  # the mapped one, or another recording of the same room
    tracker: str
    steps: float | int | None = None
    rate_hz: float | int | None = None
    frames: str = ":"
    seed: int = 0
    out: Path | None = None
    n_threads: int | None = None  # CPU threads to track with; by default the process's
    start: str = "given"  # the first frame's true pose, where known; or "unknown"

    kind = "tracks"

    @property
    def settings(self) -> Any:
        """Settings of the tracker."""
        return self.needs.preset.tracking_of(self.tracker)

    @cached_property
    def key(self) -> str:
        """Of code, map, tracker, budget, threads, frames and seed; by the clock, of the machine."""
        kinds = tracker_class(self.tracker), field_class(self.needs.field)
        clock = None if self.rate_hz is None else (self.rate_hz, device_name(choose_device()))
        return files.fingerprint(
            files.code_fingerprint(*kinds, "nbtrack.tracking.trajectories"), self.needs.key,
            self.tracker, self.settings, self.steps, clock, self.n_threads, self.start, self.frames,
            self.seed, self.scene.fingerprint,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """Scene, method and budget, and the seed if it is not the first."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        elsewhere = "-unmapped" if self.is_elsewhere else ""
        name = f"{self.scene.name}-{self.needs.field}-{self.tracker}{elsewhere}-{budget}"
        return f"{name}-seed{self.seed}" if self.seed else name

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
        one, whose pose was given: so public tools report the error of the paper's formula. Where no
        true pose is known there is no `groundtruth.txt`. Raises DataError where a given map does
        not fit the first frame at its given pose.
        """
        with threads(self.n_threads or torch.get_num_threads()):
            tracked, notes = self._tracked(report)
            metrics = self._metrics(tracked) | notes
        if metrics.get("path_m") and "ate_rmse_m" in metrics:
            metrics["ate_over_path"] = metrics["ate_rmse_m"] / metrics["path_m"]
        times, origin = tracked.frames["time"].to_numpy(), np.array(notes.get("origin", [0, 0, 0]))
        texts = {
            "trajectory.txt": tum_text(times, shifted(tracked.T_estimated, origin)),
            "groundtruth.txt": tum_text(times, shifted(tracked.T_true, origin)),
            "frames.csv": tracked.frames.to_csv(index=False),
            METRICS_FILE: files.json_text(metrics),
        }
        if "ate_rmse_m" not in metrics:
            del texts["groundtruth.txt"]
            (self.folder / "groundtruth.txt").unlink(missing_ok=True)
        files.write_together(self.folder, texts)
        self._checkpoint.unlink(missing_ok=True)
        return metrics

    @property
    def _checkpoint(self) -> Path:
        return self.cache / RUN_FILE  # a folder of the user's holds results alone

    def _tracked(self, report: Report) -> tuple[Trajectory, dict[str, Any]]:
        """The trajectory, and what is to be said of the run beside its errors."""
        finished_map = self.needs.map()
        field, origin = finished_map.field, np.array(finished_map.record["origin"])
        sequence = self.scene.read(self.frames, needs_poses=False, origin=origin)
        budget = make_budget(self.steps, self.rate_hz)
        notes = {"map_seconds": finished_map.record["seconds"], "budget": str(budget)}
        if origin.any():
            notes["origin"] = origin.tolist()
        notes |= still_metrics(sequence.T_world_camera)
        if self.is_elsewhere:
            notes["map_from"] = finished_map.record
        T_first = sequence.T_world_camera[0]
        is_start_known = self.start == "given" and bool(np.isfinite(T_first).all())
        if self.needs.is_given and is_start_known:  # another path may begin where no map reaches
            notes["map_warning"] = check_belongs(finished_map, sequence[0])
        start, T_start = time.perf_counter(), T_first if is_start_known else np.eye(4)
        tracker = make_tracker(self.tracker, field, T_start, budget, self.settings, self.seed)
        if isinstance(tracker.field, BakedField):
            notes["bake_seconds"] = time.perf_counter() - start
            notes["grid_bytes"] = tracker.field.n_bytes

        def tell(done: int, error_m: float) -> None:
            status = f"frame {done}" if isnan(error_m) else f"off by {100 * error_m:.1f} cm"
            report(done / len(sequence), status)

        trajectory = track_sequence(tracker, sequence, self._checkpoint, tell, is_start_known)
        return trajectory, notes | {"start": "given" if is_start_known else "unknown"}

    def _metrics(self, tracked: Trajectory) -> dict[str, Any]:
        metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
        rows = tracked.frames
        if "lost" in rows:
            metrics["flagged_frames"] = int(rows["lost"].sum())
            rated = rows.dropna(subset="translation_error_m")
            flags, errors = rated["lost"].to_numpy(dtype=bool), rated["translation_error_m"]
            metrics |= score_detection(flags, errors.to_numpy())
        steps, seconds, map_job = int(rows["steps"].sum()), rows["seconds"], self.needs
        return {
            **metrics,
            "frames_without_depth": int(rows["without_depth"].sum()),
            "steps_per_frame": steps / len(rows),
            "seconds_per_step": float(seconds.sum()) / max(steps, 1),
            "seconds_per_frame": float(seconds.mean()),
            "device": device_name(choose_device()),
            "threads": torch.get_num_threads(),
            "scene": self.scene.name,
            "field": map_job.field,
            "tracker": self.tracker,
            "seed": self.seed,
            "key": self.key,
            "versions": files.versions(),
            "command": self._command(),
            "recording": str(self.scene.folder),
            "format": self.scene.format,
            "map": str(map_job.folder),
            "config": {
                "preset": as_dict(map_job.preset),
                "map_frames": map_job.frames,
                "map_seed": map_job.seed,
                **{name: getattr(self, name) for name in ("frames", "steps", "rate_hz")},
            },
        }

    def _command(self) -> str:
        """What makes this run anew, and its map where that is not cached."""
        job, preset = self.needs, self.needs.preset
        is_room = self.scene.made_by and not self.is_elsewhere
        of_map = {"field": job.field, "map-frames": job.frames}
        options = {
            "format": self.scene.format,
            **({"map-from": job.folder} if self.is_elsewhere else of_map),
            "tracker": self.tracker, "rate": self.rate_hz, "steps": self.steps, "start": self.start,
            "frames": self.frames, "seed": self.seed, "device": choose_device().type,
            "threads": self.n_threads, "preset": preset.name,
        }  # fmt: skip
        given = [f"--{name}={value}" for name, value in options.items() if value is not None]
        settings = changed_settings(preset, PRESETS[preset.name])
        if self.is_elsewhere:
            settings = [text for text in settings if not text.startswith(OF_MAPS)]
        settings = [f"--set={text}" for text in settings]
        sequence = self.scene.name if is_room else str(self.scene.folder)
        words = ["python", "-m", "nbtrack", "track", sequence, *settings, *given]
        return shlex.join([*words, "--out", f"again_{self.name}"])
