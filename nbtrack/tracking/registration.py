"""Points against a field by second-order steps: residuals, robust weights, normal equations.

Pure functions. Every point has two residuals, of distance (m) and of intensity (luma, in [0, 1]),
along the first axis of tensors; a scale is where the robust weight of one falls to a quarter.

A pose changes by a twist (omega, v) about the camera's centre t, with world axes:
x -> t + v + exp(omega) (x - t), so that rotation and translation stay apart wherever the camera is.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.arrays import Points, Scalar, Transform, Values
from nbtrack.core.geometry import make_transform, rotation_vector_to_matrix, transform_points
from nbtrack.fields import Field

# Gradient lengths between which a signed distance is taken at its word (PIN-SLAM: 0.5 to 2).
LEAST_SLOPE, MOST_SLOPE = 0.3, 2.0
SLOPE_SCALE = 0.5  # a gradient so much longer or shorter than 1 counts for a quarter
MARGIN = 0.3  # m beyond a field's bounds, where walls lie of which the pose is off
MEDIANS = 3.0  # of its residuals in a scale: two standard deviations, were they normal
_DEVIATIONS = 0.6745 * MEDIANS
# A point fits if it is so many accuracies of the field near to its surface, and so like in luma.
INLIER_ACCURACIES, INLIER_INTENSITY = 2.5, 0.25
# A pull towards the start of the frame's search, so weak that it decides only where the frame says
# nothing, as along a corridor: one point's worth, at a twist of 0.5 rad or 0.5 m (our choice).
START_PULL = 1 / 0.5**2

# In the camera frame (m); their luma; normals of the surface there, or none (n = 0) to ask for.
Observed = tuple[Points, Values, Points]
Scales = Float[Tensor, "2"]


@dataclass(frozen=True)
class Residuals:
    """Residuals of n points and their derivatives with respect to the twist (omega, v)."""

    value: Float[Tensor, "2 n"]  # f / |grad f|, and the field's intensity minus the observed one
    jacobian: Float[Tensor, "2 n 6"]
    reliability: Values  # in [0, 1]: 0 out of bounds, or where the gradient is absurd


def residuals_at(
    field: Field, observed: Observed, T_world_camera: Transform, near: bool = False
) -> Residuals:
    """Both residuals of observed points at a pose.

    Dividing the distance by the gradient's length, which makes its Jacobian the unit gradient,
    corrects fields that grow too fast or too slowly to first order. Source: paper, Eq. 2;
    f / |grad f| is an option in PIN-SLAM (Pan et al. 2024). Near the pose points count by how well
    the map knows the surface there; from afar, where no point lies at its surface, none would.
    """
    points_camera, intensity, normals_camera = observed
    T_world_camera = T_world_camera.to(points_camera)
    points_world = transform_points(T_world_camera, points_camera)
    field_at = field.linearize(points_world)
    slope = field_at.value_gradient.norm(dim=-1)
    is_usable = (slope > LEAST_SLOPE) & (slope < MOST_SLOPE)
    is_usable &= field.bounds.contain(points_world, MARGIN)
    # A distance field's gradient has length 1; the farther from it, the less it is trusted.
    reliability = is_usable / (1 + ((slope - 1) / SLOPE_SCALE).square()).square()
    if len(normals_camera):  # the nearest surface is not the observed one if it faces elsewhere
        along = (normals_camera @ T_world_camera[:3, :3].T * field_at.value_gradient).sum(dim=-1)
        reliability = reliability * (along.clamp_min(0) / slope.clamp_min(LEAST_SLOPE)).square()
    if near:
        reliability = reliability * field.confidence(points_world)
    slope = slope.clamp_min(LEAST_SLOPE)
    value = torch.stack([field_at.value / slope, field_at.intensity - intensity])
    gradient = field_at.value_gradient / slope[:, None], field_at.intensity_gradient
    # d g(x) / d(omega, v) = [(arm x gradient)', gradient'], from dx = v + omega x arm.
    arm = points_world - T_world_camera[:3, 3]
    jacobian = [torch.cat([torch.linalg.cross(arm, g), g], dim=-1) for g in gradient]
    return Residuals(value, torch.stack(jacobian), reliability)


def scales_of(
    residuals: Residuals, before: Scales, least: Scales, medians: float = MEDIANS
) -> Scales:
    """Scales for residuals: some medians wide, never below the least, nor above those before."""
    scales = medians * residuals.value.abs().median(dim=1).values
    return scales.maximum(least.to(scales)).minimum(before.to(scales))


def robust_cost(residuals: Residuals, scales: Scales, intensity_weight: float) -> Scalar:
    """Mean Geman-McClure cost u^2 / (1 + u^2) over the points, with u = residual / scale.

    A point that is not usable costs the most, 1: no pose gets cheaper by moving points out of it.
    """
    square = (residuals.value / scales.to(residuals.value)[:, None]).square()
    distance, intensity = square / (1 + square)
    cost = distance + intensity_weight * intensity
    worst = 1 + intensity_weight
    return (residuals.reliability * cost + (1 - residuals.reliability) * worst).mean()


def normal_equations(
    residuals: Residuals, scales: Scales, intensity_weight: float
) -> tuple[Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """J'WJ and J'Wr of both residuals, divided by their scales' squares; in double precision, on
    the host, since not every device has it.

    W holds Geman-McClure's weights 1 / (1 + u^2)^2 times the points' reliability.
    """
    scales = scales.to(residuals.value)[:, None]
    u = residuals.value / scales
    weights = torch.stack([residuals.reliability, intensity_weight * residuals.reliability])
    root = weights.sqrt() / (1 + u.square())
    jacobian = (residuals.jacobian * (root / scales)[..., None]).flatten(0, 1).cpu().double()
    return jacobian.T @ jacobian, jacobian.T @ (u * root).flatten().cpu().double()


def damped_step(
    residuals: Residuals,
    scales: Scales,
    intensity_weight: float,
    T_start: Transform,
    T_world_camera: Transform,
    damping: float,
) -> Float[Tensor, "6"]:
    """The twist that solves (H + pull + damping diag H) twist = -(J'Wr + pull's gradient).

    The pull is START_PULL times (1 - cos(angle) + offset^2 / 2) from the start of the search.
    """
    matrix, vector = normal_equations(residuals, scales, intensity_weight)
    matrix, vector = matrix.to(T_world_camera), vector.to(T_world_camera)
    turned = T_world_camera[:3, :3] @ T_start[:3, :3].T
    sines = (turned - turned.T)[[2, 0, 1], [1, 2, 0]] / 2  # the axis times sin(angle)
    offset = T_world_camera[:3, 3] - T_start[:3, 3]
    vector += START_PULL * torch.cat([sines, offset])
    diagonal = matrix.diagonal()
    diagonal += START_PULL + damping * diagonal
    return -torch.linalg.solve(matrix, vector)


def certainty(
    value: Float[np.ndarray, "2 _"],
    reliability: Float[np.ndarray, "_"],
    matrix: Float[np.ndarray, "6 6"],
    tolerance: tuple[float, float],
) -> dict[str, float]:
    """The share of points that fit the map, and how well the curvature of their cost holds a pose.

    Of both residuals, which fit within a tolerance, and the matrix of the normal equations.
    Deviations are along the least certain direction, the condition number without the pull to the
    start, rotations at an arm of 1 m. Errors of the map are not independent, as residuals are here
    taken to be: these are lower bounds, good for telling poses apart, not for error bars.
    """
    distance, intensity = value
    # A picture that is darker as a whole says nothing against a pose.
    middle = np.partition(intensity, len(intensity) // 2)[len(intensity) // 2]
    is_inlier = np.abs(intensity - middle) < tolerance[1]
    is_inlier &= (np.abs(distance) < tolerance[0]) & (reliability > 0)
    values = np.linalg.eigvalsh(matrix)
    covariance = np.linalg.inv(matrix + START_PULL * np.eye(6)) / _DEVIATIONS**2  # rad, m
    rotation, position = (
        np.linalg.eigvalsh(np.stack([covariance[:3, :3], covariance[3:, 3:]]))[:, -1] ** 0.5
    )
    return {
        "inlier_ratio": float(is_inlier.mean()),
        "position_deviation_m": float(position),
        "rotation_deviation_deg": float(np.rad2deg(rotation)),
        "condition_number": float(values[-1] / max(values[0], 1e-9)),
    }


def moved(T_world_camera: Transform, twist: Float[Tensor, "6"]) -> Transform:
    """The pose after a twist (omega in rad, v in m; world axes, about the camera's centre)."""
    rotation = rotation_vector_to_matrix(twist[:3]) @ T_world_camera[:3, :3]
    return make_transform(rotation, T_world_camera[:3, 3] + twist[3:])
