"""How far a tracked trajectory is from the true one: the paper's error, and other errors."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses
from nbtrack.machinery.errors import DataError

Errors = Float[np.ndarray, "frames"]
Positions = Float[np.ndarray, "frames 3"]

LOST_THRESHOLD_M = 0.2
"""A frame with a larger translation error (m) is lost. Source: the paper's Table I, in red."""
FOLLOWED_SHARE = 1 / 3
"""A camera counts as followed if its ATE is below this share of the ATE of a camera that stands
still. Our choice: on a short path a camera that never moves also stays below `LOST_THRESHOLD_M`.
"""


def trajectory_metrics(T_estimated: Poses, T_true: Poses) -> dict[str, float | int]:
    """All errors of one trajectory, by name, from camera-to-world poses (m) of the tracked frames.

    Frames whose true pose is unknown (NaN) are left out. If all are unknown, only the numbers of
    frames are returned. `ate_rmse_m` is the error of the paper's evaluation protocol. The other
    errors distinguish a map that is offset from a tracker that drifts (our choice). Raises
    DataError as `pose_errors` does.
    """
    if len(T_estimated) != len(T_true):
        raise DataError(f"{len(T_estimated)} estimates, {len(T_true)} true poses: pair them")
    is_known = np.isfinite(T_true).all(axis=(1, 2))
    counts = {"frames": len(T_true), "frames_without_reference": int((~is_known).sum())}
    if not is_known.any():
        return counts
    errors, angles_deg = pose_errors(T_estimated[is_known], T_true[is_known])
    positions, true_positions = T_estimated[is_known, :3, 3], T_true[is_known, :3, 3]
    aligned = align_rigidly(positions, true_positions)
    aligned_errors = np.linalg.norm(aligned - true_positions, axis=1)
    return {
        "ate_rmse_m": _root_mean_square(errors),  # not aligned, as in the paper
        "ate_rmse_aligned_m": _root_mean_square(aligned_errors),
        "rotation_rmse_deg": _root_mean_square(angles_deg),
        "median_error_m": float(np.median(errors)),
        "max_error_m": float(errors.max()),
        **counts,
        "lost_frames": int((errors > LOST_THRESHOLD_M).sum()),
    }


def still_metrics(T_true: Poses) -> dict[str, float]:
    """The ATE (m) of a camera that stays at the first known pose, and the length (m) of the path.

    They are called `still_ate_m` and `path_m`, and are missing for fewer than two known poses. A
    tracker is useful only if its ATE is well below `still_ate_m` (see `FOLLOWED_SHARE`).
    """
    positions = T_true[np.isfinite(T_true).all(axis=(1, 2)), :3, 3]
    if len(positions) < 2:
        return {}
    distances = np.linalg.norm(positions[1:] - positions[0], axis=1)
    path_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    return {"still_ate_m": _root_mean_square(distances), "path_m": float(path_m)}


def pose_errors(T_estimated: Poses, T_true: Poses) -> tuple[Errors, Errors]:
    """Distance (m) and angle (degrees, 0 to 180) between estimated and true camera, for each frame.

    Source: paper, evaluation protocol. Raises DataError for no poses, different numbers of them, or
    a pose that is not finite.
    """
    n_frames = len(T_true)
    is_paired = n_frames > 0 and len(T_estimated) == n_frames
    if not (is_paired and np.isfinite(T_estimated + T_true).all()):
        raise DataError(f"{len(T_estimated)} estimates, {n_frames} true poses: pair finite ones")
    turn = T_true[:, :3, :3].mT @ T_estimated[:, :3, :3]
    distances = np.linalg.norm(T_estimated[:, :3, 3] - T_true[:, :3, 3], axis=1)
    return distances, np.degrees(Rotation.from_matrix(turn).magnitude())


def align_rigidly(points: Positions, targets: Positions) -> Positions:
    """Points (m), moved by the rotation and translation that bring them closest to their targets.

    The sum of squared distances is minimised, without scale. If all points lie on a line, the best
    rotation is not unique, but the remaining distances are. Source: Horn 1987 and Umeyama 1991, by
    singular value decomposition.
    """
    center, target_center = points.mean(axis=0), targets.mean(axis=0)
    u, _, vt = np.linalg.svd((targets - target_center).T @ (points - center))
    # The best orthogonal matrix u @ vt may be a reflection (determinant -1). Flipping the axis of
    # the smallest singular value gives the best rotation.
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return points @ rotation.T + (target_center - rotation @ center)


def _root_mean_square(values: Errors) -> float:
    """The square root of the mean of the squares, in the unit of the values."""
    return float(np.sqrt(np.mean(values**2)))
