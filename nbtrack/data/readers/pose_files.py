"""Pose files of several shapes, as they stand: the convention is applied by whoever reads them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import DataError
from nbtrack.data.readers.text_files import read_numbers

_FARTHEST = 1e7  # m from the origin: beyond map coordinates, within what floats can square
_RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below


def blocks(
    numbers: Float[np.ndarray, "rows columns"], path: Path
) -> Float[np.ndarray, "poses 4 4"]:
    """Poses from rows of 16 numbers (4x4), 12 (3x4), or 4 (four rows a pose).

    Raises:
        DataError: rows of four do not divide into poses.
    """
    if numbers.shape[1] == 4:
        if len(numbers) % 4:
            raise DataError(f"{path} has {len(numbers)} rows: it needs four for every frame")
        return numbers.reshape(-1, 4, 4)
    if numbers.shape[1] == 16:
        return numbers.reshape(-1, 4, 4)
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3] = numbers.reshape(-1, 3, 4)
    return poses


def from_quaternions(
    numbers: Float[np.ndarray, "poses 7"], order: str, path: Path
) -> Float[np.ndarray, "poses 4 4"]:
    """Poses from `tx ty tz` and a quaternion, `xyzw` or `wxyz`. Rows with NaN give NaN poses.

    Raises:
        DataError: a quaternion's norm is not 1.
    """
    poses = np.full((len(numbers), 4, 4), np.nan)
    known = np.isfinite(numbers).all(axis=1)
    quaternions = numbers[known, 3:]
    # Clipped, so that absurd numbers are refused below and overflow nothing here.
    norms = np.linalg.norm(quaternions.clip(-1e6, 1e6), axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1) > _RIGID)
    if len(wrong):
        number = np.flatnonzero(known)[wrong[0]]
        raise DataError(
            f"{path} pose {number} has a quaternion of norm {norms[wrong[0]]:.3g}: columns must be "
            f"tx ty tz and a unit quaternion ({' '.join('q' + axis for axis in order)})"
        )
    if order == "wxyz":
        quaternions = quaternions[:, [1, 2, 3, 0]]
    # SciPy refuses an empty list of rotations.
    if known.any():
        poses[known] = np.eye(4)
        poses[known, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
        poses[known, :3, 3] = numbers[known, :3]
    return poses


def checked(poses: Float[np.ndarray, "frames 4 4"], path: Path) -> Float[np.ndarray, "frames 4 4"]:
    """The poses, all NaN where one number is not finite: those frames have no pose.

    Raises:
        DataError: a pose is no rigid transform, or absurdly far from the origin.
    """
    poses = poses.copy()
    known = np.isfinite(poses).all(axis=(1, 2))
    poses[~known] = np.nan
    numbers = np.flatnonzero(known)
    # Clipped, so that absurd numbers are refused and overflow nothing.
    rotation = poses[known, :3, :3].clip(-1e6, 1e6)
    deviation = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(
        axis=(1, 2), initial=0
    )
    deviation = np.maximum(deviation, np.abs(np.linalg.det(rotation) - 1))
    deviation = np.maximum(deviation, np.abs(poses[known, 3] - [0, 0, 0, 1]).max(axis=1, initial=0))
    if (deviation > _RIGID).any():
        worst = int(deviation.argmax())
        raise DataError(
            f"{path} frame {numbers[worst]} is no rigid transform (it is off by "
            f"{deviation[worst]:.3g}): rows must be [R | t] with a right-handed rotation R, and "
            "0 0 0 1"
        )
    distance = np.abs(poses[known, :3, 3]).max(axis=1, initial=0)
    if (distance > _FARTHEST).any():
        worst = int(distance.argmax())
        raise DataError(
            f"{path} frame {numbers[worst]} lies {distance[worst]:.3g} m from the origin: "
            f"positions must be in metres, at most {_FARTHEST:g}; subtract an offset"
        )
    return poses


def read_pose_folder(files: list[Path], needed: str) -> Float[np.ndarray, "poses 4 4"]:
    """Poses of one file a frame, each a 4x4 or a 3x4 matrix.

    Raises:
        MissingError, DataError: a file is not there or holds something else.
    """
    poses = np.tile(np.eye(4), (len(files), 1, 1))
    for pose, file in zip(poses, files, strict=True):
        rows = read_numbers(file, (4,), "four numbers of a 4x4 matrix", needed)
        if len(rows) not in (3, 4):
            raise DataError(f"{file} has {len(rows)} rows: it needs the four of a 4x4 matrix")
        pose[: len(rows)] = rows
    return poses
