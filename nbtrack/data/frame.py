"""A frame: one RGB-D image, from a recording or from a running camera. Tracking takes frames."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, Pose, Values
from nbtrack.core.camera import Intrinsics, backproject
from nbtrack.machinery.errors import typed
from nbtrack.machinery.inputs import MILLIMETRE, check_array, checked_images


@typed
@dataclass(frozen=True, eq=False)
class Frame:
    """Colour and depth of one moment, as integers; `at` gives chosen pixels in floating point."""

    camera: Intrinsics
    color: UInt8[Tensor, "height width 3"]  # RGB
    depth_mm: Int[Tensor, "height width"]  # z-depth, 0 = no measurement
    T_world_camera: Pose | None = None  # the true pose, if known
    name: str = "the frame"  # for error messages

    def __post_init__(self) -> None:
        """Makes the images contiguous: another memory layout would make torch compile again.

        Raises DataError for images of another size or type.
        """
        size = self.camera.height, self.camera.width
        check_array("color", self.color, (*size, 3), [UInt8], "uint8", Tensor)
        check_array("depth_mm", self.depth_mm, size, [Int], "whole numbers of mm", Tensor)
        object.__setattr__(self, "color", self.color.contiguous())
        object.__setattr__(self, "depth_mm", self.depth_mm.contiguous())

    @classmethod
    @typed
    def of_images(cls, camera: Intrinsics, color: np.ndarray, depth: np.ndarray) -> "Frame":
        """A frame of a camera's images. They are copied, so that the caller may reuse their memory.

        Raises DataError for another size or type, masked colour, or a median depth above 100 m.

        Args:
            color: RGB, (height, width, 3), uint8.
            depth: z-depth along the optical axis, (height, width): uint16 in millimetres, or
                floating point in metres, which is rounded to millimetres. A pixel counts as not
                measured if it is 0, NaN, infinite, negative, masked, or at least 65535 mm (the
                largest number of 16 bits).
        """
        rgb, depth_mm = checked_images(color, depth, (camera.height, camera.width))
        return cls(camera, torch.from_numpy(rgb), torch.from_numpy(depth_mm))

    @property
    def has_depth(self) -> bool:
        """Whether any pixel has a measured depth."""
        # For integers torch's `any` takes over ten times as long as `max`.
        return bool(self.depth_mm.max() > 0)

    def to(self, device: torch.device) -> "Frame":
        """The frame with its images on a device."""
        return replace(self, color=self.color.to(device), depth_mm=self.depth_mm.to(device))

    def measured_pixels(self, stride: int = 1, first: int = 0) -> Int[Tensor, "2 n"]:
        """Rows and columns of the pixels with a measured depth, in row-major order.

        With a stride, only pixels in every `stride`-th row and column from index `first` on.
        """
        return first + stride * torch.nonzero(self.depth_mm[first::stride, first::stride]).T

    def at(self, rows: Indices, columns: Indices) -> tuple[Colors, Values]:
        """Colour in [0, 1] and z-depth (m, 0 = no measurement) of pixels."""
        return as_floats(self.color[rows, columns], self.depth_mm[rows, columns])

    def points(self, rows: Indices, columns: Indices) -> tuple[Points, Colors]:
        """Points (m, camera frame) that pixels observe, and their colours in [0, 1]."""
        color, depth = self.at(rows, columns)
        return backproject(self.camera, columns, rows, depth), color


def as_floats(color: UInt8[Tensor, "n 3"], depth_mm: Int[Tensor, "n"]) -> tuple[Colors, Values]:
    """Colour in [0, 1] and z-depth (m, 0 = no measurement) of pixels that are kept as integers."""
    return color.float() / 255, depth_mm.float() * MILLIMETRE
