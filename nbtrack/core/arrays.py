"""Names for arrays that many signatures share. Frames and units stand in the arguments' names."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8, UInt16
from torch import Tensor

from nbtrack.machinery.errors import DataError

Pose = Float[np.ndarray, "4 4"]  # a rigid transform, in double precision
Poses = Float[np.ndarray, "_ 4 4"]
Position = Float[np.ndarray, "3"]  # m, in double precision
ColorImage = UInt8[np.ndarray, "height width 3"]  # RGB
DepthImage = UInt16[np.ndarray, "height width"]  # mm, 0 = no measurement
Transform = Float[Tensor, "4 4"]  # a rigid transform, where gradients may flow
Transforms = Float[Tensor, "_ 4 4"]
Points = Float[Tensor, "n 3"]  # m
Colors = Float[Tensor, "n 3"]  # red, green, blue in [0, 1]
Values = Float[Tensor, "n"]
Indices = Int[Tensor, "n"]
Scalar = Float[Tensor, ""]
RaySamples = Float[Tensor, "rays samples"]  # a value a sample of each ray
RayColors = Float[Tensor, "rays samples 3"]
WorldPoints = Float[np.ndarray, "_ 3"]  # m, in double precision
Frames = Int[np.ndarray, "_"]  # indices of a sequence's frames


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
