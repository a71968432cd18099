"""Numbers, arrays, images and poses that a user or a file gives, checked."""

from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from nbtrack.machinery.errors import ConfigError, DataError

Poses = Float[np.ndarray, "_ 4 4"]
_FARTHEST = 1e7  # m from the origin: beyond geographic coordinates; floats can square it
# No camera went so many times as far from the middle of its path as nine in ten of the poses lie,
# or than 1 m, whichever is more.
_ALONE = 1000.0
_MILLIMETRE = 1e-3
_MAX_MILLIMETRES = np.iinfo(np.uint16).max
_MAX_METRES = 100.0  # a median depth beyond it is in another unit (our choice)
_DEPTH_UNITS = "uint16 in mm, or floating point in metres"
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


def checked_images(color: Any, depth: Any, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A camera's images, copied: RGB, and depth in whole millimetres, 0 where none is measured.

    Raises DataError as `Frame.of_images` says. The size is that of both: rows and columns.
    """
    check_array("color", color, (*size, 3), [UInt8], "uint8")
    check_array("depth", depth, size, [UInt16, Float], _DEPTH_UNITS)
    if np.ma.is_masked(color):
        raise DataError("color has masked pixels: fill them; only depth may lack some")
    measured = np.ma.filled(depth, 0)
    if measured.dtype.type != np.uint16:  # of any byte order
        metres = np.where(np.isfinite(measured) & (measured > 0), measured, 0).astype(np.float64)
        median = np.median(metres[metres > 0]) if metres.any() else 0
        if median > _MAX_METRES:
            raise DataError(f"depth is {median:.4g} m in the median: give {_DEPTH_UNITS}")
        measured = (metres / _MILLIMETRE).round().clip(0, _MAX_MILLIMETRES)
    depth_mm = measured.astype(np.int32)
    depth_mm[depth_mm >= _MAX_MILLIMETRES] = 0
    return np.array(np.ma.getdata(color), order="C"), depth_mm


def check_points(points: Any) -> None:
    """Raises DataError for anything but a tensor of points, (n, 3)."""
    shape = tuple(getattr(points, "shape", ()))
    if not isinstance(points, Tensor) or len(shape) != 2 or shape[1] != 3:
        found = f"{type(points).__name__} of shape {shape}"
        raise DataError(f"points are a {found}: give a tensor of shape (n, 3), in m")


def number(name: str, value: Any, minimum: float, maximum: float) -> float:
    """A real number within limits. Raises ConfigError, by its name, for any other value."""
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if not (is_number and minimum <= value <= maximum):
        allowed = f"{minimum:g} to {maximum:g}"
        raise ConfigError(f"{name} is {value}; allowed: {allowed}; take for example 10")
    return float(value)


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
