"""One frame's pose after another: tracker, motion model and budget, whoever brings the frames.

`nbtrack.tracking.sequence` brings those of a recorded sequence, `nbtrack.tracking.live` those of
a running camera.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.core.config import TrackingConfig
from nbtrack.core.device import suitable_threads, synchronize
from nbtrack.core.errors import NumericalError
from nbtrack.data.pixels import PixelSampler
from nbtrack.fields import Field
from nbtrack.tracking.budget import Budget
from nbtrack.tracking.motion_models import motion_model
from nbtrack.tracking.trackers import Tracker, tracker_class


@dataclass(frozen=True)
class FrameEstimate:
    """What the search for one frame's pose came to."""

    T_world_camera: Float[np.ndarray, "4 4"]  # camera to world, OpenCV axes
    steps: int
    seconds: float
    loss: float  # before the last step; NaN without any
    without_depth: bool  # nothing was measured: the pose is the one the motion model expects
    report: dict[str, float | bool]  # what the tracker itself says, `lost` where it has a verdict

    @property
    def is_lost(self) -> bool:
        """The tracker's own verdict; a tracker without one fails only frames without depth."""
        return self.without_depth or bool(self.report.get("lost", False))


class FrameSearch:
    """All that one frame leaves to the next: the poses so far, the tracker, the budget."""

    def __init__(
        self,
        tracker_name: str,
        field: Field,
        sampler: PixelSampler,
        budget: Budget,
        config: TrackingConfig,
        seed: int,
        T_first: Float[np.ndarray, "4 4"],
    ) -> None:
        """
        Args:
            sampler: the frames; whoever gets new ones shows them to it.
            T_first: pose of the frame before the first that is searched for.
        """
        self.sampler, self.budget, self.device = sampler, budget, sampler.device
        self.predict = motion_model(config.motion_model)
        self.fresh_tracker: Callable[[], Tracker] = lambda: tracker_class(tracker_name)(
            field, sampler, config, torch.Generator(sampler.device).manual_seed(seed)
        )
        self.tracker = self.fresh_tracker()
        self.estimates = [T_first]

    def warm_up(self, frame: int) -> None:
        """One step that counts nowhere: first calls load and allocate for a second or more."""
        tracker = self.fresh_tracker()
        T_start = torch.from_numpy(self.estimates[0]).float()
        tracker.start_frame(frame, T_start[None].to(self.device))
        tracker.step()
        synchronize(self.device)

    def find(self, frame: int, called: str) -> FrameEstimate:
        """Estimate the pose of a frame of the sampler, and keep it for the next one.

        A frame without any measured depth keeps the pose that the motion model expects: nothing
        in it says where the camera is, and the frames after it still can be found (our choice).

        Args:
            called: names the frame in errors.

        Raises:
            NumericalError: the pose is not finite.
        """
        start = time.perf_counter()
        starts = np.stack(self.predict(self.estimates))
        is_blind = not bool(self.sampler.depths_mm[frame].any())
        if is_blind and not self.tracker.copes_without_depth:
            estimate = FrameEstimate(starts[0], 0, 0.0, float("nan"), True, {})
        else:
            T_starts = torch.from_numpy(starts).float().to(self.device)
            steps, loss = self._search(frame, T_starts)
            seconds = time.perf_counter() - start
            pose = _finite(self.tracker.T_world_camera.cpu().double().numpy(), called, steps)
            report = self.tracker.report()
            estimate = FrameEstimate(pose, steps, seconds, loss, is_blind, report)
        self.estimates.append(estimate.T_world_camera)
        return estimate

    def _search(self, frame: int, T_starts: Float[torch.Tensor, "starts 4 4"]) -> tuple[int, float]:
        """Steps taken, and the loss before the last of them."""
        self.tracker.start_frame(frame, T_starts)
        steps, loss = 0, torch.tensor(float("nan"))
        for _ in self.budget.frame():
            loss = self.tracker.step()
            steps += 1
            if self.tracker.is_converged:
                break
        synchronize(self.device)
        return steps, float(loss)

    def state(self) -> dict[str, Any]:
        """What a resumed run needs; tensors and plain values."""
        return {
            "estimates": torch.from_numpy(np.stack(self.estimates)),
            "tracker": self.tracker.state(),
            "budget": self.budget.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `state` returned."""
        self.estimates = list(state["estimates"].numpy())
        self.tracker.restore(state["tracker"])
        self.budget.restore(state["budget"])


def tracking_threads(field: Field) -> AbstractContextManager[None]:
    """As many CPU threads as suit the field."""
    widths = [parameter.shape[0] for parameter in field.parameters() if parameter.dim()]
    # 0: a grid or a cloud of points, which one thread serves best.
    return suitable_threads(max(widths, default=0))


def _finite(pose: Float[np.ndarray, "4 4"], called: str, steps: int) -> Float[np.ndarray, "4 4"]:
    if not np.isfinite(pose).all():
        raise NumericalError(
            f"the pose of {called} stopped being finite within {steps} steps: lower the learning "
            "rates or map for longer"
        )
    return pose
