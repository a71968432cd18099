"""LM's search in a grid on the host, by compiled sums."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch

from nbtrack.core.arrays import Transform
from nbtrack.data.frame import Frame
from nbtrack.fields.grid import BakedField
from nbtrack.tracking import kernels, registration
from nbtrack.tracking.search import Search


@lru_cache(maxsize=2)
def _arrays_of(field: BakedField) -> tuple[tuple, np.ndarray]:
    """A grid as the compiled functions take it, and the least scales in it."""
    low, high = np.array(field.bounds.minimum), np.array(field.bounds.maximum)
    usable = low - registration.MARGIN, high + registration.MARGIN
    place = np.concatenate([field.low.double().numpy(), [field.voxel], *usable])
    grid = field.vertices.numpy(), np.array(field.n_vertices), place
    return grid, np.array(field.accuracy)


class CompiledSearch(Search):
    """A search in a grid on the host; its poses and residuals are numpy's."""

    def __init__(self, field: BakedField, levels: tuple, settings: Any, start: Transform) -> None:
        self.grid, self.least = _arrays_of(field)
        super().__init__(field, levels, settings, start.numpy())

    @staticmethod
    def draw(frame: Frame, n_points: int, generator: torch.Generator) -> tuple:
        """Random observed points (m, camera frame) away from edges, and their intensities."""
        c, images = frame.camera, (frame.depth_mm.numpy(), frame.color.numpy())
        seed = int(torch.randint(2**62, (), generator=generator))
        return kernels.draw_points(*images, (c.fx, c.fy, c.cx, c.cy), n_points, seed)

    def step(self) -> float:
        """One step, taken or refused; returns the robust cost before it."""
        settings, now = self.settings, (self.residuals, self.scales, self.damping)
        is_better, self.T_world_camera, self.residuals, before, length = kernels.try_step(
            self.levels[self.level], self.grid, settings.divide_by_slope, self.weight,
            self.start, self.T_world_camera, *now,
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

    def _look(self, widest: float) -> None:
        observed, by_slope = self.levels[self.level], self.settings.divide_by_slope
        self.residuals = kernels.residual_rows(observed, self.T_world_camera, self.grid, by_slope)
        widest = self.least.clip(widest)
        self.scales = kernels.scales_of(self.residuals, widest, self.least, self.medians)
