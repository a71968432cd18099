"""Observed points of a frame for LM and ICP: from evenly spread pixels, away from depth edges."""

from collections.abc import Callable
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from numba import njit

from nbtrack.data.frame import MILLIMETRE, Frame
from nbtrack.data.pixels import PLANE_JUMP, PLANE_REACH

_EDGE_JUMP = 0.05  # a pixel is at an edge if a neighbour's depth differs by a larger share
_DRAWN_PER_POINT = 4  # at most so many pixels are looked at for every point that is wanted
# Pixels follow the low-discrepancy sequence R2 (Roberts 2018), whose first n members are spread
# evenly for any n. With the solution g of g^3 + g^2 = 1, the n-th pixel lies at the fractional
# parts of n g (down) and n g^2 (across) of the image. The steps g and g^2 are integers here, in
# units of 1 / _MODULUS.
_EVEN_STEPS = (0xC13FA9A9, 0x91E10DA5)
_MODULUS = 2**32
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the intensity that trackers compare (ITU-R BT.601)."""
_RED, _GREEN, _BLUE = np.float32(LUMA).tolist()
# Sums may be reordered, which fills vector registers. NaN stays NaN.
_JIT = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "arcp", "nsz"}}


Array = np.ndarray
"""The type of arrays in compiled functions. Their docstrings give the shapes."""


class Observed(NamedTuple):
    """Points that a frame observed."""

    points: np.ndarray  # n x 3, m, camera frame
    intensity: np.ndarray  # n, luma in [0, 1]
    # n x 3, unit vectors towards the camera, camera frame; 0 where unknown. 0 x 3: no normals.
    normals: np.ndarray


def compiled(function: Callable) -> Callable:
    """Compile a function by numba; the machine code is cached on disk if numba can write there."""
    try:
        return njit(cache=True, **_JIT)(function)
    except RuntimeError:  # neither the package's folder nor the home can be written
        return njit(**_JIT)(function)


def draw_points(
    frame: Frame, n_points: int, generator: torch.Generator, edge_jump: float = _EDGE_JUMP
) -> Observed:
    """Draw `n_points` observed points and intensities from evenly spread pixels, without normals.

    Pixels at the image's border are left out, and so are pixels at depth edges, whose depth may be
    that of either side. A pixel is at an edge if a neighbour's depth differs by a larger share than
    `edge_jump`; with an infinite `edge_jump` no measured pixel is.

    The first pixel is random. At most `_DRAWN_PER_POINT` x `n_points` pixels are looked at, so that
    fewer points are returned if few pixels are measured or many are at edges.
    """
    starts = torch.randint(_MODULUS, (2,), generator=generator).numpy()
    depth_mm, color = frame.depth_mm.numpy(), frame.color.numpy()
    points, intensity = _drawn_points(depth_mm, color, _pinhole(frame), n_points, starts, edge_jump)
    return Observed(points, intensity, normals=np.empty((0, 3)))


def with_normals(frame: Frame, observed: Observed, n_points: int) -> Observed:
    """Keep the first `n_points` observed points, and compute their normals in the frame."""
    points, intensity = observed.points[:n_points], observed.intensity[:n_points]
    return Observed(points, intensity, _normals(frame.depth_mm.numpy(), _pinhole(frame), points))


def _pinhole(frame: Frame) -> tuple[float, float, float, float]:
    """fx, fy, cx and cy (pixels) as a tuple, which compiled functions can take."""
    return frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy


@no_type_check
@compiled
def _drawn_points(
    depth_mm: Array, color: Array, pinhole: tuple, n_points: int, starts: Array, edge_jump: float
) -> tuple[Array, Array]:
    """Points (n x 3, m, camera frame) and luma (n) of `draw_points`.

    `starts` are the random offsets of the sequence R2, down and across, below `_MODULUS`.
    """
    height, width = depth_mm.shape
    fx, fy, cx, cy = pinhole
    points, luma, n_drawn = np.empty((n_points, 3)), np.empty(n_points), 0
    n_looked_at = _DRAWN_PER_POINT * n_points if min(height, width) > 2 else 0
    for order in range(n_looked_at):
        if n_drawn == n_points:
            break
        # The fractional part, in units of 1 / _MODULUS, times the number of rows that are not at
        # the border; and likewise of columns.
        v = 1 + (starts[0] + _EVEN_STEPS[0] * order) % _MODULUS * (height - 2) // _MODULUS
        u = 1 + (starts[1] + _EVEN_STEPS[1] * order) % _MODULUS * (width - 2) // _MODULUS
        z = depth_mm[v, u]  # mm
        jump = edge_jump * z
        is_smooth = abs(depth_mm[v + 1, u] - z) < jump and abs(depth_mm[v - 1, u] - z) < jump
        is_smooth &= abs(depth_mm[v, u + 1] - z) < jump and abs(depth_mm[v, u - 1] - z) < jump
        # A pixel without depth is never smooth: no difference is below its jump, which is 0 or NaN.
        if is_smooth:
            depth = z * MILLIMETRE
            points[n_drawn, 0] = (u + 0.5 - cx) / fx * depth
            points[n_drawn, 1] = (v + 0.5 - cy) / fy * depth
            points[n_drawn, 2] = depth
            red, green, blue = color[v, u, 0], color[v, u, 1], color[v, u, 2]
            luma[n_drawn] = (_RED * red + _GREEN * green + _BLUE * blue) / 255
            n_drawn += 1
    return points[:n_drawn], luma[:n_drawn]


@no_type_check
@compiled
def _normals(depth_mm: Array, pinhole: tuple, points: Array) -> Array:
    """Unit normals (n x 3, camera frame) of points (n x 3, m, camera frame); 0 where unknown.

    A normal is that of the plane through four pixels around the point, at a distance of
    `PLANE_REACH` times the image's width. It is unknown if the depth of one of them differs by more
    than the share `PLANE_JUMP`. `PixelSampler.normals_camera` computes the same on flat surfaces.
    """
    height, width = depth_mm.shape
    fx, fy, cx, cy = pinhole
    reach, normals = max(1, round(width * PLANE_REACH)), np.zeros((len(points), 3))
    for i in range(len(points)):
        x, y = points[i, 0] / points[i, 2], points[i, 1] / points[i, 2]
        u, v = round(fx * x + cx - 0.5), round(fy * y + cy - 0.5)
        if reach <= u < width - reach and reach <= v < height - reach:
            z, left, right = depth_mm[v, u], depth_mm[v, u - reach], depth_mm[v, u + reach]
            above, below = depth_mm[v - reach, u], depth_mm[v + reach, u]
            jump = max(abs(left - z), abs(right - z), abs(above - z), abs(below - z))
            if jump < PLANE_JUMP * z:
                # On a plane with the normal m, ln(depth) has the derivative -m_x / (m' ray) along
                # the x of the ray (x, y, 1), and likewise along y. Here m = (a, b, c) is scaled to
                # m' ray = -1, so that it points towards the camera.
                a = fx / reach * (right - left) / (right + left)
                b = fy / reach * (below - above) / (below + above)
                c = -1 - x * a - y * b
                length = np.sqrt(a * a + b * b + c * c)
                normals[i, 0], normals[i, 1], normals[i, 2] = a / length, b / length, c / length
    return normals
