"""Tracks a camera through a recorded sequence; the result is a trajectory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nbtrack.core.arrays import Poses
from nbtrack.data.sequence import RgbdSequence
from nbtrack.machinery import files
from nbtrack.machinery.device import advise_on_memory
from nbtrack.machinery.errors import ConfigError, DataError, typed
from nbtrack.machinery.settings import as_dict
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.metrics import pose_errors
from nbtrack.tracking.tracker import Estimate, Tracker

STEPS_TO_FIND = 1000  # steps per frame to find an unknown pose; `LmTracker` takes at most 61


@dataclass(frozen=True)
class Trajectory:
    """The poses of all tracked frames. A first frame whose pose was given is not among them."""

    T_estimated: Poses  # camera to world, m, OpenCV axes
    T_true: Poses  # NaN if unknown
    frames: pd.DataFrame  # a row for each frame: id, time, steps, seconds, loss, errors, report
    metrics: dict[str, Any] = field(default_factory=dict)  # of a finished run that was written


@typed
def track_sequence(
    tracker: Tracker,
    sequence: RgbdSequence,
    checkpoint: Path | str | None = None,
    on_frame: Callable[[int, float], object] = lambda index, error_m: None,
    is_start_known: bool = True,
) -> Trajectory:
    """Track all frames of a sequence, beginning with the first frame's true pose.

    If the start is not known, the first frame is tracked, too. Every frame then has `STEPS_TO_FIND`
    steps, whatever the budget, until the tracker has found the camera (our choice). The file
    `checkpoint` is written every few seconds; a killed run goes on from it. `on_frame` is told the
    index of each frame and its translation error (m; NaN if the true pose is unknown).

    Raises DataError for fewer than two frames, no depth in any frame, no pose of a known start, or
    another run's checkpoint. Source: paper, Sec. I-A and evaluation protocol (no frame is dropped).
    """
    _check_trackable(sequence)
    recipe = _recipe(tracker, sequence, is_start_known) if checkpoint else {}
    file, rows = files.Checkpoint(checkpoint, recipe), []

    def take_up(state: dict[str, Any]) -> None:
        tracker.restore(state["tracker"])
        rows.extend(state["rows"])

    first = 1 if is_start_known else 0  # the first frame to track
    if is_start_known:
        tracker.restart(sequence.T_world_camera[0])
    else:
        tracker.restart_anywhere()
    with advise_on_memory(f"tracking.{tracker.name}.n_pixels={tracker.settings.n_pixels}"):
        file.resume(take_up)
        for index in range(first + len(rows), len(sequence)):
            is_lost = not is_start_known and all(row.get("lost", False) for row in rows)
            budget = StepBudget(STEPS_TO_FIND) if is_lost else None  # None: the tracker's own
            rows.append(_row(sequence, index, tracker.track(sequence[index], budget)))
            on_frame(index, rows[-1]["translation_error_m"])
            file.save(lambda: {"rows": rows, "tracker": tracker.state()})
    T_estimated = np.stack(tracker.estimates[1:])  # the first estimate is the start, not a frame's
    return Trajectory(T_estimated, sequence.T_world_camera[first:].copy(), _table_of(rows))


def _table_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """The rows of frames as a table. If the tracker judges its estimates, `lost` is in all rows.

    A frame without depth counts as lost: the tracker may not have searched and judged it.
    """
    frames = pd.DataFrame(rows)
    if "lost" in frames:
        frames["lost"] = frames["lost"].eq(True) | frames["without_depth"]
    return frames


def _recipe(tracker: Tracker, sequence: RgbdSequence, is_start_known: bool) -> dict[str, Any]:
    """What a run depends on. The names are told to users whose checkpoint is of another run."""
    field, budget, seed = tracker.field, str(tracker.budget), tracker.generator.initial_seed()
    method = [tracker.name, as_dict(tracker.settings), budget, seed, is_start_known]
    weights = dict(chain(field.named_parameters(), field.named_buffers()))
    return {"recording": sequence.digest, "map or method": files.digest_of(method, weights)}


def _check_trackable(sequence: RgbdSequence) -> None:
    """Raises DataError for fewer than two frames, or if no frame has a measured depth."""
    if len(sequence) < 2:
        raise DataError(f"{sequence!r} is too short to track: give at least two frames")
    if not sequence.depths_mm.any():
        raise DataError(f"no frame of {sequence.name} has a measured depth: check folder and unit")


def _row(sequence: RgbdSequence, index: int, estimate: Estimate) -> dict[str, Any]:
    """The row of one frame in `Trajectory.frames`; errors are NaN if the true pose is unknown."""
    T_true, T_first = sequence.T_world_camera[index], sequence.T_world_camera[0]
    error_m, error_deg = np.nan, np.nan
    if np.isfinite(T_true).all():
        (error_m,), (error_deg,) = pose_errors(estimate.T_world_camera[None], T_true[None])
    row = {
        "frame_id": int(sequence.frame_ids[index]),
        "time": float(sequence.times[index]),
        "steps": estimate.steps,
        "seconds": estimate.seconds,
        "loss": estimate.loss,
        "translation_error_m": float(error_m),
        "rotation_error_deg": float(error_deg),
        "still_error_m": float(np.linalg.norm((T_true - T_first)[:3, 3])),  # of standing still
        "without_depth": estimate.without_depth,
    }
    if taken := row.keys() & estimate.report.keys():
        raise ConfigError(f"a tracker reports {sorted(taken)}, which nbtrack fills: rename them")
    # As Python's numbers and flags, since a checkpoint cannot hold those of numpy or torch.
    return row | {name: np.asarray(value).item() for name, value in estimate.report.items()}
