"""Where the search of a frame starts, by what was found before it."""

import numpy as np

from nbtrack.core.arrays import Pose, Poses
from nbtrack.machinery.errors import look_up


def expected_poses(motion_model: str, estimates: list[Pose]) -> list[Pose]:
    """Where a frame's search may start, given the poses found so far.

    At the previous pose (most likely the paper's: Sec. II-B.1 renders "at the previous estimate",
    Sec. II-B.2 uses "the previous pose estimate"); at constant velocity as the camera sees it,
    T_k-1 (T_k-2^-1 T_k-1) (ORB-SLAM); or at both, for the tracker to choose: hands start and stop
    within a frame. Raises ConfigError, naming the nearest, for any other model.
    """
    last = estimates[-1]
    starts = {"previous_pose": [last], "constant_velocity": [last], "better_of_both": [last]}
    if len(estimates) > 1:  # else no velocity is known
        moved_on = last @ np.linalg.inv(estimates[-2]) @ last
        starts |= {"constant_velocity": [moved_on], "better_of_both": [moved_on, last]}
    return look_up("motion model", motion_model, starts)


def rigid(T: Pose | Poses) -> Pose | Poses:
    """Transforms without what rounding gathers in their rotations over thousands of frames.

    A Newton step towards the nearest rotation.
    """
    T, R = T.copy(), T[..., :3, :3]
    T[..., :3, :3] = R @ (3 * np.eye(3) - R.swapaxes(-2, -1) @ R) / 2
    return T
