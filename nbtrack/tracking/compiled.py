"""LM's search in a grid on the host, by compiled sums; from afar it asks that normals agree."""

from functools import lru_cache
from typing import Any, no_type_check

import numpy as np
import torch
from numba import njit

from nbtrack.core.arrays import Transform
from nbtrack.data.frame import DRAWN_PER_POINT, EDGE_JUMP, EVEN_STEPS, MILLIMETRE, MODULUS, Frame
from nbtrack.data.pixels import PLANE_JUMP, PLANE_REACH
from nbtrack.fields.base import LUMA, intensity_of
from nbtrack.fields.grid import BakedField
from nbtrack.tracking import kernels, registration
from nbtrack.tracking.kernels import HOW
from nbtrack.tracking.search import Search

_RED, _GREEN, _BLUE = np.float32(LUMA).tolist()
# The first level may lead away from a good start: the better of both goes on, at these scales.
_NEAR_SCALES = 0.02, 0.05


@lru_cache(maxsize=2)
def _arrays_of(field: BakedField) -> tuple[tuple, np.ndarray]:
    """A grid as the compiled functions take it, and the least scales in it."""
    low, high = np.array(field.bounds.minimum), np.array(field.bounds.maximum)
    usable = low - registration.MARGIN, high + registration.MARGIN
    place = np.concatenate([field.low.double().numpy(), [field.voxel], *usable])
    intensity, (value, known) = intensity_of(field.volume[:3].T), field.volume[3:]
    vertices = torch.stack([value, intensity, known], dim=-1).numpy()
    return (vertices, np.array(field.n_vertices), place), np.array(field.accuracy)


@no_type_check
@njit(**HOW)
def _drawn_points(depth_mm, color, camera, n_points, starts):
    """`Frame.smooth_points`, but one pixel after the other, until there are enough."""
    (height, width), (fx, fy, cx, cy), found = depth_mm.shape, camera, 0
    points, luma = np.empty((n_points, 3)), np.empty(n_points)
    for order in range(DRAWN_PER_POINT * n_points):
        if found == n_points:
            break
        v = 1 + (starts[0] + EVEN_STEPS[0] * order) % MODULUS * (height - 2) // MODULUS
        u = 1 + (starts[1] + EVEN_STEPS[1] * order) % MODULUS * (width - 2) // MODULUS
        z = depth_mm[v, u]
        jump = EDGE_JUMP * z
        is_smooth = abs(depth_mm[v + 1, u] - z) < jump and abs(depth_mm[v - 1, u] - z) < jump
        is_smooth &= abs(depth_mm[v, u + 1] - z) < jump and abs(depth_mm[v, u - 1] - z) < jump
        if is_smooth:  # never without a depth: nothing is below a jump of zero
            point, metres = points[found], z * MILLIMETRE
            point[0], point[1] = (u + 0.5 - cx) / fx * metres, (v + 0.5 - cy) / fy * metres
            point[2] = metres
            red, green, blue = color[v, u, 0], color[v, u, 1], color[v, u, 2]
            luma[found] = (_RED * red + _GREEN * green + _BLUE * blue) / 255
            found += 1
    return points[:found], luma[:found]


@no_type_check
@njit(**HOW)
def _normals(depth_mm, camera, points):
    """`PixelSampler.normals_camera` at observed points (m, camera frame)."""
    (height, width), (fx, fy, cx, cy) = depth_mm.shape, camera
    reach, normals = max(1, round(width * PLANE_REACH)), np.zeros((len(points), 3))
    for i in range(len(points)):
        x, y = points[i, 0] / points[i, 2], points[i, 1] / points[i, 2]
        u, v = round(fx * x + cx - 0.5), round(fy * y + cy - 0.5)
        if reach <= u < width - reach and reach <= v < height - reach:
            z, left, right = depth_mm[v, u], depth_mm[v, u - reach], depth_mm[v, u + reach]
            above, below = depth_mm[v - reach, u], depth_mm[v + reach, u]
            jump = max(abs(left - z), abs(right - z), abs(above - z), abs(below - z))
            if jump < PLANE_JUMP * z:
                # How fast the logarithm of the depth grows along x / z and y / z.
                a = fx / reach * (right - left) / (right + left)
                b = fy / reach * (below - above) / (below + above)
                c = -1 - x * a - y * b
                length = np.sqrt(a * a + b * b + c * c)
                normals[i, 0], normals[i, 1], normals[i, 2] = a / length, b / length, c / length
    return normals


class CompiledSearch(Search):
    """A search in a grid on the host; its poses and residuals are numpy's."""

    first_medians = 10.0  # normals tell wrong surfaces from right ones, so that it reaches farther

    def __init__(self, field: BakedField, levels: tuple, settings: Any, start: Transform) -> None:
        self.grid, self.least = _arrays_of(field)
        super().__init__(field, levels, settings, start.numpy())

    @staticmethod
    def draw(frame: Frame, n_points: int, generator: torch.Generator) -> tuple:
        """Observed points (m, camera frame) away from edges, and their intensities."""
        c, images = frame.camera, (frame.depth_mm.numpy(), frame.color.numpy())
        starts = torch.randint(MODULUS, (2,), generator=generator).numpy()
        return _drawn_points(*images, (c.fx, c.fy, c.cx, c.cy), n_points, starts)

    @staticmethod
    def normals(frame: Frame, points_camera: np.ndarray) -> np.ndarray:
        """Unit normals (camera frame, towards it) of the surface there; 0 where not known."""
        c = frame.camera
        return _normals(frame.depth_mm.numpy(), (c.fx, c.fy, c.cx, c.cy), points_camera)

    def begin(self, level: int) -> None:
        """Go on with some of the points (level 0) or all (1)."""
        if level and self.cost(_NEAR_SCALES) > self.first_cost:
            self.T_world_camera = self.start
        super().begin(level)
        self.first_cost = self.cost(_NEAR_SCALES)

    def step(self) -> float:
        """One step, taken or refused; returns the robust cost before it."""
        now = self.residuals, self.scales, self.damping
        is_better, self.T_world_camera, self.residuals, before, length = kernels.try_step(
            self.levels[self.level], self.grid, self.level > 0, self.weight, self.start,
            self.T_world_camera, *now,
        )  # fmt: skip
        if is_better:
            self.scales = kernels.scales_of(self.residuals, self.scales, self.least, self.medians)
        self._judge(is_better, length)
        return before

    def cost(self, scales: tuple[float, float]) -> float:
        """The robust cost at given scales, by which searches are compared."""
        return kernels.robust_cost(self.residuals, np.array(scales), 1.0)

    def certainty(self) -> dict[str, float]:
        """What the points say of the pose; see `registration.certainty`."""
        rows = self.residuals
        matrix, _ = kernels.normal_equations(rows, self.scales, self.weight)
        return registration.certainty(rows[:2], rows[2], matrix, self.tolerance)

    def _look(self) -> None:
        observed, near = self.levels[self.level], self.level > 0
        self.residuals = kernels.residual_rows(observed, self.T_world_camera, self.grid, near)
        widest = np.full(2, np.inf)
        self.scales = kernels.scales_of(self.residuals, widest, self.least, self.medians)
