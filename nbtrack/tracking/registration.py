"""Points against a field by second-order steps: residuals, robust weights, normal equations.

Pure functions; the search that uses them is `nbtrack.tracking.trackers.lm`. A pose changes by
a twist
(omega, v) seen from the camera's centre t, with world axes: x -> t + v + exp(omega) (x - t). So
rotation and translation stay apart however far the camera is from the world's origin.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.geometry import make_transform, rotation_vector_to_matrix, transform_points
from nbtrack.fields.base import LUMA, Field

# Gradient lengths between which a signed distance is taken at its word (PIN-SLAM: 0.5 to 2).
_LEAST_SLOPE, _MOST_SLOPE = 0.3, 2.0
# Fields continue a little beyond their bounds (m), where walls lie of which the pose is off.
_MARGIN = 0.3
_SLOPE_SCALE = 0.5  # a gradient so much longer or shorter than 1 counts for a quarter


@dataclass(frozen=True)
class Observation:
    """The points of one frame that all steps of its search look at."""

    points_camera: Float[Tensor, "n 3"]  # m
    intensity: Float[Tensor, "n"]  # luma, in [0, 1]

    @classmethod
    def of(cls, points_camera: Float[Tensor, "n 3"], color: Float[Tensor, "n 3"]) -> "Observation":
        """Points with the luma of their colours in [0, 1]."""
        return cls(points_camera, color @ LUMA.to(color))

    def first(self, n_points: int) -> "Observation":
        """Only the first so many points: a random share, as they are drawn at random."""
        return Observation(self.points_camera[:n_points], self.intensity[:n_points])


@dataclass(frozen=True)
class Residuals:
    """Two residuals a point and their derivatives with respect to the twist (omega, v)."""

    distance: Float[Tensor, "n"]  # f / |grad f|, m
    distance_jacobian: Float[Tensor, "n 6"]
    intensity: Float[Tensor, "n"]  # the field's minus the observed one
    intensity_jacobian: Float[Tensor, "n 6"]
    reliability: Float[Tensor, "n"]  # in [0, 1]: 0 out of bounds or where the gradient is absurd


@dataclass(frozen=True)
class Scales:
    """Residuals at which the robust weight falls to a quarter."""

    distance: Float[Tensor, ""]  # m
    intensity: Float[Tensor, ""]


# The narrowest scales: what maps and depth cameras are off by in any case (our choice).
LEAST_SCALES = Scales(torch.tensor(0.02), torch.tensor(0.05))
# A scale is so many medians of its residuals: two standard deviations, were they normal.
_MEDIANS = 3.0
_DEVIATIONS = 0.6745 * _MEDIANS
INLIER_DISTANCE = 0.05  # m: a point that near the surface fits


@dataclass(frozen=True)
class Uncertainty:
    """How well points hold a pose, by the curvature of their cost at it.

    Deviations take the residuals for independent; errors of the map are not, so that they are lower
    bounds: good for telling poses apart, not for error bars.
    """

    covariance: Float[Tensor, "6 6"]  # of the twist (omega, v): rad, m
    condition_number: float  # of the points' own curvature, rotation at an arm of 1 m
    weakest_twist: Float[Tensor, "6"]  # unit twist that the points resist the least

    @property
    def position_deviation(self) -> float:
        """Standard deviation (m) of the position along its least certain direction."""
        return float(torch.linalg.eigvalsh(self.covariance[3:, 3:])[-1].sqrt())

    @property
    def rotation_deviation_deg(self) -> float:
        """Standard deviation (degrees) about the least certain axis."""
        return float(torch.linalg.eigvalsh(self.covariance[:3, :3])[-1].sqrt().rad2deg())


def residuals_at(
    field: Field,
    observation: Observation,
    T_world_camera: Float[Tensor, "4 4"],
    divide_by_slope: bool = True,
) -> Residuals:
    """Both residuals of all points at a pose.

    The distance is divided by the gradient's length, which corrects fields that grow too fast or
    too slowly to first order, and its Jacobian is the unit gradient accordingly; unless
    `divide_by_slope` is False: then both stay as the field gives them. Source: paper,
    Eq. 2, for the residuals; f / |grad f| as an option in PIN-SLAM (Pan et al. 2024).
    """
    T_world_camera = T_world_camera.to(observation.points_camera)
    points_world = transform_points(T_world_camera, observation.points_camera)
    field_at = field.linearize(points_world)
    slope = field_at.value_gradient.norm(dim=-1)
    is_usable = (slope > _LEAST_SLOPE) & (slope < _MOST_SLOPE)
    is_usable &= field.bounds.contain(points_world, _MARGIN)
    # A distance field's gradient has length 1; the farther from it, the less it is trusted.
    reliability = is_usable / (1 + ((slope - 1) / _SLOPE_SCALE).square()).square()
    slope = slope.clamp_min(_LEAST_SLOPE) if divide_by_slope else torch.ones_like(slope)
    arm = points_world - T_world_camera[:3, 3]
    return Residuals(
        field_at.value / slope,
        _twist_jacobian(arm, field_at.value_gradient / slope[:, None]),
        field_at.intensity - observation.intensity,
        _twist_jacobian(arm, field_at.intensity_gradient),
        reliability,
    )


def _twist_jacobian(
    arm: Float[Tensor, "n 3"], gradient: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 6"]:
    """d g(x) / d(omega, v) = [(arm x gradient)', gradient'], from dx = v + omega x arm."""
    return torch.cat([torch.linalg.cross(arm, gradient), gradient], dim=-1)


def scales_of(residuals: Residuals, before: Scales | None = None) -> Scales:
    """Scales for residuals: some medians wide, never below the least, nor above those before."""
    scales = []
    for name in ("distance", "intensity"):
        scale = _MEDIANS * getattr(residuals, name).abs().median()
        scale = torch.maximum(scale, getattr(LEAST_SCALES, name).to(scale))
        scales.append(scale if before is None else torch.minimum(scale, getattr(before, name)))
    return Scales(*scales)


def inlier_ratio(residuals: Residuals) -> float:
    """Share of the points that lie near the field's surface."""
    is_inlier = (residuals.distance.abs() < INLIER_DISTANCE) & (residuals.reliability > 0)
    return float(is_inlier.float().mean())


def uncertainty(
    residuals: Residuals, scales: Scales, intensity_weight: float, start_scale: float
) -> Uncertainty:
    """Covariance, condition and weakest twist of a pose.

    Args:
        start_scale: twist (rad and m) at which the pull to the start weighs as much as one point
            whose residual is one scale.
    """
    matrix, _ = normal_equations(residuals, scales, intensity_weight)
    values, vectors = torch.linalg.eigh(matrix)
    pulled = matrix + torch.eye(6).to(matrix) / start_scale**2
    return Uncertainty(
        torch.linalg.inv(pulled) / _DEVIATIONS**2,
        float(values[-1] / values[0].clamp_min(1e-9)),
        vectors[:, 0],
    )


def robust_cost(residuals: Residuals, scales: Scales, intensity_weight: float) -> Float[Tensor, ""]:
    """Mean Geman-McClure cost over the points; one that is not usable costs the most, 1.

    rho(u) = u^2 / (1 + u^2) with u = residual / scale. So no pose gets cheaper by moving points
    out of the field's bounds.
    """
    distance = _geman_mcclure(residuals.distance / scales.distance)
    intensity = _geman_mcclure(residuals.intensity / scales.intensity)
    cost = distance + intensity_weight * intensity
    worst = 1 + intensity_weight
    return (residuals.reliability * cost + (1 - residuals.reliability) * worst).mean()


def normal_equations(
    residuals: Residuals, scales: Scales, intensity_weight: float
) -> tuple[Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """J'WJ and J'Wr of both residuals in double precision, divided by their scales' squares.

    W holds Geman-McClure's weights 1 / (1 + u^2)^2 times the points' reliability.
    """
    rows, values = [], []
    for residual, jacobian, scale, weight in (
        (residuals.distance, residuals.distance_jacobian, scales.distance, 1.0),
        (residuals.intensity, residuals.intensity_jacobian, scales.intensity, intensity_weight),
    ):
        u = residual / scale
        root = (weight * residuals.reliability).sqrt() / (1 + u.square())
        rows.append(jacobian * (root / scale)[:, None])
        values.append(u * root)
    jacobian, value = torch.cat(rows).double(), torch.cat(values).double()
    return jacobian.T @ jacobian, jacobian.T @ value


def moved(T_world_camera: Float[Tensor, "4 4"], twist: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """The pose after a twist (omega in rad, v in m; world axes, about the camera's centre)."""
    rotation = rotation_vector_to_matrix(twist[:3]) @ T_world_camera[:3, :3]
    return make_transform(rotation, T_world_camera[:3, 3] + twist[3:])


def _geman_mcclure(u: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    square = u.square()
    return square / (1 + square)
