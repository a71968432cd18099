"""Track a camera through a sequence in a known map: one thin loop for every tracker."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float

from nbtrack.budget import Budget
from nbtrack.config import TrackingConfig
from nbtrack.data import Sequence
from nbtrack.device import suitable_threads, synchronize
from nbtrack.errors import DataError, NumericalError
from nbtrack.fields import Field
from nbtrack.metrics import rotation_errors_deg, translation_errors
from nbtrack.sampling import PixelSampler
from nbtrack.trackers import Tracker, tracker_class

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
    on_frame: OnFrame | None = None,
) -> TrackedSequence:
    """Estimate every frame's pose from the first frame's true one.

    Each frame starts from the estimate of the frame before. Source: paper, Sec. I-A and the
    evaluation protocol: every frame is processed, none is dropped.

    Args:
        on_frame: called with the index in the sequence and the translation error (m).

    Raises:
        DataError: there are fewer than two frames, or a frame has no measured depth.
        NumericalError: a pose is not finite, with the frame where that began.
    """
    device = device or torch.device("cpu")
    if len(sequence) < 2:
        raise DataError(f"{sequence!r} is too short to track: give at least two frames")
    sampler = PixelSampler(sequence, device)

    def fresh_tracker() -> Tracker:
        generator = torch.Generator(device).manual_seed(seed)
        return tracker_class(tracker_name)(field, sampler, config, generator)

    _check_measured(sequence, 1)
    _warm_up(fresh_tracker(), sequence, device)
    tracker = fresh_tracker()
    estimates = [sequence.T_world_camera[0]]
    rows = [_frame_row(sequence, 0, 0, 0.0, float("nan"), estimates[0])]
    with suitable_threads(_widest_layer(field)):
        for index in range(1, len(sequence)):
            _check_measured(sequence, index)
            start = time.perf_counter()
            tracker.start_frame(index, torch.from_numpy(estimates[-1]).float().to(device))
            steps, loss = 0, torch.tensor(float("nan"))
            for _ in budget.frame():
                loss = tracker.step()
                steps += 1
            synchronize(device)
            seconds = time.perf_counter() - start
            estimates.append(_checked_pose(tracker.T_world_camera, sequence, index, steps))
            rows.append(_frame_row(sequence, index, steps, seconds, float(loss), estimates[-1]))
            if on_frame:
                on_frame(index, rows[-1]["translation_error_m"])
    return TrackedSequence(np.stack(estimates), sequence.T_world_camera, pd.DataFrame(rows))


def _warm_up(tracker: Tracker, sequence: Sequence, device: torch.device) -> None:
    """One step that counts nowhere: first calls load and allocate for a second or more."""
    T_world_camera = torch.from_numpy(sequence.T_world_camera[0]).float().to(device)
    tracker.start_frame(1, T_world_camera)
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
    pose = T_world_camera.double().cpu().numpy()
    if not np.isfinite(pose).all():
        raise NumericalError(
            f"the pose of frame {sequence.frame_ids[index]} of {sequence.name} stopped being "
            f"finite within {steps} steps: lower the learning rates or map for longer"
        )
    return pose


def _check_measured(sequence: Sequence, index: int) -> None:
    if not sequence.depths_mm[index].any():
        raise DataError(
            f"frame {sequence.frame_ids[index]} of {sequence.name} has no measured depth: "
            "tracking needs some; leave the frame out with --frames"
        )


def _widest_layer(field: Field) -> int:
    return max(parameter.shape[0] for parameter in field.parameters() if parameter.dim())
