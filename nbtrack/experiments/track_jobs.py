"""Runs as jobs. In a run a camera is tracked in a map; errors and their provenance are stored."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from nbtrack import provenance
from nbtrack.checks.in_map import check_belongs, in_world_of_map, outside_map_share
from nbtrack.core.arrays import Pose, Poses
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.jobs import Job, Report
from nbtrack.experiments.map_jobs import MapJob, map_unit
from nbtrack.experiments.presets import SIZES, default_settings
from nbtrack.experiments.runs import METRICS_FILE, scores_of, write_run
from nbtrack.experiments.scenes import Scene
from nbtrack.machinery import files
from nbtrack.machinery.device import choose_device, device_name
from nbtrack.machinery.errors import DataError, NbtrackError
from nbtrack.machinery.inputs import read_object
from nbtrack.machinery.registry import command_line
from nbtrack.machinery.settings import as_dict, changed_settings
from nbtrack.mapping.files import Map
from nbtrack.tracking import Trajectory, make_budget, make_tracker, track_sequence, tracker_class
from nbtrack.tracking.metrics import LOST_THRESHOLD_M, still_metrics
from nbtrack.tracking.reach import reach_metrics
from nbtrack.tracking.tracker import TrackerSettings

RUN_FILE = "run.pt"
_OTHER_WORLD = (
    "the recording's poses are in another world than the map: they were moved into it by the one "
    "rigid motion that explains the difference, and errors are those that remain"
)
_UNEXPLAINED = (
    "the recording does not fit the map, and no rigid motion of its poses explains that: it is of "
    "another place, the camera was not found, or too few poses are known; errors mean nothing"
)
# A user is warned before a run if one of these numbers is larger (our choice). Smaller ones do no
# harm: a hand starts and stops, and the search catches up.
_GREEDY_ATE = 0.01  # m, the ATE of a greedy search that moves no farther than the run's tracker
_SHARE = 0.5  # the share of frames in which the camera moves farther than the search reaches


@dataclass(frozen=True)
class TrackJob(Job):
    """One tracked run in a map, with a number of steps for each frame, or a rate by the clock."""

    needs: MapJob
    scene: Scene  # the one that was mapped, or another recording of the same room
    tracker: str
    settings: TrackerSettings
    steps: float | int | None = None  # for each frame; None by the clock
    rate_hz: float | int | None = None  # by the clock a frame gets 1/rate seconds; None by steps
    frames: str = ":"  # the slice of the scene's frames that are tracked
    seed: int = 0
    start: str = "given"  # at the first frame's true pose, if it is known; or "unknown"

    kind, doing = "tracks", "tracking"

    @cached_property
    def key(self) -> str:
        """A digest of code, versions, map, recording, tracker, settings, budget, frames and seed.

        By the clock the result also depends on the device and the number of threads.
        """
        # Of the tracker's class. The map's key holds the code of the field's class.
        code = provenance.code_fingerprint(tracker_class(self.tracker))
        clock = self.rate_hz, device_name(choose_device()), torch.get_num_threads()
        budget = self.steps if self.rate_hz is None else clock
        recipe = self.tracker, self.settings, self.start, self.frames, self.seed, budget
        inputs = self.needs.key, self.scene.fingerprint, code, provenance.versions()
        return files.fingerprint(*recipe, *inputs)

    @property
    def name(self) -> str:
        """The scene, the method and the budget, and the seed if it is not 0."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        elsewhere = "-unmapped" if self.is_elsewhere else ""
        name = f"{self.scene.name}-{self.needs.field}-{self.tracker}{elsewhere}-{budget}"
        return f"{name}-seed{self.seed}" if self.seed else name

    @property
    def is_timed(self) -> bool:
        """Whether it tracks by the clock: other work beside it would leave it fewer steps."""
        return self.rate_hz is not None

    @property
    def is_elsewhere(self) -> bool:
        """Whether the map was made from another recording than the one that is tracked."""
        return self.needs.given is not None or self.needs.scene.folder != self.scene.folder

    @property
    def is_done(self) -> bool:
        """Whether the run is finished."""
        return (self.folder / METRICS_FILE).is_file()

    def _true_path(self) -> Poses:
        """True poses (m) of the tracked frames, NaN if unknown.

        Raises DataError if the text of the slice is wrong, or if it selects no frame.
        """
        return self.scene.recording.T_world_camera[self.scene.select(self.frames, False)]

    def check(self) -> None:
        """Raises ConfigError or DataError, before anything is made, if the run cannot begin."""
        T_first = self._true_path()[0]
        if not self._starts_at(T_first):  # the tracker then has to find the camera in the map
            tracker_class(self.tracker).check_finds(in_corrected=self.needs.correction_voxel > 0)

    def expected_reach(self) -> dict[str, float]:
        """The `reach_metrics` of the run, before it is made.

        They are empty for a run by the clock, whose number of steps is not known in advance, and if
        they cannot be computed.
        """
        if self.steps is not None:
            with contextlib.suppress(NbtrackError):  # the run will raise the error, too
                reach = self.settings.reach(self.steps, map_unit(self.needs))
                return reach_metrics(reach, self._true_path(), self.settings.motion_model)
        return {}

    def result(self) -> dict[str, Any]:
        """The stored metrics of the finished run: errors, speed, device, versions, settings."""
        path = self.folder / METRICS_FILE
        metrics = read_object(path)
        if metrics.get("key") != self.key:
            raise DataError(f"{path} is not what this run has written: remove {self.folder}")
        return metrics

    def compute(self, report: Report) -> dict[str, Any]:
        """Track, or go on from the last checkpoint of a killed run; write the files.

        Returns the metrics. Raises DataError if a given map does not fit the first frame at its
        given pose.
        """
        finished = self.needs.map()
        origin = np.array(finished.record["origin"])
        sequence = self.scene.read(self.frames, needs_poses=False, origin=origin)
        warning = self._map_warning(finished, sequence)

        def report_frame(done: int, error_m: float) -> None:
            status = f"frame {done}" if np.isnan(error_m) else f"off by {100 * error_m:.1f} cm"
            report(done / len(sequence), status)

        T_first = sequence.T_world_camera[0]
        is_start_known = self._starts_at(T_first)
        field, budget = finished.field, make_budget(self.steps, self.rate_hz)
        T_start = T_first
        if not is_start_known:  # a placeholder: the camera is found
            T_start = np.eye(4)
            T_start[:3, 3] = field.bounds.center
        tracker = make_tracker(self.tracker, field, T_start, budget, self.settings, self.seed)
        checkpoint = self.folder / RUN_FILE
        tracked = track_sequence(tracker, sequence, checkpoint, report_frame, is_start_known)
        notes = self._notes(finished, sequence, tracked, warning)
        notes["device"] = device_name(tracker.device)  # the CPU for LM and ICP
        if warning == _OTHER_WORLD:  # moves the true poses into the map's world, for the errors
            tracked, is_explained = in_world_of_map(tracked)
            if not is_explained:
                # If most frames fit, only the first was off, as where the map ends. NaN never fits.
                fits = tracked.frames["translation_error_m"].median() <= LOST_THRESHOLD_M
                notes["map_warning"] = None if fits else _UNEXPLAINED
        metrics = scores_of(tracked) | self._provenance(finished) | notes
        write_run(self.folder, replace(tracked, metrics=metrics))
        checkpoint.unlink(missing_ok=True)
        return metrics

    def _starts_at(self, T_first: Pose) -> bool:
        """Whether the run starts at the first frame's pose; if not, the camera is found first."""
        return self.start == "given" and bool(np.isfinite(T_first).all())

    def _map_warning(self, finished: Map, sequence: RgbdSequence) -> str | None:
        """A warning if a given map may not fit the first frame with a pose; None if it fits.

        If the frame has no depth, the warning says that the fit cannot be checked. If the map does
        not fit at the recording's pose, it is `_OTHER_WORLD`; a run that starts at that pose raises
        DataError instead.
        """
        # A map that was made here is not checked. It is of the right room, and a path in the room
        # may begin where the map does not reach.
        posed = np.flatnonzero(np.isfinite(sequence.T_world_camera).all(axis=(1, 2)))
        if not (self.needs.given and len(posed)):
            return None
        try:
            return check_belongs(finished, sequence[posed[0]])
        except DataError:
            if self._starts_at(sequence.T_world_camera[0]):
                raise
            return _OTHER_WORLD

    def _notes(
        self, finished: Map, sequence: RgbdSequence, tracked: Trajectory, warning: str | None
    ) -> dict[str, Any]:
        """Metrics of a run that are neither errors nor speed.

        `warning` is what `_map_warning` returned.
        """
        T_true, T_estimated = sequence.T_world_camera, tracked.T_estimated
        unit_m = finished.field.bounds.metres_per_unit
        # 1 if the first frame's pose was given, so that the frame was not tracked; else 0.
        n_given = len(sequence) - len(tracked.frames)
        notes = {"metres_per_unit": unit_m, "map_warning": warning}
        notes["start"] = "given" if n_given else "unknown"
        if self.needs.given:
            followed = sequence.select(slice(n_given, None))
            if warning == _OTHER_WORLD:  # only the estimated poses are in the map's world
                followed = replace(followed, T_world_camera=T_estimated)
            notes["outside_map_share"] = outside_map_share(finished.field, followed, T_estimated)
        # With as many steps as a frame had in the mean: a search may end early, or by the clock.
        reach = self.settings.reach(tracked.frames["steps"].mean(), unit_m)
        reached = reach_metrics(reach, T_true, self.settings.motion_model)
        return notes | still_metrics(T_true) | reached

    def _provenance(self, finished: Map) -> dict[str, Any]:
        """The data, map, method, settings and machine of a run, and the command that repeats it."""
        return {
            "threads": torch.get_num_threads(),
            "scene": self.scene.name,
            "field": self.needs.field,
            "tracker": self.tracker,
            "seed": self.seed,
            "key": self.key,
            "versions": provenance.versions(),
            "command": self._command(),
            "recording": str(self.scene.folder),
            "recording_key": self.scene.fingerprint,
            "format": self.scene.format,
            "budget": str(make_budget(self.steps, self.rate_hz)),
            "config": as_dict(self.settings),
            "origin": finished.record["origin"],
            "map": str(self.needs.folder.resolve()),
            "map_key": finished.key,
            "map_seconds": finished.record["seconds"],
            "map_record": finished.record,
        }

    def _command(self) -> str:
        """The command that repeats this run, and makes its map if it is not cached.

        The command names a room in the cache by the room's name, so that it is made again, and any
        other recording by its folder.
        """
        options = {"tracker": self.tracker, "rate": self.rate_hz, "steps": self.steps}
        options |= {"start": self.start, "frames": self.frames, "seed": self.seed}
        options |= {"format": self.scene.format, "device": choose_device().type}
        # This preset has the default settings, with which `changed_settings` compares below.
        options["preset"] = "synthetic"
        settings: dict[str, Any] = {"tracking": {self.tracker: self.settings}}
        sequence = str(self.scene.folder)
        map_job = self.needs
        if self.is_elsewhere:
            options["map-from"] = files.absolute(map_job.folder)
        else:
            options |= {"field": map_job.field, "map-frames": map_job.frames}
            settings |= map_job.setting_tree
            if self.scene.made:
                sequence = self.scene.name
                settings["scenes"] = {name: getattr(self.scene.made, name) for name in SIZES}
        words = [f"--set={text}" for text in changed_settings(settings, default_settings())]
        words += [f"--{name}={value}" for name, value in options.items() if value is not None]
        return command_line("track", sequence, *words, "--out", f"again_{self.name}")


def reach_warnings(runs: Sequence[TrackJob]) -> Iterator[str]:
    """Warnings of runs whose search cannot follow the camera, however good the map is.

    Runs with the same tracker, settings and steps share one line. It is about the run in which a
    greedy search of the same reach has the largest ATE.
    """
    worst: dict[tuple, tuple[TrackJob, dict[str, float]]] = {}
    for run in runs:
        reach = run.expected_reach()
        ate_m, share = (reach.get(name, 0.0) for name in ("greedy_ate_m", "beyond_reach_share"))
        if ate_m <= _GREEDY_ATE and share <= _SHARE:
            continue
        key = run.tracker, repr(run.settings), run.steps
        if key not in worst or ate_m > worst[key][1]["greedy_ate_m"]:
            worst[key] = run, reach
    for run, reach in worst.values():
        advice = "take more steps, a lower rate, "
        if run.settings.motion_model == "previous_pose":
            advice += f"--set tracking.{run.tracker}.motion_model=constant_velocity, "
        yield (
            f"{run.steps:g} steps of {run.tracker} move the camera by at most "
            f"{1e3 * reach['reach_m']:.1f} mm along an axis and {reach['reach_deg']:.2f} deg about "
            f"it; it moves farther in {reach['beyond_reach_share']:.0%} of the frames of "
            f"{run.scene.name}, where a greedy follower has an ATE of {reach['greedy_ate_m']:.3f} "
            f"m: {advice}or --method corrected"
        )
