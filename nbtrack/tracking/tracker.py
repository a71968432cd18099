"""The base class of trackers, which take frame after frame and estimate the camera's poses."""

import abc
import time
from copy import copy, deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from nbtrack.core.arrays import Pose, Poses, Scalar, Transform, Transforms
from nbtrack.data.frame import Frame
from nbtrack.fields import FIELDS, Field, LearnedField
from nbtrack.machinery.device import suited_to, synchronize, usual_modes
from nbtrack.machinery.errors import ConfigError, NumericalError, typed
from nbtrack.machinery.inputs import checked_pose, checked_start, whole_number
from nbtrack.machinery.launches import CALLS_BEFORE_RECORDING
from nbtrack.machinery.registry import from_extra
from nbtrack.machinery.settings import checked, one_of
from nbtrack.tracking.budget import Budget
from nbtrack.tracking.reach import Reach
from nbtrack.tracking.starts import expected_poses, rigid


@dataclass(frozen=True)
class TrackerSettings:
    """Settings that all trackers share."""

    n_pixels: int = 4096  # random pixels for each step, or for each frame if they are drawn once
    # Where a search starts, by a name in `expected_poses`.
    motion_model: str = one_of("previous_pose", "constant_velocity", "better_of_both")
    tf32: bool = False  # matrix products in TF32, on NVIDIA's GPUs

    def reach(self, steps: float, metres_per_unit: float) -> Reach | None:
        """How far some steps can move the camera; None if steps have no bound."""
        return None


@dataclass(frozen=True)
class Estimate:
    """The result of the search for one frame's pose."""

    T_world_camera: Pose  # camera to world, m, OpenCV axes; never NaN
    without_depth: bool  # whether no pixel of the frame has a measured depth
    steps: int = 0
    seconds: float = 0.0
    loss: float = float("nan")  # before the last step; NaN without any step
    # What the tracker reports, by column name. It holds `lost` if the tracker judges its estimate.
    report: dict[str, float | bool] = field(default_factory=dict)

    @property
    def lost(self) -> bool:
        """Whether the pose cannot be relied on: the tracker says so, or no depth was measured."""
        return self.without_depth or bool(self.report.get("lost", False))


class Tracker(abc.ABC):
    """Follows a camera through a fixed field: `tracker.track(frame)` is called for each frame.

    A subclass defines `begin`, which starts the search of a frame, and `step`. Both update the
    current estimate `T_world_camera`.
    """

    name: str  # on the command line and in file names
    Settings: type[TrackerSettings] = TrackerSettings
    renders: bool = False  # whether it renders the field; else it asks the field for distances
    package: str | None = None  # an optional package that it needs
    converges: bool = False  # whether it can end a frame before its budget is spent
    copes_without_depth: bool = False  # whether it searches frames without any measured depth
    # Names of attributes that are kept from one frame to the next. Their values before the first
    # frame are those of the class. Checkpoints hold tensors, numbers, texts, and lists of these.
    remembers: tuple[str, ...] = ()
    is_converged: bool = False  # whether further steps in this frame would change nothing
    T_world_camera: Transform

    @typed
    @usual_modes()
    def __init__(
        self,
        field: Field,
        T_world_camera: Pose,
        budget: Budget,
        settings: TrackerSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Take a field, and the camera's pose (m) before the first frame that will be tracked.

        Field and budget are copied, so that later changes of the originals have no effect.

        Raises ConfigError for a field in which the tracker does not work, or for a setting or seed
        that is not allowed; MissingError for a package that is not installed; DataError for a pose
        that `restart` refuses.
        """
        self.check_field(field)
        self.settings = checked(self.Settings() if settings is None else settings, self.Settings)
        self.field = self.prepare(deepcopy(field).float()).eval().requires_grad_(False)
        self.device = self.field.device
        self.budget = copy(budget)
        self.generator = torch.Generator(self.device).manual_seed(whole_number("seed", seed))
        self._is_warm = False
        self.restart(T_world_camera)

    @classmethod
    def works_in(cls, field: type) -> bool:
        """Whether the tracker works in fields of a class.

        A tracker that renders needs a learned field, and any other tracker a signed distance.
        """
        return issubclass(field, LearnedField) if cls.renders else field.is_distance

    @classmethod
    def check_field(cls, field: Field | type[Field]) -> None:
        """Raises ConfigError for a field, or a class of fields, in which the tracker does not work.

        Raises MissingError if a package that it needs is not installed.
        """
        kind = field if isinstance(field, type) else type(field)
        fits = issubclass(kind, Field) and cls.works_in(kind)
        # A grid that was made from a density holds no distances, although its class says so.
        if not fits or (kind.is_distance and not field.is_distance):
            named = getattr(kind, "name", kind.__name__)
            known = ", ".join(name for name, other in FIELDS.items() if cls.works_in(other))
            raise ConfigError(f"{cls.name!r} does not work on field {named!r}: take {known}")
        if cls.package:
            from_extra(cls.package)

    def prepare(self, field: Field) -> Field:
        """The field in the form, and on the device, in which this tracker uses it."""
        return field

    @abc.abstractmethod
    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Start the search of a frame at the best of some poses (double precision, on the CPU)."""

    @abc.abstractmethod
    def step(self) -> Scalar | float:
        """Take one optimisation step; returns the loss before it, which may stay on a GPU."""

    def report(self) -> dict[str, float | bool]:
        """What to record about the estimate, by the name of a new column of `Trajectory.frames`.

        It holds `lost`, whether the camera is lost, if the tracker judges its estimates.
        """
        return {}

    @typed
    @usual_modes()
    def track(self, frame: Frame, budget: Budget | None = None) -> Estimate:
        """Estimate the camera's pose at the next frame. Raises NumericalError if it is not finite.

        A budget that is given here replaces the tracker's own for this frame. If no depth is
        measured, a tracker that needs depth does not search. It returns the first pose of the
        motion model, so that later frames can still be found (our choice).
        """
        T_starts = np.stack(expected_poses(self.settings.motion_model, self.estimates))
        estimate = Estimate(rigid(T_starts[0]), without_depth=True)
        if self.copes_without_depth or frame.has_depth:
            with suited_to(self.field.width, self.settings.tf32):
                estimate = self._search(frame, T_starts, budget or self.budget)
        self.estimates.append(estimate.T_world_camera.copy())  # the user may change the original
        return estimate

    def restart(self, T_world_camera: Pose) -> None:
        """Go on from another pose (m), as after an interruption.

        Earlier poses, and so the velocity, and what a subclass remembers are forgotten. The random
        generator and the budget are not reset. Raises DataError for a pose that is not rigid, or so
        far from the map that no depth image can reach it.
        """
        bounds = self.field.bounds
        self.estimates = [checked_start(T_world_camera, bounds.minimum, bounds.maximum)]
        for name in self.remembers:
            setattr(self, name, deepcopy(getattr(type(self), name)))

    def restart_anywhere(self) -> None:
        """Go on from an unknown pose. Raises ConfigError if this tracker cannot find the camera."""
        # This raises. A class that can find the camera overrides the method.
        self.check_finds(in_corrected=False)

    @classmethod
    def check_finds(cls, in_corrected: bool) -> None:
        """Raises ConfigError if the tracker cannot find a camera whose pose is unknown.

        Only a class that overrides `restart_anywhere` can find it, and only in a corrected map.
        """
        if cls.restart_anywhere is Tracker.restart_anywhere or not in_corrected:
            raise ConfigError(f"{cls.name!r} finds no unknown first pose: take --method corrected")

    def state(self) -> dict[str, Any]:
        """What the tracker remembers from past frames: tensors and plain values."""
        return {
            "estimates": torch.from_numpy(np.stack(self.estimates)),
            "budget": self.budget.memory,
            "generator": self.generator.get_state(),
            **{name: deepcopy(getattr(self, name)) for name in self.remembers},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned, so that a resumed run goes on as if uninterrupted."""
        self.estimates = [*state["estimates"].numpy()]
        self.budget.memory = state["budget"]
        self.generator.set_state(state["generator"])
        for name in self.remembers:
            setattr(self, name, state[name])

    def __reduce__(self) -> tuple:
        """How `copy` and `pickle` copy a tracker: they construct another one and restore its state.

        The state goes to `__setstate__`, which is `restore`.
        """
        arguments = self.field, self.estimates[0], self.budget, self.settings
        return type(self), arguments, self.state()

    __setstate__ = restore

    def _warm_up(self, frame: Frame, T_starts: Poses) -> None:
        """Take some steps before any is counted: the first ones load, allocate and record.

        Afterwards estimates, budget and random numbers are as before.
        """
        state = self.state()
        self._is_warm = True
        self.begin(frame.to(self.device), torch.from_numpy(T_starts[:1]))
        for _ in range(CALLS_BEFORE_RECORDING + 1):
            if not self.is_converged:
                self.step()
        self.report()
        self.restore(state)
        synchronize(self.device)

    def _search(self, frame: Frame, T_starts: Poses, budget: Budget) -> Estimate:
        """Search a frame's pose from the best of some starts, until converged or out of budget."""
        if not self._is_warm and frame.has_depth:
            self._warm_up(frame, T_starts)
        began = time.perf_counter()
        allowed = budget.frame(self.device)  # a clock budget starts its clock here
        self.begin(frame.to(self.device), torch.from_numpy(T_starts))
        steps, loss = 0, float("nan")
        for step in allowed:
            loss = self.step()
            steps = step + 1
            if self.is_converged:
                break
        synchronize(self.device)
        allowed.close()  # after `break`, a clock budget counts the last step here
        seconds = time.perf_counter() - began
        if not torch.as_tensor(self.T_world_camera).isfinite().all():
            raise NumericalError(f"the pose of {frame.name} is not finite: lower learning rates")
        # A tracker of one's own may give any pose.
        return Estimate(
            checked_pose(self.T_world_camera),
            not frame.has_depth,
            steps,
            seconds,
            float(loss),
            self.report(),
        )
