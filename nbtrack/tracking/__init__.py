"""Tracking: a camera's pose, frame by frame, in a field that is known."""

from nbtrack.core.arrays import Pose
from nbtrack.fields import Field
from nbtrack.machinery.errors import look_up_kind
from nbtrack.machinery.registry import Registry
from nbtrack.tracking.budget import Budget, ClockBudget, StepBudget, make_budget, paper_steps
from nbtrack.tracking.paper import AdamTracker, SdfSettings, SdfTracker, VrSettings, VrTracker
from nbtrack.tracking.tracker import Tracker, TrackerSettings
from nbtrack.tracking.trajectories import Trajectory, track_sequence

TRACKERS: Registry[type[Tracker]] = Registry({"vr": VrTracker, "sdf": SdfTracker})
"""What can track, by name. A tracker of your own joins by `TRACKERS["mine"] = MyTracker`."""


def tracker_class(name: str) -> type[Tracker]:
    """The tracker of a name. Raises ConfigError, naming the nearest, for any other."""
    return look_up_kind("tracker", name, TRACKERS, ["name"])


def make_tracker(
    name: str,
    field: Field,
    T_world_camera: Pose,
    budget: Budget,
    settings: TrackerSettings | None = None,
    seed: int = 0,
) -> Tracker:
    """A tracker by name, for one trajectory; `tracker.track(frame)` then gives pose after pose.

    The arguments are those of `Tracker`. Raises ConfigError for an unknown name, and as it does.
    """
    return tracker_class(name)(field, T_world_camera, budget, settings, seed)
