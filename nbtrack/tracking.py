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

from nbtrack.budget import Budget
from nbtrack.config import TrackingConfig
from nbtrack.data import Sequence
from nbtrack.device import naming_what_to_lower, suitable_threads, synchronize
from nbtrack.errors import DataError, NumericalError
from nbtrack.fields import Field
from nbtrack.metrics import rotation_errors_deg, translation_errors
from nbtrack.motion_models import motion_model
from nbtrack.sampling import PixelSampler
from nbtrack.storage import read_checkpoint, write_bytes_atomic
from nbtrack.trackers import Tracker, tracker_class

CHECKPOINT_SECONDS = 10.0  # between two checkpoints: what a killed run loses at most

OnFrame = Callable[[int, float], None]


@dataclass(frozen=True)
class TrackedSequence:
    """Estimated and true poses of a tracked sequence, the given first frame included."""

    T_estimated: Float[np.ndarray, "frames 4 4"]  # camera to world, OpenCV axes
    T_true: Float[np.ndarray, "frames 4 4"]
    # One row a frame: id, steps, seconds, loss, errors (m and degrees).
    frames: pd.DataFrame


def track_sequence(
    tracker_name: str,
    field: Field,
    sequence: Sequence,
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
    dropped.

    Args:
        checkpoint: file that is written every few seconds and, where it exists, resumed from; it
            must be one of the same run. A resumed run goes on as if it had not stopped.
        on_frame: called with the index in the sequence and the translation error (m).

    Raises:
        ConfigError: the tracker or the motion model is unknown.
        DataError: there are fewer than two frames, or a frame has no measured depth.
        NumericalError: a pose is not finite, with the frame where that began.
        OutOfMemory: the device holds too few pixels at once.
    """
    device = device or torch.device("cpu")
    if len(sequence) < 2:
        raise DataError(f"{sequence!r} is too short to track: give at least two frames")
    setting = f"tracking.{tracker_name}.n_pixels={config.n_pixels}"
    with naming_what_to_lower(setting), suitable_threads(_widest_layer(field)):
        run = _Run(tracker_name, field, sequence, budget, config, seed, device)
        if checkpoint and checkpoint.exists():
            run.load(checkpoint)
        last_saved = time.perf_counter()
        while len(run.estimates) < len(sequence):
            run.advance()
            if on_frame:
                on_frame(len(run.estimates) - 1, run.rows[-1]["translation_error_m"])
            if checkpoint and time.perf_counter() - last_saved > CHECKPOINT_SECONDS:
                run.save(checkpoint)
                last_saved = time.perf_counter()
    return TrackedSequence(
        np.stack(run.estimates), sequence.T_world_camera, pd.DataFrame(run.rows)
    )


class _Run:
    """All that changes while a sequence is tracked, and nothing else."""

    def __init__(
        self,
        tracker_name: str,
        field: Field,
        sequence: Sequence,
        budget: Budget,
        config: TrackingConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        self.sequence, self.budget, self.device = sequence, budget, device
        self.predict = motion_model(config.motion_model)
        sampler = PixelSampler(sequence, device)

        def fresh_tracker() -> Tracker:
            generator = torch.Generator(device).manual_seed(seed)
            return tracker_class(tracker_name)(field, sampler, config, generator)

        self.tracker = fresh_tracker()
        self._check_measured(1)
        _warm_up(fresh_tracker(), sequence, device)
        self.estimates = [sequence.T_world_camera[0]]
        self.rows = [_frame_row(sequence, 0, 0, 0.0, float("nan"), self.estimates[0])]

    def advance(self) -> None:
        """Estimate the pose of the next frame."""
        index = len(self.estimates)
        self._check_measured(index)
        start = time.perf_counter()
        T_starts = torch.from_numpy(np.stack(self.predict(self.estimates))).float()
        self.tracker.start_frame(index, T_starts.to(self.device))
        steps, loss = 0, torch.tensor(float("nan"))
        for _ in self.budget.frame():
            loss = self.tracker.step()
            steps += 1
            if self.tracker.is_converged:
                break
        synchronize(self.device)
        seconds = time.perf_counter() - start
        pose = _checked_pose(self.tracker.T_world_camera, self.sequence, index, steps)
        self.estimates.append(pose)
        row = _frame_row(self.sequence, index, steps, seconds, float(loss), pose)
        self.rows.append(row | self.tracker.report())

    def save(self, checkpoint: Path) -> None:
        buffer = io.BytesIO()
        torch.save(
            {
                "estimates": torch.from_numpy(np.stack(self.estimates)),
                "rows": self.rows,
                "tracker": self.tracker.state(),
                "budget": self.budget.state(),
            },
            buffer,
        )
        write_bytes_atomic(checkpoint, buffer.getvalue())

    def load(self, checkpoint: Path) -> None:
        state = read_checkpoint(checkpoint)
        self.estimates = list(state["estimates"].numpy())
        self.rows = state["rows"]
        self.tracker.restore(state["tracker"])
        self.budget.restore(state["budget"])


    def _check_measured(self, index: int) -> None:
        if self.tracker.copes_without_depth or self.sequence.depths_mm[index].any():
            return
        raise DataError(
            f"frame {self.sequence.frame_ids[index]} of {self.sequence.name} has no measured "
            "depth: this tracker needs some; leave the frame out with --frames"
        )


def _warm_up(tracker: Tracker, sequence: Sequence, device: torch.device) -> None:
    """One step that counts nowhere: first calls load and allocate for a second or more."""
    T_world_camera = torch.from_numpy(sequence.T_world_camera[0]).float().to(device)
    tracker.start_frame(1, T_world_camera[None])
    tracker.step()
    synchronize(device)


def _frame_row(
    sequence: Sequence,
    index: int,
    steps: int,
    seconds: float,
    loss: float,
    T_estimated: Float[np.ndarray, "4 4"],
) -> dict[str, float | int]:
    T_true = sequence.T_world_camera[index : index + 1]
    return {
        "frame_id": int(sequence.frame_ids[index]),
        "steps": steps,
        "seconds": seconds,
        "loss": loss,
        "translation_error_m": float(translation_errors(T_estimated[None], T_true)[0]),
        "rotation_error_deg": float(rotation_errors_deg(T_estimated[None], T_true)[0]),
    }


def _checked_pose(
    T_world_camera: Float[torch.Tensor, "4 4"], sequence: Sequence, index: int, steps: int
) -> Float[np.ndarray, "4 4"]:
    pose = T_world_camera.cpu().double().numpy()
    if not np.isfinite(pose).all():
        raise NumericalError(
            f"the pose of frame {sequence.frame_ids[index]} of {sequence.name} stopped being "
            f"finite within {steps} steps: lower the learning rates or map for longer"
        )
    return pose


def _widest_layer(field: Field) -> int:
    widths = [parameter.shape[0] for parameter in field.parameters() if parameter.dim()]
    return max(widths, default=0)  # 0: a grid or a cloud of points, which one thread serves best
