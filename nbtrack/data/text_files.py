"""Text files, read strictly: objects, tables of numbers, poses."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import DataError
from nbtrack.core.files import naming_damaged

Times = Float[np.ndarray, "_"]  # s
_TOLERANT = {"encoding": "utf-8-sig", "errors": "replace"}  # of a byte-order mark, and of any bytes
_DECIMAL_COMMA = re.compile(r"(?<!\S)[-+]?\d+,\d+(e[-+]?\d+)?(?!\S)")
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_FARTHEST = 1e7  # m from the origin: beyond geographic coordinates; floats can square it
# No camera went so many times as far from the middle of its path as nine in ten of the poses lie,
# or than 1 m, whichever is more.
_ALONE = 1000.0
_LATEST = 1e11  # s: no timestamp in seconds is later; one in milliseconds since 1970 is larger
_RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below


def read_object(path: Path, kind: str = "") -> dict[str, Any]:
    """A JSON or TOML file, by its name if not said, of an object. Raises DataError otherwise."""
    kind = kind or ("JSON" if path.suffix.lower() == ".json" else "TOML")
    with naming_damaged(path, f"{kind} file of names and values", "correct it or write it anew"):
        text = path.read_text(**_TOLERANT)
        # Braces, since they raise TypeError for a list or a number.
        return {**(tomllib.loads(text) if kind == "TOML" else json.loads(text))}


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are neither blank nor comments. DataError if there is none."""
    lines = path.read_text(**_TOLERANT).splitlines()
    full = [line for line in lines if line.partition("#")[0].strip()]
    if not full:
        raise DataError(f"{path} is empty: write it anew")
    return full


def read_numbers(path: Path, columns: tuple[int, ...], meaning: str) -> Float[np.ndarray, "n m"]:
    """A table of numbers, separated by blanks or commas; NaN and infinity are kept.

    Raises DataError for anything else, or if the number of columns is none of `columns`. The
    message says what every line should hold: the `meaning`.
    """
    lines = read_lines(path)
    if path.suffix == ".log":  # Open3D's, with a head of three numbers before each matrix
        lines = [line for line in lines if len(line.split()) != 3]
    with naming_damaged(path, "table", f"every line holds {meaning}"):
        if any(_DECIMAL_COMMA.search(line) for line in lines):
            raise ValueError("write decimal points, not commas")
        numbers = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
        if numbers.shape[1] not in columns:
            raise ValueError(f"there are {numbers.shape[1]} columns")
    return numbers


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
