"""Runs as jobs: a camera tracked in a map, its errors, and where they come from."""

import shlex
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nbtrack import provenance
from nbtrack.beyond.verdict import score_detection
from nbtrack.checks.belongs import check_belongs, in_world_of_map
from nbtrack.checks.in_map import look_in_map
from nbtrack.core import files
from nbtrack.core.device import choose_device, device_name, threads
from nbtrack.core.errors import DataError
from nbtrack.core.settings import as_dict, changed_settings
from nbtrack.data.frame import Frame
from nbtrack.experiments import IMPORTED
from nbtrack.experiments.jobs import Job, Report
from nbtrack.experiments.map_jobs import PLAIN_PRESET, GivenMap, MapJob
from nbtrack.experiments.presets import PRESETS, SIZES
from nbtrack.experiments.runs import METRICS_FILE
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import field_class
from nbtrack.mapping.files import Map
from nbtrack.recordings.reading import parse_frames, select_frames
from nbtrack.tracking import Trajectory, make_budget, make_tracker, track_sequence, tracker_class
from nbtrack.tracking.metrics import still_metrics, trajectory_metrics
from nbtrack.tracking.reach import reach_metrics
from nbtrack.tracking.starts import expected_poses
from nbtrack.tracking.tracker import TrackerSettings
from nbtrack.tracking.trajectories import shifted, tum_text

RUN_FILE = "run.pt"
_OTHER_WORLD = (
    "the recording's poses are in another world than the map: they were moved into it by the one "
    "rigid motion that explains the difference, and errors are those that remain"
)
_MAP_SETTINGS = ("network", "settings", "correction")  # in the record of a map
# For the work of runs, measured with `smoke` on one core.
_QUERIES_A_SECOND = 60_000  # of a network
_NO_NETWORK = 0.05  # of a query's time: where a grid or points are asked


@dataclass(frozen=True)
class TrackJob(Job):
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    needs: MapJob | GivenMap
    scene: Scene  # the mapped one, or another recording of the same room
    tracker: str
    settings: TrackerSettings
    steps: float | int | None = None
    rate_hz: float | int | None = None
    frames: str = ":"
    seed: int = 0
    out: Path | None = None
    n_threads: int | None = None  # CPU threads to track with; by default the process's
    start: str = "given"  # the first frame's true pose, where known; or "unknown"

    kind, doing = "tracks", "tracking"

    @cached_property
    def key(self) -> str:
        """A digest of code, map, tracker, budget, threads, frames, seed; by the clock, machine."""
        kinds = tracker_class(self.tracker), field_class(self.needs.field)
        code = provenance.code_fingerprint(*kinds)
        clock = None if self.rate_hz is None else (self.rate_hz, device_name(choose_device()))
        how = self.tracker, self.settings, self.steps, clock, self.n_threads, self.start
        what = self.frames, self.seed, self.scene.fingerprint
        return files.fingerprint(code, provenance.versions(), self.needs.key, *how, *what)

    @property
    def name(self) -> str:
        """Scene, method and budget, and the seed if it is not the first."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        elsewhere = "-unmapped" if self.is_elsewhere else ""
        name = f"{self.scene.name}-{self.needs.field}-{self.tracker}{elsewhere}-{budget}"
        return f"{name}-seed{self.seed}" if self.seed else name

    @property
    def work(self) -> float:
        """Frames x steps x pixels x samples of a ray; by the clock, its seconds."""
        own = Counter(vars(self.settings))
        n_frames = len(self.scene.recording.times[parse_frames(self.frames)])
        if self.rate_hz:
            return n_frames / self.rate_hz * _QUERIES_A_SECOND
        a_step = own["n_pixels"] * max(1, own["n_stratified"] + own["n_importance"])
        price = _NO_NETWORK if tracker_class(self.tracker).converges else 1.0
        return n_frames * self.steps * a_step * price

    @property
    def is_elsewhere(self) -> bool:
        """Whether the map was made from another recording."""
        made = self.needs
        return isinstance(made, GivenMap) or self.scene.folder != made.scene.folder

    @property
    def is_done(self) -> bool:
        """Whether the run is finished; in a folder of the user's it is always made anew."""
        return self.out is None and (self.folder / METRICS_FILE).is_file()

    def check(self) -> None:
        """Raises ConfigError or DataError, before anything is made, where a run cannot begin."""
        recording = self.scene.recording
        frame_ids = select_frames(recording, parse_frames(self.frames), needs_poses=False)
        expected_poses(self.settings.motion_model, [np.eye(4)])
        if self.start == "unknown" or not recording.has_pose[frame_ids[0]]:
            tracker_class(self.tracker).check_finds(in_corrected=self.needs.correction > 0)

    def result(self) -> dict[str, Any]:
        """What a finished run keeps: errors, speed, device, versions, settings."""
        path = self.folder / METRICS_FILE
        metrics = files.read_json(path)
        if metrics.get("key") != self.key:
            raise DataError(f"{path} is not what this run has written: remove {self.folder}")
        return metrics

    def compute(self, report: Report) -> dict[str, Any]:
        """Track, or take a killed run up where its last checkpoint stands; write the files.

        `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without the first
        one, whose pose was given: so public tools report the error of the paper's formula. Where no
        true pose is known there is no `groundtruth.txt`. Raises DataError where a given map does
        not fit the first frame at its given pose.
        """
        n_threads = self.n_threads or torch.get_num_threads()
        with threads(n_threads):
            tracked, notes = self._tracked(report)
        if notes["map_warning"] == _OTHER_WORLD:
            tracked, is_explained = in_world_of_map(tracked)
            notes["map_warning"] = _OTHER_WORLD if is_explained else None
        metrics = _scores(tracked) | self._provenance(n_threads) | notes
        times = tracked.frames["time"].to_numpy()
        origin = np.array(notes["origin"])
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
        (self.cache / RUN_FILE).unlink(missing_ok=True)
        return metrics

    def _tracked(self, report: Report) -> tuple[Trajectory, dict[str, Any]]:
        """The trajectory, and what is to be said of the run beside its errors."""
        finished_map = self.needs.map()
        budget = make_budget(self.steps, self.rate_hz)
        origin = np.array(finished_map.record["origin"])
        sequence = self.scene.read(self.frames, needs_poses=False, origin=origin)
        notes = {"map_seconds": finished_map.record["seconds"], "budget": str(budget)}
        notes |= {"origin": origin.tolist(), **still_metrics(sequence.T_world_camera)}
        metres_per_unit = finished_map.field.bounds.metres_per_unit
        notes["metres_per_unit"] = metres_per_unit
        if self.is_elsewhere:
            notes["map_from"] = finished_map.record
        T_first = sequence.T_world_camera[0]
        is_start_known = self.start == "given" and bool(np.isfinite(T_first).all())
        notes["map_warning"] = self._map_warning(finished_map, sequence[0], is_start_known)
        notes["start"] = "given" if is_start_known else "unknown"
        T_start = T_first if is_start_known else np.eye(4)
        how = T_start, budget, self.settings, self.seed
        tracker = make_tracker(self.tracker, finished_map.field, *how)
        notes["device"] = device_name(tracker.device)  # LM and ICP run on the host

        def tell(done: int, error_m: float) -> None:
            status = f"frame {done}" if np.isnan(error_m) else f"off by {100 * error_m:.1f} cm"
            report(done / len(sequence), status)

        checkpoint = self.cache / RUN_FILE  # a folder of the user's holds results alone
        tracked = track_sequence(tracker, sequence, checkpoint, tell, is_start_known)
        reach = self.settings.reach(tracked.frames["steps"].mean(), metres_per_unit)
        how = sequence.T_world_camera, self.settings.motion_model
        if isinstance(self.needs, GivenMap):
            followed = sequence.select(slice(len(sequence) - len(tracked.frames), None))
            if notes["map_warning"] == _OTHER_WORLD:
                followed = replace(followed, T_world_camera=tracked.T_estimated)
            notes |= look_in_map(finished_map.field, followed, tracked.T_estimated)
        return tracked, notes | reach_metrics(reach, *how)

    def _map_warning(self, finished_map: Map, first: Frame, is_start_known: bool) -> str | None:
        """What to say of a given map; DataError where it does not fit the pose to start from.

        Where that is not used, and the map does not fit it, the recording has a world of its own.
        """
        if not isinstance(self.needs, GivenMap) or first.T_world_camera is None:
            return None  # another path of a room may begin where no map reaches
        try:
            return check_belongs(finished_map, first)
        except DataError:
            if is_start_known:
                raise
            return _OTHER_WORLD

    def _provenance(self, n_threads: int) -> dict[str, Any]:
        """Where a run comes from: data, map, method, settings, machine; how to make it again."""
        finished = self.needs.map()
        return {
            "threads": n_threads,
            "scene": self.scene.name,
            "field": self.needs.field,
            "tracker": self.tracker,
            "seed": self.seed,
            "key": self.key,
            "versions": provenance.versions(),
            "command": self._command(),
            "recording": str(self.scene.folder),
            "format": self.scene.format,
            "map": str(self.needs.folder.resolve()),
            "map_key": finished.key,
            "config": as_dict(self.settings),
            "map_config": {name: finished.record.get(name) for name in _MAP_SETTINGS},
        }

    def _command(self) -> str:
        """What makes this run anew, and its map where that is not cached."""
        options = {"tracker": self.tracker, "rate": self.rate_hz, "steps": self.steps}
        options |= {"start": self.start, "frames": self.frames, "seed": self.seed}
        options |= {"device": choose_device().type, "threads": self.n_threads}
        options |= {"format": self.scene.format, "preset": PLAIN_PRESET}
        settings: dict[str, Any] = {"tracking": {self.tracker: self.settings}}
        if self.is_elsewhere:
            options["map-from"] = self.needs.folder
        else:
            options |= {"field": self.needs.field, "map-frames": self.needs.frames}
            settings |= self.needs.setting_tree()
        sequence = str(self.scene.folder)
        if self.scene.made and not self.is_elsewhere:
            sequence = self.scene.name
            made = self.scene.made
            settings["scenes"] = {name: getattr(made, name) for name in SIZES}
        plain = PRESETS[PLAIN_PRESET].settings
        words = [f"--set={text}" for text in changed_settings(settings, plain)]
        words += [f"--{name}={value}" for name, value in options.items() if value is not None]
        words += [f"--import={source}" for source in IMPORTED]
        words = ["python", "-m", "nbtrack", "track", sequence, *words]
        return shlex.join([*words, "--out", f"again_{self.name}"])


def _scores(tracked: Trajectory) -> dict[str, Any]:
    """Errors of a run, the tracker's own verdicts against them, and its speed."""
    rows = tracked.frames
    metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true)
    if "lost" in rows:
        rated = rows.dropna(subset="translation_error_m")
        errors_m = rated["translation_error_m"].to_numpy()
        metrics["flagged_frames"] = int(rows["lost"].sum())
        metrics |= score_detection(rated["lost"].to_numpy(dtype=bool), errors_m)
    steps = int(rows["steps"].sum())
    seconds = rows["seconds"]
    return {
        **metrics,
        "frames_without_depth": int(rows["without_depth"].sum()),
        "steps_per_frame": steps / len(rows),
        "seconds_per_step": float(seconds.sum()) / max(steps, 1),
        "seconds_per_frame": float(seconds.mean()),
    }
