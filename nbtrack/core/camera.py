"""The pinhole camera: intrinsics, rays, back-projection.

Inside the package every camera frame has OpenCV's axes: x right, y down, z forward. Pixel centres
lie at integer + 0.5, so an image of width W spans [0, W].
"""

import numbers
from dataclasses import dataclass

import torch
from jaxtyping import Float, Real
from torch import Tensor

from nbtrack.machinery.inputs import number


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float  # principal point, column; W/2 is the image's middle
    cy: float  # principal point, row; H/2 is the image's middle

    def __post_init__(self) -> None:
        """Makes all numbers Python's own. Raises ConfigError for a number that no camera has."""
        lowest = {"width": 1, "height": 1, "fx": 1e-3, "fy": 1e-3, "cx": -1e7, "cy": -1e7}
        for name, low in lowest.items():
            kind = numbers.Integral if name in ("width", "height") else numbers.Real
            value = number(f"a camera's {name}", getattr(self, name), low, 1e7, kind)
            object.__setattr__(self, name, value)

    @classmethod
    def from_focal(cls, width: int, height: int, focal: float) -> "Intrinsics":
        """A camera with square pixels and a centred principal point, as Neural RGB-D has it."""
        return cls(width, height, focal, focal, width / 2, height / 2)


def pixel_directions(
    intrinsics: Intrinsics, columns: Real[Tensor, "*n"], rows: Real[Tensor, "*n"]
) -> Float[Tensor, "*n 3"]:
    """Ray directions (camera frame) through pixel centres, with z = 1.

    A z-depth times this direction is the observed point. So the directions are no unit vectors: at
    the corner of a 640x480 image that is 60 degrees wide the length is about 1.23. Pixel indices
    are integers or real numbers; index 0 is the centre of the first pixel, at 0.5.
    """
    x = (columns.float() + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (rows.float() + 0.5 - intrinsics.cy) / intrinsics.fy
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def backproject(
    intrinsics: Intrinsics,
    columns: Real[Tensor, "*n"],
    rows: Real[Tensor, "*n"],
    depth: Float[Tensor, "*n"],
) -> Float[Tensor, "*n 3"]:
    """Points (m, camera frame) observed at pixels with z-depth `depth` (m)."""
    return pixel_directions(intrinsics, columns, rows) * depth.unsqueeze(-1)


def project(
    intrinsics: Intrinsics, points_camera: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Columns and rows (real-valued pixel indices) at which points (m) are seen, and z-depths (m).

    An index of 0 is the centre of the first pixel, as for `pixel_directions`. Points behind the
    camera give a depth <= 0 and meaningless pixels, which callers must mask.
    """
    x, y, depth = points_camera.unbind(-1)
    columns = intrinsics.fx * x / depth + intrinsics.cx - 0.5
    rows = intrinsics.fy * y / depth + intrinsics.cy - 0.5
    return columns, rows, depth
