"""Poses and times from and to text files, checked."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses, Position
from nbtrack.machinery.errors import DataError, MissingError
from nbtrack.machinery.files import absolute
from nbtrack.machinery.inputs import RIGID, checked_poses
from nbtrack.machinery.text_files import read_numbers

Times = Float[np.ndarray, "_"]  # s
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_LATEST = 1e11  # s: no timestamp in seconds is later; one in milliseconds since 1970 is larger


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
    is_wrong = (np.abs(norms - 1) > RIGID) | (is_known & np.isnan(times))
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


def shifted(T_world_camera: Poses, by: Position) -> Poses:
    """Poses (m) whose positions are moved by an offset (m), as in a world with another origin."""
    T_world_camera = T_world_camera.copy()
    T_world_camera[:, :3, 3] += by
    return T_world_camera


def tum_text(times: Float[np.ndarray, "n"], T_world_camera: Poses) -> str:
    """Times (s) and camera-to-world poses (m, OpenCV camera axes) in TUM format, qw >= 0.

    A line a frame whose pose is known. Numbers have the digits that restore the same double.
    Source: TUM RGB-D benchmark.
    """
    known = np.isfinite(T_world_camera).all(axis=(1, 2))
    times, T_world_camera = np.asarray(times)[known], T_world_camera[known]
    q_xyzw = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([times, T_world_camera[:, :3, 3], q_xyzw])
    return f"# {_COLUMNS}\n{number_lines(rows)}"


def number_lines(rows: Float[np.ndarray, "n numbers"]) -> str:
    """Rows of numbers as text, with the digits that restore the same double."""
    # Adding zero turns -0.0 into 0.0.
    return "".join(" ".join(map(repr, row)) + "\n" for row in (rows + 0.0).tolist())


def read_tum(path: Path) -> tuple[Float[np.ndarray, "n"], Poses]:
    """Timestamps (s) and camera-to-world poses (m) of a TUM file; `#` lines are skipped.

    Raises MissingError if it is not there, DataError, naming file and place, for any other content.
    """
    path = absolute(path)
    if not path.is_file():
        raise MissingError(f"no file {path}: give a trajectory in TUM format, as `track` writes it")
    T_world_camera, times = read_poses(path)
    if not (np.isfinite(times).all() and np.isfinite(T_world_camera).all()):
        raise DataError(f"{path}: not a finite pose in every line, `{_COLUMNS}`; write it anew")
    return times, T_world_camera
