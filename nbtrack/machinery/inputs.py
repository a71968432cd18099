"""Arrays and poses that a user or a file gives, checked."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.machinery.errors import DataError

Poses = Float[np.ndarray, "_ 4 4"]
_FARTHEST = 1e7  # m from the origin: beyond geographic coordinates; floats can square it
# No camera went so many times as far from the middle of its path as nine in ten of the poses lie,
# or than 1 m, whichever is more.
_ALONE = 1000.0
RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below


def check_array(what: str, array: Any, shape: tuple, kinds: list, asked: str) -> None:
    """Raises DataError for another shape, or a type that is none of the kinds (jaxtyping's).

    The message calls the array `what`, and the types that it may have `asked`.
    """
    wanted = " ".join(map(str, shape))
    if not any(isinstance(array, kind[np.ndarray, wanted]) for kind in kinds):
        found = f"of type {type(array).__name__}"
        if isinstance(array, np.ndarray):
            found = f"{array.dtype} of shape {array.shape}"
        raise DataError(f"{what} is {found}: give a numpy array, {asked}, of shape {shape}")


def tensor_of(array: np.ndarray) -> Tensor:
    """An array's memory as a tensor; a copy where PyTorch cannot share it."""
    is_fine = array.flags.writeable and array.dtype.isnative and min(array.strides, default=0) >= 0
    return torch.from_numpy(array if is_fine else array.astype(array.dtype.newbyteorder("=")))


def checked_pose(T_world_camera: Any) -> Float[np.ndarray, "4 4"]:
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
    is_wrong = (np.abs(R @ R.mT - np.eye(3)) > RIGID).any(axis=(1, 2))
    is_wrong |= np.abs(np.linalg.det(R) - 1) > RIGID
    is_wrong |= (np.abs(T[:, 3] - [0, 0, 0, 1]) > RIGID).any(axis=1)
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
