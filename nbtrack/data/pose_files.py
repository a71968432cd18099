"""Poses and times from files, checked."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Pose, Poses
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.text_files import read_numbers

Times = Float[np.ndarray, "_"]  # s
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_FARTHEST = 1e7  # m from the origin: beyond geographic coordinates; floats can square it
# No camera went so many times as far from the middle of its path as nine in ten of the poses lie,
# or than 1 m, whichever is more.
_ALONE = 1000.0
_LATEST = 1e11  # s: no timestamp in seconds is later; one in milliseconds since 1970 is larger
_RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below


def in_seconds(times: Times) -> Times:
    """Times in seconds, also where a file has them in milli-, micro- or nanoseconds since 1970.

    The unit is the largest of these in which the median lies below `_LATEST`. A single time that
    does not is NaN.

    >>> in_seconds(np.array([1403636579763555584.0, 1403636579796888917.0])).round(2).tolist()
    [1403636579.76, 1403636579.8]
    >>> in_seconds(np.array([0.5, 0.6, 1e13])).tolist()
    [0.5, 0.6, nan]
    """
    usual = np.nanmedian(np.abs(times)) if np.isfinite(times).any() else 0.0
    unit_s = next((unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if usual * unit < _LATEST), 1.0)
    return np.where(np.abs(times * unit_s) < _LATEST, times * unit_s, np.nan)


def read_poses(path: Path, quaternion: str = "xyzw") -> tuple[Poses, Times]:
    """Poses as they stand in a file, checked, and their timestamps (s), NaN beside matrices.

    Lines hold `timestamp tx ty tz` and a quaternion in the order that is given, a 4x4 or 3x4
    matrix, or one of the rows of a matrix; else DataError is raised. NaN gives NaN poses.
    """
    numbers = read_numbers(path, (4, 8, 12, 16), _POSE_LINE)
    if numbers.shape[1] == 8:
        return from_quaternions(numbers, quaternion, path)
    if numbers.shape == (3, 4):
        numbers = numbers.reshape(1, 12)
    if numbers.shape[1] == 12:
        numbers = np.hstack([numbers, np.tile([0.0, 0, 0, 1], (len(numbers), 1))])
    if numbers.size % 16:
        raise DataError(f"{path} has {len(numbers)} rows: it needs the four of each 4x4 matrix")
    poses = checked_poses(numbers.reshape(-1, 4, 4), path)
    return poses, np.full(len(poses), np.nan)


def from_quaternions(rows: Float[np.ndarray, "n 8"], order: str, path: Path) -> tuple[Poses, Times]:
    """Poses and times (s) of rows with a timestamp, a position and a quaternion.

    `order` is that of the quaternion's four columns, as "xyzw". A pose is NaN if a number of it is
    not finite or its quaternion is zero, as tools write a lost frame.
    """
    times = in_seconds(rows[:, 0])
    # Clipped, so that absurd numbers are refused and overflow nothing here.
    q_xyzw = rows[:, [4 + order.index(axis) for axis in "xyzw"]].clip(-1e6, 1e6)
    is_known = np.isfinite(rows[:, 1:]).all(axis=1) & (q_xyzw != 0).any(axis=1)
    q_xyzw[~is_known] = 0.5  # any unit quaternion; these poses become NaN
    norms = np.linalg.norm(q_xyzw, axis=1)
    is_wrong = (np.abs(norms - 1) > _RIGID) | (is_known & np.isnan(times))
    if is_wrong.any():
        i = is_wrong.argmax()  # the first is told
        raise DataError(
            f"{path} pose {i} has the time {rows[i, 0]:.13g} and a quaternion of norm "
            f"{norms[i]:.3g}: columns must be finite timestamps (s), tx ty tz and a unit "
            f"quaternion ({' '.join('q' + axis for axis in order)})"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(q_xyzw).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    poses[~is_known] = np.nan
    return checked_poses(poses, path), times


def checked_pose(T_world_camera: Any) -> Pose:
    """One known pose (m), copied in double precision; DataError if it is no rigid transform."""
    try:
        pose = np.array(T_world_camera, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):  # the last is of a tensor with gradients
        pose = np.empty(0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not pose[:3].any():
        raise DataError("T_world_camera is no rigid transform: give 4 x 4 finite numbers")
    return checked_poses(pose[None], Path("T_world_camera"))[0]


def checked_poses(poses: Poses, path: Path) -> Poses:
    """The poses, all NaN where a number is not finite or all are 0: those frames have no pose.

    Raises DataError if a pose is no rigid transform, or absurdly far from the origin or from the
    other poses.
    """
    is_known = np.isfinite(poses).all(axis=(1, 2)) & (poses[:, :3] != 0).any(axis=(1, 2))
    # Clipped, so that absurd numbers are refused and overflow nothing.
    T = np.where(is_known[:, None, None], poses, np.eye(4)).clip(-1e8, 1e8)
    R = T[:, :3, :3]
    is_wrong = (np.abs(R @ R.mT - np.eye(3)) > _RIGID).any(axis=(1, 2))
    is_wrong |= np.abs(np.linalg.det(R) - 1) > _RIGID
    is_wrong |= (np.abs(T[:, 3] - [0, 0, 0, 1]) > _RIGID).any(axis=1)
    is_wrong |= (np.abs(T[:, :3, 3]) > _FARTHEST).any(axis=1)
    if is_known.any():
        away = np.linalg.norm(T[:, :3, 3] - np.median(T[is_known, :3, 3], axis=0), axis=1)
        usual = np.quantile(away[is_known], 0.9, method="lower")
        is_wrong |= is_known & (away > _ALONE * max(1.0, usual))
    if is_wrong.any():
        i = is_wrong.argmax()  # the first is told
        frame = f" frame {i}" if len(poses) > 1 else ""
        numbers = " ".join(f"{number:.4g}" for number in poses[i].flat)
        raise DataError(
            f"{path}{frame} is no rigid transform in metres ({numbers}): "
            f"rows must be [R | t], right-handed rotation R and t up to {_FARTHEST:g} and near the "
            "other frames', and 0 0 0 1; write nan for a frame that is lost"
        )
    return np.where(is_known[:, None, None], poses, np.nan)
