"""How far a frame's steps can move a camera, and what a greedy search with that reach scores.

Adam with a fresh state moves a coordinate by about its learning rate a step, whatever the loss is:
its steps are those of the gradient's sign as long as the gradient keeps it. So N steps from a start
end within N times the rate along each axis. A camera that moves farther in a frame is left behind,
whatever the map, the pixels and the loss are. Source: paper, implementation details (rates), and
Kingma & Ba 2015, Sec. 2.1 (the bound of a step).
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
    """How far a frame's search can move the camera along, and turn it about, one axis."""

    position: float  # m, along an axis of the world
    orientation: float  # rad


def reach(steps: float, rate: float) -> float:
    """How far that many steps of Adam move a coordinate: by about its learning rate in each.

    This is nearly a bound: a coordinate moves at most 1.01 times as far in 7 steps and 1.04 times
    in 15 (by Cauchy and Schwarz), and so far only if its gradients grow in one certain way.
    """
    return steps * rate


def motion_of(
    T_world_camera: Poses, motion_model: str = "previous_pose"
) -> tuple[Motions, Motions]:
    """By how much the search of every frame but the first has to move the camera along a path.

    Offsets are in m along the world's axes, turns are rotation vectors (rad) in the axes of the
    start. The search starts as the motion model says, the frames before being found exactly.
    """
    offsets = np.zeros((len(T_world_camera) - 1, 3))
    turns = np.zeros_like(offsets)
    for k, T_true in enumerate(T_world_camera[1:], start=1):
        T_start = _nearest_start(motion_model, [*T_world_camera[max(0, k - 2) : k]], T_true)
        offsets[k - 1] = T_true[:3, 3] - T_start[:3, 3]
        turns[k - 1] = Rotation.from_matrix(T_start[:3, :3].T @ T_true[:3, :3]).as_rotvec()
    return offsets, turns


def greedy_follower(
    T_world_camera: Poses, reach_m: float, motion_model: str = "previous_pose"
) -> Poses:
    """The path of a greedy search with a reach (m): it ends each frame as near as it can.

    It knows the true pose, moves towards it by at most the reach along each axis, and turns at
    will. It begins at the first pose. A search that ends a frame farther off may be nearer later.
    """
    followed = [T_world_camera[0]]
    for T_true in T_world_camera[1:]:
        T_start = _nearest_start(motion_model, followed[-2:], T_true)
        T_end = T_true.copy()
        T_end[:3, 3] = np.clip(T_true[:3, 3], T_start[:3, 3] - reach_m, T_start[:3, 3] + reach_m)
        followed.append(T_end)
    return np.stack(followed)


def greedy_ate(T_world_camera: Poses, reach_m: float, motion_model: str = "previous_pose") -> float:
    """The ATE (m) of the greedy follower on a path of known poses, given the first."""
    followed = greedy_follower(T_world_camera, reach_m, motion_model)
    return trajectory_metrics(followed[1:], T_world_camera[1:])["ate_rmse_m"]


def reach_metrics(
    reach: Reach | None, T_world_camera: Poses, motion_model: str
) -> dict[str, float]:
    """The reach of a run, the share of its frames that ask for more, and the greedy ATE (m).

    Empty where a search has no bound (`reach` is None). The reach alone where a pose (m) of the
    path, whose first one is the given start, is not known.
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
    """The start nearest to the truth, of those after the poses `found` so far (the last two)."""
    starts = expected_poses(motion_model, found)
    return min(starts, key=lambda T_start: np.linalg.norm(T_start[:3, 3] - T_true[:3, 3]))
