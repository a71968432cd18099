"""One RGB-D image: the unit of tracking, from a recording or from a running camera."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from nbtrack.core.arrays import Colors, Indices, Points, Pose, Values
from nbtrack.core.camera import Intrinsics, backproject
from nbtrack.machinery.inputs import checked_images

MILLIMETRE = 1e-3


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
        rgb, depth_mm = checked_images(color, depth, (camera.height, camera.width))
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
