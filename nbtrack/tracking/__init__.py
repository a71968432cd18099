"""Tracking: a camera's pose, frame by frame, in a field that is known."""

import importlib.util

from nbtrack.core.arrays import Pose
from nbtrack.fields import FIELDS, Field, field_class
from nbtrack.machinery.errors import ConfigError, MissingError, look_up_kind
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


def check_pair(tracker_name: str, field: str | Field) -> None:
    """Raises ConfigError if a tracker or a field is unknown, or they do not go together.

    MissingError, if a package that the tracker needs is not installed.
    """
    tracker = tracker_class(tracker_name)
    kind = field_class(field) if isinstance(field, str) else type(field)
    if not (issubclass(kind, Field) and tracker.works_in(kind)):
        fits = ", ".join(name for name, other in FIELDS.items() if tracker.works_in(other))
        named = getattr(kind, "name", kind.__name__)
        mismatch = f"tracker {tracker_name!r} does not work on field {named!r}"
        raise ConfigError(f"{mismatch}: take one of {fits}")
    if tracker.package and importlib.util.find_spec(tracker.package) is None:
        extra = f"pip install 'nbtrack[{tracker_name}]'"
        raise MissingError(f"tracker {tracker_name} needs the package {tracker.package}: {extra}")


def make_tracker(
    name: str,
    field: Field,
    T_world_camera: Pose,
    budget: Budget,
    settings: TrackerSettings | None = None,
    seed: int = 0,
) -> Tracker:
    """A tracker by name, for one trajectory; `tracker.track(frame)` then gives pose after pose.

    The arguments are those of `Tracker`. Raises ConfigError or MissingError as `check_pair` does,
    and DataError for a pose that is none.
    """
    check_pair(name, field)
    return tracker_class(name)(field, T_world_camera, budget, settings, seed)
