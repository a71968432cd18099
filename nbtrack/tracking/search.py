"""One descent of Levenberg-Marquardt from one start, in any field with a signed distance."""

from dataclasses import dataclass, replace
from math import inf
from typing import Any

import torch

from nbtrack.core.arrays import Points, Pose, Transform, Values
from nbtrack.core.device import constant
from nbtrack.core.settings import may_be_zero
from nbtrack.data.frame import Frame
from nbtrack.fields import Field
from nbtrack.fields.base import intensity_of
from nbtrack.tracking import registration
from nbtrack.tracking.registration import MEDIANS
from nbtrack.tracking.tracker import TrackerSettings

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e3
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.2
# A step below these (rad and m) ends the search on some points, and on all of them.
_LEAST_STEPS = (1e-2, 3e-4)


@dataclass(frozen=True)
class LmSettings(TrackerSettings):
    """Levenberg-Marquardt; all our choice."""

    n_pixels: int = 512  # points a frame
    motion_model: str = "better_of_both"
    lambda_intensity: float = 1.0  # weight of the intensity residual, both over their scale
    n_restarts: int = may_be_zero(8)  # where the first search ends lost
    bake_voxel: float = 0.0  # m; the field is asked on a grid of such cells, 0: itself


class Search:
    """A descent on some of a frame's points, then on all; the pose is kept in double precision.

    A step is taken only if it lowers the robust cost; else the damping grows. Robust scales follow
    the residuals down, so that far-off starts converge and outliers lose their say in the end.
    """

    residuals: Any  # at the pose, as this kind of search keeps them
    # From afar distances say where the camera is, and intensities mislead: their basin is as wide
    # as the texture. So the first level asks for distances alone, at scales of so many medians.
    first_medians = 8.0

    def __init__(
        self, field: Field, levels: tuple, settings: LmSettings, start: Transform | Pose
    ) -> None:
        """From a start (camera to world, double precision), on the first of two sets of points."""
        self.field, self.levels, self.settings = field, levels, settings
        self.start = self.T_world_camera = start
        # Any intensity fits where it has no say.
        likeness = registration.INLIER_INTENSITY if settings.lambda_intensity else inf
        self.tolerance = registration.INLIER_ACCURACIES * field.accuracy[0], likeness
        self.begin(0)

    @staticmethod
    def draw(frame: Frame, n_points: int, generator: torch.Generator) -> tuple[Points, Values]:
        """Observed points (m, camera frame) away from edges, and their intensities."""
        points_camera, color = frame.smooth_points(n_points, generator)
        return points_camera, intensity_of(color)

    @staticmethod
    def normals(frame: Frame, points_camera: Points) -> Points:
        """None: in single operations they would take longer than the search gains."""
        return points_camera[:0]

    def begin(self, level: int) -> None:
        """Go on from the present pose with some of the points (level 0) or all (1)."""
        self.level, self.damping, self.is_ended = level, _FIRST_DAMPING, False
        weight = self.settings.lambda_intensity
        self.weight, self.medians = (weight, MEDIANS) if level else (0.0, self.first_medians)
        self._look()

    def step(self) -> float:
        """One step, taken or refused; returns the robust cost before it."""
        now = self.residuals, self.scales, self.weight
        twist = registration.damped_step(*now, self.start, self.T_world_camera, self.damping)
        T_world_camera = registration.moved(self.T_world_camera, twist)
        residuals = self._residuals_at(T_world_camera)
        before = registration.robust_cost(*now)
        # From cell to cell of a grid slopes jump, and reliabilities: a pose is no worse for that.
        # But at first, from afar, the slope tells that a surface is near.
        judged = residuals
        if self.weight:
            kept = torch.where(residuals.reliability > 0, self.residuals.reliability, 0.0)
            judged = replace(residuals, reliability=kept)
        is_better = bool(registration.robust_cost(judged, *now[1:]) < before)
        if is_better:
            self.T_world_camera, self.residuals = T_world_camera, residuals
            self.scales = registration.scales_of(residuals, self.scales, self.least, self.medians)
        self._judge(is_better, float(twist.abs().max()))
        return float(before)

    def cost(self, scales: tuple[float, float]) -> float:
        """The robust cost at given scales, by which searches are compared."""
        return float(registration.robust_cost(self.residuals, torch.tensor(scales), 1.0))

    def certainty(self) -> dict[str, float]:
        """What the points say of the pose; see `registration.certainty`."""
        matrix, _ = registration.normal_equations(self.residuals, self.scales, self.weight)
        parts = self.residuals.value, self.residuals.reliability, matrix
        return registration.certainty(
            *(part.cpu().double().numpy() for part in parts), self.tolerance
        )

    def _look(self) -> None:
        """Residuals at the pose, and robust scales for them."""
        self.residuals = self._residuals_at(self.T_world_camera)
        self.least = constant(self.field.accuracy, self.residuals.value.device, torch.float32)
        widest = torch.full_like(self.least, inf)
        self.scales = registration.scales_of(self.residuals, widest, self.least, self.medians)

    def _residuals_at(self, T_world_camera: Transform) -> registration.Residuals:
        observed, near = self.levels[self.level], self.level > 0
        return registration.residuals_at(self.field, observed, T_world_camera, near)

    def _judge(self, is_better: bool, length: float) -> None:
        """Set the damping after a step, and whether the level is at its end."""
        down = max(self.damping * _DAMPING_DOWN, _LEAST_DAMPING)
        self.damping = down if is_better else self.damping * _DAMPING_UP
        self.is_ended = length < _LEAST_STEPS[self.level] or self.damping > _MOST_DAMPING
