"""The reach of a frame's search, and the error that remains if nothing but the reach limits it.

The reach is how far a frame's steps can move the camera. Adam with a fresh state moves a coordinate
by about its learning rate in each step, whatever the size of the gradient, as long as the gradient
keeps its sign. So N steps end within N times the rate of their start, along each axis. A camera
that keeps moving farther is left behind, whatever the map, the pixels and the loss are. Source:
paper, implementation details (rates), and Kingma & Ba 2015, Sec. 2.1 (the bound of a step).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses
from nbtrack.tracking.metrics import trajectory_metrics
from nbtrack.tracking.starts import expected_poses

Motions = Float[np.ndarray, "frames 3"]  # m, along the axes of the world; or rad, rotation vectors


@dataclass(frozen=True)
class Reach:
    """How far a frame's search can move the camera along one axis, and turn it about one axis."""

    position: float  # m, along an axis of the world
    orientation: float  # rad, about an axis of the camera


def reach(steps: float, rate: float) -> float:
    """How far some steps of Adam move a coordinate: by about its learning rate in each step.

    This is nearly an upper bound. By the Cauchy-Schwarz inequality a coordinate moves at most 1.01
    times as far in 7 steps, and 1.04 times in 15; this needs gradients that grow in a certain way.
    """
    return steps * rate


def motion_of(
    T_world_camera: Poses, motion_model: str = "previous_pose"
) -> tuple[Motions, Motions]:
    """The motion from the start of each frame's search to its true pose, without the first frame.

    Returns offsets in m along the world's axes, and turns as rotation vectors (rad) in the start's
    camera frame. The motion model gives the start from the true poses of the frames before.
    """
    offsets, turns = np.zeros((2, len(T_world_camera) - 1, 3))
    for k, T_true in enumerate(T_world_camera[1:], start=1):
        T_start = _nearest_start(motion_model, [*T_world_camera[max(0, k - 2) : k]], T_true)
        offsets[k - 1] = T_true[:3, 3] - T_start[:3, 3]
        turns[k - 1] = Rotation.from_matrix(T_start[:3, :3].T @ T_true[:3, :3]).as_rotvec()
    return offsets, turns


def greedy_follower(
    T_world_camera: Poses, reach_m: float, motion_model: str = "previous_pose"
) -> Poses:
    """The path of a search that knows the true poses, and that only its reach (m) limits.

    The path begins at the first true pose. In each frame the search moves to the position that is
    nearest to the true one within the reach along each axis, and takes the true orientation. Being
    greedy, its error is no lower bound: a search that ends one frame farther away may be nearer in
    later frames.
    """
    followed = [T_world_camera[0]]
    for T_true in T_world_camera[1:]:
        T_start = _nearest_start(motion_model, followed[-2:], T_true)
        T_end = T_true.copy()
        T_end[:3, 3] = np.clip(T_true[:3, 3], T_start[:3, 3] - reach_m, T_start[:3, 3] + reach_m)
        followed.append(T_end)
    return np.stack(followed)


def greedy_ate(T_world_camera: Poses, reach_m: float, motion_model: str = "previous_pose") -> float:
    """The ATE (m) of `greedy_follower` on a path of known poses. The first pose does not count."""
    followed = greedy_follower(T_world_camera, reach_m, motion_model)
    return trajectory_metrics(followed[1:], T_world_camera[1:])["ate_rmse_m"]


def reach_metrics(
    reach: Reach | None, T_world_camera: Poses, motion_model: str
) -> dict[str, float]:
    """The reach of a run, the share of its frames that need a larger one, and the greedy ATE (m).

    They are called `reach_m` and `reach_deg`, `beyond_reach_share`, and `greedy_ate_m`.
    `T_world_camera` are the true poses of the path, beginning with the given start.

    The result is empty if the reach is None, since then no bound limits the search. It has only the
    reach if a pose is unknown, or if there are fewer than two poses.
    """
    if reach is None:
        return {}
    metrics = {"reach_m": reach.position, "reach_deg": float(np.degrees(reach.orientation))}
    if not np.isfinite(T_world_camera).all() or len(T_world_camera) < 2:
        return metrics
    offsets, turns = motion_of(T_world_camera, motion_model)
    moves_beyond = np.abs(offsets).max(axis=1) > reach.position
    turns_beyond = np.abs(turns).max(axis=1) > reach.orientation
    beyond_share = float((moves_beyond | turns_beyond).mean())
    greedy_m = greedy_ate(T_world_camera, reach.position, motion_model)
    return {**metrics, "beyond_reach_share": beyond_share, "greedy_ate_m": greedy_m}


def _nearest_start(motion_model: str, found: list[np.ndarray], T_true: np.ndarray) -> np.ndarray:
    """The start that is nearest to the true pose, of those that the motion model gives.

    `found` are the last two poses before, or the only one.
    """
    starts = expected_poses(motion_model, found)
    return min(starts, key=lambda T_start: np.linalg.norm(T_start[:3, 3] - T_true[:3, 3]))
