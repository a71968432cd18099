"""Track a camera through a sequence in a known map: one thin loop for every tracker."""

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float

from nbtrack.core.config import TrackingConfig
from nbtrack.core.device import advise_on_memory
from nbtrack.core.errors import DataError
from nbtrack.core.files import naming_damaged, read_checkpoint, write_bytes_atomic
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.tracking.budget import Budget
from nbtrack.tracking.frame_search import FrameEstimate, FrameSearch, tracking_threads
from nbtrack.tracking.metrics import rotation_errors_deg, translation_errors

CHECKPOINT_SECONDS = 10.0  # between two checkpoints: what a killed run loses at most

OnFrame = Callable[[int, float], None]


@dataclass(frozen=True)
class TrackedSequence:
    """Estimated and true poses of a tracked sequence, the given first frame included."""

    T_estimated: Float[np.ndarray, "frames 4 4"]  # camera to world, OpenCV axes
    T_true: Float[np.ndarray, "frames 4 4"]
    # One row a frame: id, steps, seconds, loss, errors (m and degrees), whether without depth, and
    # what the tracker says itself.
    frames: pd.DataFrame


def track_sequence(
    tracker_name: str,
    field: Field,
    sequence: RgbdSequence,
    budget: Budget,
    config: TrackingConfig,
    seed: int = 0,
    device: torch.device | None = None,
    checkpoint: Path | None = None,
    on_frame: OnFrame | None = None,
) -> TrackedSequence:
    """Estimate every frame's pose from the first frame's true one.

    Each frame starts where the motion model puts it, by default at the estimate of the frame
    before. Source: paper, Sec. I-A and the evaluation protocol: every frame is processed, none is
    dropped; one without any depth keeps the pose that the motion model expects, and is marked.

    Args:
        checkpoint: file that is written every few seconds and, where it exists, resumed from; it
            must be one of the same run. A resumed run goes on as if it had not stopped.
        on_frame: called with the index in the sequence and the translation error (m).

    Raises:
        ConfigError: the tracker or the motion model is unknown.
        DataError: there are fewer than two frames, or none of them has a measured depth.
        NumericalError: a pose is not finite, with the frame where that began.
        OutOfMemory: the device holds too few pixels at once.
    """
    device = device or torch.device("cpu")
    _check_trackable(sequence)
    setting = f"tracking.{tracker_name}.n_pixels={config.n_pixels}"
    with advise_on_memory(setting), tracking_threads(field):
        run = _Run(tracker_name, field, sequence, budget, config, seed, device)
        if checkpoint and checkpoint.exists():
            run.load(checkpoint)
        last_saved = time.perf_counter()
        while len(run.rows) < len(sequence):
            run.advance()
            if on_frame:
                on_frame(len(run.rows) - 1, run.rows[-1]["translation_error_m"])
            if checkpoint and time.perf_counter() - last_saved > CHECKPOINT_SECONDS:
                run.save(checkpoint)
                last_saved = time.perf_counter()
    return TrackedSequence(
        np.stack(run.search.estimates), sequence.T_world_camera, pd.DataFrame(run.rows)
    )


class _Run:
    """All that changes while a sequence is tracked, and nothing else."""

    def __init__(
        self,
        tracker_name: str,
        field: Field,
        sequence: RgbdSequence,
        budget: Budget,
        config: TrackingConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        self.sequence = sequence
        T_first = sequence.T_world_camera[0]
        sampler = PixelSampler(sequence, device)
        self.search = FrameSearch(tracker_name, field, sampler, budget, config, seed, T_first)
        self.search.warm_up(next(i for i, depth in enumerate(sequence.depths_mm) if depth.any()))
        given = FrameEstimate(T_first, 0, 0.0, float("nan"), not sequence.depths_mm[0].any(), {})
        self.rows = [_frame_row(sequence, 0, given)]

    def advance(self) -> None:
        """Estimate the pose of the next frame."""
        index = len(self.rows)
        called = f"frame {self.sequence.frame_ids[index]} of {self.sequence.name}"
        self.rows.append(_frame_row(self.sequence, index, self.search.find(index, called)))

    def save(self, checkpoint: Path) -> None:
        buffer = io.BytesIO()
        torch.save({"rows": self.rows, **self.search.state()}, buffer)
        write_bytes_atomic(checkpoint, buffer.getvalue())

    def load(self, checkpoint: Path) -> None:
        state = read_checkpoint(checkpoint)
        with naming_damaged(checkpoint):
            self.search.restore(state)
            self.rows = state["rows"]


def _check_trackable(sequence: RgbdSequence) -> None:
    if len(sequence) < 2:
        raise DataError(f"{sequence!r} is too short to track: give at least two frames")
    if not sequence.depths_mm.any():
        raise DataError(
            f"no frame of {sequence.name} has a measured depth, and trackers need some: check the "
            "depth folder and its unit (uint16 millimetres), or choose other --frames"
        )


def _frame_row(
    sequence: RgbdSequence, index: int, estimate: FrameEstimate
) -> dict[str, float | int | bool]:
    T_estimated = estimate.T_world_camera[None]
    T_true = sequence.T_world_camera[index : index + 1]
    return {
        "frame_id": int(sequence.frame_ids[index]),
        "steps": estimate.steps,
        "seconds": estimate.seconds,
        "loss": estimate.loss,
        "translation_error_m": float(translation_errors(T_estimated, T_true)[0]),
        "rotation_error_deg": float(rotation_errors_deg(T_estimated, T_true)[0]),
        "without_depth": bool(estimate.without_depth),
        **estimate.report,
    }
