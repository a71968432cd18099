"""One RGB-D image: the unit of tracking, from a recording or from a running camera."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8, UInt16
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, Pose, Values
from nbtrack.core.camera import Intrinsics, backproject
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.inputs import check_array

MILLIMETRE = 1e-3
_MAX_MILLIMETRES = np.iinfo(np.uint16).max
_MAX_METRES = 100.0  # a median depth beyond it is in another unit (our choice)
_DEPTH_UNITS = "uint16 in mm, or floating point in metres"


@dataclass(frozen=True, eq=False)
class Frame:
    """Colour and depth of one moment; only pixels that are asked for become floating point."""

    camera: Intrinsics
    color: UInt8[Tensor, "height width 3"]  # RGB
    depth_mm: Int[Tensor, "height width"]  # z-depth, 0 = no measurement
    T_world_camera: Pose | None = None  # the true pose, where it is known
    name: str = "the frame"  # what errors call it

    def __post_init__(self) -> None:
        """Rows follow each other: compiled functions would be compiled anew for another order."""
        object.__setattr__(self, "color", self.color.contiguous())
        object.__setattr__(self, "depth_mm", self.depth_mm.contiguous())

    @classmethod
    def of_images(cls, camera: Intrinsics, color: np.ndarray, depth: np.ndarray) -> "Frame":
        """A camera's images, copied: the memory may be used again for the next ones.

        Raises DataError if one has another size, type or unit.

        Args:
            color: RGB, (height, width, 3), uint8.
            depth: z-depth along the optical axis, (height, width): uint16 in millimetres, or
                floating point in metres, kept to the millimetre. None is measured where it is 0,
                NaN, infinite, negative, masked, or 65535 mm and more, the end of 16 bits.
        """
        check_array("color", color, (camera.height, camera.width, 3), [UInt8], "uint8")
        check_array("depth", depth, (camera.height, camera.width), [UInt16, Float], _DEPTH_UNITS)
        if np.ma.is_masked(color):
            raise DataError("color has masked pixels: fill them; only depth may lack some")
        rgb = np.array(np.ma.getdata(color), order="C")
        measured = np.ma.filled(depth, 0)
        is_mm = measured.dtype.type == np.uint16  # of any byte order
        depth_mm = (measured if is_mm else _in_millimetres(measured)).astype(np.int32)
        depth_mm[depth_mm >= _MAX_MILLIMETRES] = 0
        return cls(camera, torch.from_numpy(rgb), torch.from_numpy(depth_mm))

    @property
    def has_depth(self) -> bool:
        """Whether any pixel is measured."""
        # torch's `any` of integers takes twenty times as long: 0.3 ms of 640x480 pixels.
        return bool(self.depth_mm.max() > 0)

    def to(self, device: torch.device) -> "Frame":
        """The same on a device."""
        return replace(self, color=self.color.to(device), depth_mm=self.depth_mm.to(device))

    def measured_pixels(self, stride: int = 1, first: int = 0) -> Int[Tensor, "2 n"]:
        """Rows and columns of the pixels that have a depth.

        All are looked at, or every `stride`-th row and column from number `first` on.
        """
        return first + stride * torch.nonzero(self.depth_mm[first::stride, first::stride]).T

    def at(self, rows: Indices, columns: Indices) -> tuple[Colors, Values]:
        """Colour in [0, 1] and z-depth (m, 0 = none) of pixels."""
        return measured(self.color[rows, columns], self.depth_mm[rows, columns])

    def points(self, rows: Indices, columns: Indices) -> tuple[Points, Colors]:
        """Points (m, camera frame) observed at pixels, and their colours in [0, 1]."""
        color, depth = self.at(rows, columns)
        return backproject(self.camera, columns, rows, depth), color


def measured(color: UInt8[Tensor, "n 3"], depth_mm: Int[Tensor, "n"]) -> tuple[Colors, Values]:
    """Colour in [0, 1] and z-depth (m, 0 = none) of pixels as they are kept."""
    return color.float() / 255, depth_mm.float() * MILLIMETRE


def _in_millimetres(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth (m) in whole millimetres; 0 where it is no positive number.

    Raises DataError if the median is no depth in metres.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float64)
    median = np.median(depth[depth > 0]) if depth.any() else 0
    if median > _MAX_METRES:
        raise DataError(f"depth is {median:.4g} m in the median: give {_DEPTH_UNITS}")
    return (depth / MILLIMETRE).round().clip(0, _MAX_MILLIMETRES)
