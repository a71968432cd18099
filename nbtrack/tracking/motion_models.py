"""Where the search for a frame's pose may start, given the poses found so far."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from nbtrack.core.errors import ConfigError, nearest_name

Pose = Float[np.ndarray, "4 4"]


def previous_pose(estimates: Sequence[Pose]) -> list[Pose]:
    """The pose of the frame before: the camera is taken to stand still.

    The paper does not say where it starts; every frame is processed, so this is the plain reading.
    """
    return [estimates[-1]]


def constant_velocity(estimates: Sequence[Pose]) -> list[Pose]:
    """The pose of the frame before, moved on as it had moved since the one before that.

    The motion is that seen from the camera: T_k-1 (T_k-2^-1 T_k-1). The second frame has nothing to
    go by and starts from the first one's pose. Source: our choice; usual in SLAM (ORB-SLAM).
    """
    if len(estimates) < 2:
        return [estimates[-1]]
    before, last = estimates[-2:]
    return [last @ np.linalg.inv(before) @ last]


def better_of_both(estimates: Sequence[Pose]) -> list[Pose]:
    """Both of the above, for the tracker to choose: hands start and stop within a frame."""
    if len(estimates) < 2:
        return [estimates[-1]]
    return [*constant_velocity(estimates), *previous_pose(estimates)]


MotionModel = Callable[[Sequence[Pose]], list[Pose]]
MOTION_MODELS: dict[str, MotionModel] = {
    "previous_pose": previous_pose,
    "constant_velocity": constant_velocity,
    "better_of_both": better_of_both,
}


def motion_model(name: str) -> MotionModel:
    """The motion model of a name. Raises ConfigError, naming the nearest, for any other."""
    if name not in MOTION_MODELS:
        raise ConfigError(f"unknown motion model {name!r}: {nearest_name(name, [*MOTION_MODELS])}")
    return MOTION_MODELS[name]
