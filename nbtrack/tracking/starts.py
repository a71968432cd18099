"""The poses at which a frame's search starts, from the poses found before it."""

import numpy as np

from nbtrack.core.arrays import Pose, Poses
from nbtrack.machinery.errors import look_up


def expected_poses(motion_model: str, estimates: list[Pose]) -> list[Pose]:
    """The poses at which a frame's search may start, given the poses found so far.

    There are three motion models. "previous_pose" starts at the previous pose. This is most likely
    the paper's: Sec. II-B.1 renders "at the previous estimate", and Sec. II-B.2 uses "the previous
    pose estimate". "constant_velocity" repeats the last motion in the camera frame, as in ORB-SLAM:
    T_k-1 (T_k-2^-1 T_k-1). "better_of_both" gives both poses, among which the tracker chooses,
    since hands start and stop within a frame. Raises ConfigError, with the most similar name, for
    any other model.
    """
    last = estimates[-1]
    models = {model: [last] for model in ("previous_pose", "constant_velocity", "better_of_both")}
    if len(estimates) > 1:  # after a single pose no velocity is known: all start there
        moved_on = last @ np.linalg.inv(estimates[-2]) @ last
        models |= {"constant_velocity": [moved_on], "better_of_both": [moved_on, last]}
    return look_up("motion model", motion_model, models)


def rigid(T: Pose | Poses) -> Pose | Poses:
    """Make the rotation matrices of transforms orthogonal again; returns new transforms.

    Over thousands of frames rounding errors accumulate in rotations. One Newton step towards the
    nearest orthogonal matrix removes them.
    """
    T, R = T.copy(), T[..., :3, :3]
    T[..., :3, :3] = R @ (3 * np.eye(3) - R.swapaxes(-2, -1) @ R) / 2
    return T
