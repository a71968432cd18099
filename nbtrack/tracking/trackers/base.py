"""What every tracker offers to the tracking loop, and the registry of trackers."""

import abc
import warnings
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.config import TrackingConfig
from nbtrack.core.errors import ConfigError, nearest_name
from nbtrack.core.geometry import (
    make_transform,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
)
from nbtrack.data.pixels import PixelSampler
from nbtrack.fields import Field
from nbtrack.fields.engine import frozen
from nbtrack.tracking.trackers.cuda_graph import GraphedStep

ENGINES: dict[str, Callable[[Field], Field]] = {"fast": frozen, "plain": lambda field: field}
"""How a tracker asks a field: on the engine, or as the field's own plain torch."""


class Tracker(abc.ABC):
    """Estimates the camera's pose in a fixed field, one optimisation step at a time."""

    name: str  # on the command line and in file names
    label: str  # in Table I and figures
    short_label: str  # in Table II
    field_name: str  # the field whose maps it tracks in
    paper_steps: str = "sdf"  # whose step counts of the paper's Table II it is given
    table_order: int = 100  # rows of the tables go by this, then by name; the paper's come first
    renders: bool = False  # whether it needs a field that can be rendered, not only asked
    copes_without_depth: bool = False  # whether a frame without any measured depth is no error
    in_paper_tables: bool = True  # a row of Tables I and II; else only where it is asked for

    def __init__(
        self,
        field: Field,
        sampler: PixelSampler,
        config: TrackingConfig,
        generator: torch.Generator,
    ) -> None:
        if config.engine not in ENGINES:
            raise ConfigError(
                f"unknown engine {config.engine!r}: {nearest_name(config.engine, [*ENGINES])}"
            )
        self.field = ENGINES[config.engine](field)
        self.sampler = sampler
        self.config = config
        self.generator = generator

    @classmethod
    def evaluations_per_pixel(cls, config: TrackingConfig) -> int:
        """How often a step asks the network for each of its pixels; only estimates time."""
        return 1

    @abc.abstractmethod
    def start_frame(self, frame: int, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Take up a frame of the sequence; its search starts at the best of some poses."""

    @abc.abstractmethod
    def step(self) -> Float[Tensor, ""]:
        """One optimisation step; returns the loss before it, still on the device."""

    @property
    def is_converged(self) -> bool:
        """Whether further steps would change nothing, so that the rest of the budget is spared."""
        return False

    def report(self) -> dict[str, float | bool]:
        """What the tracker itself says about its estimate of the frame, by column name.

        `lost`, where given, is its own verdict, which is scored against the true error.
        """
        return {}

    @property
    @abc.abstractmethod
    def T_world_camera(self) -> Float[Tensor, "4 4"]:
        """The present estimate, without gradient."""

    def state(self) -> dict[str, Any]:
        """What one frame leaves to the next, besides its pose; tensors and plain values."""
        return {"generator": self.generator.get_state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `state` returned, so that a resumed run goes on as if uninterrupted."""
        self.generator.set_state(state["generator"])


class AdamTracker(Tracker):
    """The paper's optimiser: Adam on a position and a unit quaternion, new pixels every step.

    Source: paper, implementation details. Each frame starts with a fresh Adam: momentum gathered
    on the frame before would carry the pose on at a frame where the camera stands still (our
    choice; the paper does not say).
    """

    def __init__(
        self,
        field: Field,
        sampler: PixelSampler,
        config: TrackingConfig,
        generator: torch.Generator,
    ) -> None:
        super().__init__(field, sampler, config, generator)
        device = sampler.device
        # All that a step works on keeps its place in memory, so that it can be captured.
        self.frame_number = torch.zeros((), dtype=torch.long, device=device)
        self.pixels = torch.zeros(2, config.n_pixels, dtype=torch.long, device=device)
        self.position = torch.zeros(3, device=device, requires_grad=True)
        self.q_wxyz = torch.zeros(4, device=device, requires_grad=True)
        self.is_graphed = (
            config.engine == "fast" and device.type == "cuda" and sampler.images_device == device
        )
        self.optimizer = torch.optim.Adam(
            [
                {"params": [self.position], "lr": config.position_rate},
                {"params": [self.q_wxyz], "lr": config.orientation_rate},
            ],
            capturable=self.is_graphed,
        )
        self.graphed_step: GraphedStep | None = None

    def start_frame(self, frame: int, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Take up a frame; its measured pixels are listed once.

        Of several starts the one with the lowest loss is taken, on the same pixels for all.
        """
        self.frame_number.fill_(frame)
        self.rows, self.columns = self.sampler.measured_pixels(frame)
        T_world_camera = T_starts[0] if len(T_starts) == 1 else self._cheapest(T_starts)
        if self.is_graphed and self.graphed_step is None:
            self._start_at(T_world_camera)
            # Any pixels will do; drawing some would change which ones the steps see.
            self.pixels.copy_(torch.stack([self.rows[:1], self.columns[:1]]))
            self._capture()
        self._start_at(T_world_camera)

    def _capture(self) -> None:
        """Capture the step; a device or driver that cannot takes its steps one kernel at a time."""
        try:
            self.graphed_step = GraphedStep(self._step_on_pixels, self.generator)
        except RuntimeError as error:
            self.is_graphed = False
            reason = str(error).splitlines()[0]
            warnings.warn(f"steps are not captured as a CUDA graph: {reason}", stacklevel=2)

    def step(self) -> Float[Tensor, ""]:
        """Draw pixels, lower their loss by one step of Adam, renormalise the quaternion."""
        self.pixels.copy_(self._drawn_pixels())
        return self.graphed_step() if self.graphed_step else self._step_on_pixels()

    def _step_on_pixels(self) -> Float[Tensor, ""]:
        self.optimizer.zero_grad(set_to_none=True)
        loss = self.loss(self._differentiable_pose(), *self.pixels)
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            self.q_wxyz.copy_(normalize_quaternion(self.q_wxyz))
        return loss.detach()

    @torch.no_grad()
    def _start_at(self, T_world_camera: Float[Tensor, "4 4"]) -> None:
        """Put the pose there and forget all momentum."""
        self.position.copy_(T_world_camera[:3, 3])
        self.q_wxyz.copy_(matrix_to_quaternion(T_world_camera[:3, :3]))
        for moments in self.optimizer.state.values():
            for moment in moments.values():
                moment.zero_()

    def _drawn_pixels(self) -> Int[Tensor, "2 n"]:
        """Rows and columns of randomly drawn measured pixels."""
        drawn = torch.randint(
            len(self.rows), (self.config.n_pixels,),
            generator=self.generator, device=self.generator.device,
        )  # fmt: skip
        return torch.stack([self.rows[drawn], self.columns[drawn]])

    @torch.no_grad()
    def _cheapest(self, T_starts: Float[Tensor, "starts 4 4"]) -> Float[Tensor, "4 4"]:
        pixels = self._drawn_pixels()
        losses = torch.stack([self.loss(T_start, *pixels) for T_start in T_starts])
        return T_starts[losses.argmin()]

    @abc.abstractmethod
    def loss(
        self,
        T_world_camera: Float[Tensor, "4 4"],
        rows: Int[Tensor, "n"],
        columns: Int[Tensor, "n"],
    ) -> Float[Tensor, ""]:
        """The loss of some pixels of the current frame at a pose."""

    @property
    def T_world_camera(self) -> Float[Tensor, "4 4"]:
        """The present estimate, without gradient."""
        return self._differentiable_pose().detach()

    def _differentiable_pose(self) -> Float[Tensor, "4 4"]:
        return make_transform(quaternion_to_matrix(self.q_wxyz), self.position)


TRACKERS: dict[str, type[Tracker]] = {}


def register_tracker(tracker: type[Tracker]) -> type[Tracker]:
    """Class decorator that makes a tracker known under its name, and a row of the tables."""
    TRACKERS[tracker.name] = tracker
    return tracker


def tracker_class(name: str) -> type[Tracker]:
    """The registered tracker of a name. Raises ConfigError, naming the nearest, for any other."""
    if name not in TRACKERS:
        raise ConfigError(f"unknown tracker {name!r}: {nearest_name(name, sorted(TRACKERS))}")
    return TRACKERS[name]


def paper_trackers() -> list[str]:
    """The trackers that are rows of Tables I and II unless others are asked for, in order."""
    return [name for name, tracker in TRACKERS.items() if tracker.in_paper_tables]
