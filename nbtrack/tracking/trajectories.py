"""Trajectories, tracked through a recorded sequence."""

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
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.settings import as_dict
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.metrics import pose_errors
from nbtrack.tracking.tracker import Estimate, Tracker

STEPS_TO_FIND = 1000  # a few dozen descents


@dataclass(frozen=True)
class Trajectory:
    """The tracked frames of a sequence. A first frame whose pose was given is none of them."""

    T_estimated: Poses  # camera to world, OpenCV axes
    T_true: Poses  # NaN where not known
    frames: pd.DataFrame  # a row each: id, time, steps, seconds, loss, errors, report
    metrics: dict[str, Any] = field(default_factory=dict)  # of a run that is finished and kept


def track_sequence(
    tracker: Tracker,
    sequence: RgbdSequence,
    checkpoint: Path | None = None,
    on_frame: Callable[[int, float], object] = lambda index, error_m: None,
    is_start_known: bool = True,
) -> Trajectory:
    """Estimate every frame's pose from the first frame's true one, wherever the tracker was.

    Source: paper, Sec. I-A and the evaluation protocol: every frame is processed, none is dropped.
    Where the start is not known, the first frame is tracked too, and until one frame is not lost
    each has `STEPS_TO_FIND` steps, whatever the budget (our choice).
    A checkpoint of this run is written every few seconds and resumed from; `on_frame` is told the
    index in the sequence and the translation error (m; NaN where no true pose is known). Raises
    DataError if there are fewer than two frames, or none of them has a measured depth, or the
    checkpoint is of another run.
    """
    _check_trackable(sequence)
    recipe = _recipe(tracker, sequence, is_start_known) if checkpoint else {}
    kept, rows = files.Checkpoint(checkpoint, recipe), []

    def take_up(state: dict[str, Any]) -> None:
        tracker.restore(state["tracker"])
        rows.extend(state["rows"])

    first = 1 if is_start_known else 0  # the first frame to track
    if is_start_known:
        tracker.restart(sequence.T_world_camera[0])
    else:
        tracker.restart_anywhere()
    with advise_on_memory(f"tracking.{tracker.name}.n_pixels={tracker.settings.n_pixels}"):
        kept.resume(take_up)
        for index in range(first + len(rows), len(sequence)):
            is_found = is_start_known or not all(row.get("lost", False) for row in rows)
            budget = None if is_found else StepBudget(STEPS_TO_FIND)  # None: the tracker's own
            rows.append(_row(sequence, index, tracker.track(sequence[index], budget)))
            on_frame(index, rows[-1]["translation_error_m"])
            kept.save(lambda: {"rows": rows, "tracker": tracker.state()})
    T_estimated = np.stack(tracker.estimates[1:])  # the first is the start, no tracked frame
    return Trajectory(T_estimated, sequence.T_world_camera[first:].copy(), _table_of(rows))


def _table_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """The rows of frames; where the tracker has a verdict, it is that of `Estimate.lost`.

    A frame that was not searched has no report, and is lost all the same.
    """
    frames = pd.DataFrame(rows)
    if "lost" in frames:
        frames["lost"] = frames["lost"].eq(True) | frames["without_depth"]
    return frames


def _recipe(tracker: Tracker, sequence: RgbdSequence, is_start_known: bool) -> dict[str, Any]:
    """What a run depends on, by the names that the error for another run's checkpoint gives."""
    field, budget, seed = tracker.field, str(tracker.budget), tracker.generator.initial_seed()
    method = [tracker.name, as_dict(tracker.settings), budget, seed, is_start_known]
    weights = dict(chain(field.named_parameters(), field.named_buffers()))
    return {"recording": sequence.digest, "map or method": files.digest_of(method, weights)}


def _check_trackable(sequence: RgbdSequence) -> None:
    """Raises DataError for fewer than two frames, or where no frame has a measured depth."""
    if len(sequence) < 2:
        raise DataError(f"{sequence!r} is too short to track: give at least two frames")
    if not sequence.depths_mm.any():
        raise DataError(f"no frame of {sequence.name} has a measured depth: check folder and unit")


def _row(sequence: RgbdSequence, index: int, estimate: Estimate) -> dict[str, Any]:
    """The row of one frame in `Trajectory.frames`; errors are NaN where no true pose is known."""
    T_true, T_first = sequence.T_world_camera[index], sequence.T_world_camera[0]
    error_m, error_deg = np.nan, np.nan
    if np.isfinite(T_true).all():
        (error_m,), (error_deg,) = pose_errors(estimate.T_world_camera[None], T_true[None])
    return {
        "frame_id": int(sequence.frame_ids[index]),
        "time": float(sequence.times[index]),
        "steps": estimate.steps,
        "seconds": estimate.seconds,
        "loss": estimate.loss,
        "translation_error_m": float(error_m),
        "rotation_error_deg": float(error_deg),
        "still_error_m": float(np.linalg.norm((T_true - T_first)[:3, 3])),  # of standing still
        "without_depth": estimate.without_depth,
        # Python's numbers and flags: a checkpoint holds no others.
        **{name: np.asarray(value).item() for name, value in estimate.report.items()},
    }
