"""Tracking: finds a camera's pose, frame by frame, in a field that stays fixed."""

from nbtrack.core.arrays import Pose
from nbtrack.fields import Field
from nbtrack.machinery.errors import look_up_kind
from nbtrack.machinery.registry import Registry
from nbtrack.tracking.budget import Budget, ClockBudget, StepBudget, make_budget, paper_steps
from nbtrack.tracking.paper import AdamTracker, SdfSettings, SdfTracker, VrSettings, VrTracker
from nbtrack.tracking.tracker import Tracker, TrackerSettings
from nbtrack.tracking.trajectories import Trajectory, track_sequence

TRACKERS: Registry[type[Tracker]] = Registry({"vr": VrTracker, "sdf": SdfTracker})
"""The classes of trackers, by name. `TRACKERS["mine"] = MyTracker` adds your own."""


def tracker_class(name: str) -> type[Tracker]:
    """The class of trackers with a name. Raises ConfigError, with a similar name, for no class."""
    return look_up_kind("tracker", name, TRACKERS, ["name"])


def make_tracker(
    name: str,
    field: Field,
    T_world_camera: Pose,
    budget: Budget,
    settings: TrackerSettings | None = None,
    seed: int = 0,
) -> Tracker:
    """A tracker of the class `name`, for one trajectory. `tracker.track(frame)` estimates a pose.

    The other arguments are those of `Tracker`. Raises ConfigError for an unknown name, and the
    errors of `Tracker`.
    """
    return tracker_class(name)(field, T_world_camera, budget, settings, seed)
