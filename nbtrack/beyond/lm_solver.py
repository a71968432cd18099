"""Levenberg-Marquardt on a pose: the cost of residuals, normal equations, and a step; compiled.

Residuals r, their derivatives J and reliabilities w are those of `lm_residuals`. The index d is for
the distance, i for the intensity. s are the robust scales, u = r / s, l is the weight of intensity,
and rho(u) = u^2 / (1 + u^2) is the loss of Geman and McClure. The cost of n points and the normal
equations are

    cost = 1/n sum [w (rho(u_d) + l rho(u_i)) + (1 - w) (1 + l)]
    H = sum w [J_d' J_d / (s_d (1 + u_d^2))^2 + l J_i' J_i / (s_i (1 + u_i^2))^2]
    b = sum w [J_d' r_d / (s_d (1 + u_d^2))^2 + l J_i' r_i / (s_i (1 + u_i^2))^2]

An unreliable point has the largest cost, so that no pose gets cheaper by moving points out of the
map.

The pose prior P (1 - cos(angle) + offset^2 / 2) has the weight P, for the rotation (angle, axis)
and the offset since the start. With the damping m a step solves

    (H + P + m diag H) twist = -(b + P [sin(angle) axis, offset])

A robust scale is a factor times the median of |r|. It is at least the field's residual sigma, and
never grows.
"""

from typing import no_type_check

import numpy as np

from nbtrack.beyond.lm_residuals import ONE, ZERO, Problem, Terms, residual_terms
from nbtrack.beyond.observed import Array, compiled
from nbtrack.core.arrays import Pose

# The prior is as strong as one point at a twist of 0.5 rad or 0.5 m. It is so weak that it decides
# only along directions in which the frame does not hold the pose, as along a corridor (our choice).
PRIOR_WEIGHT = 1 / 0.5**2
# Steps creep if a step, projected on the last one, is more than _MIN_RATIO times as long as the
# last one. Ratios above _MAX_RATIO count as _MAX_RATIO, which bounds the extrapolation.
_MIN_RATIO = 0.5
_MAX_RATIO = 0.9


def robust_scales(residuals: Array, before: Array, sigma: Array | tuple, factor: float) -> Array:
    """Robust scales of distance (m) and intensity: `factor` times the medians of |residual|.

    `residuals` are 2 x n. A scale is at least its `sigma`, and at most the scale `before`. The
    function is not compiled, since numpy's `partition` would take seconds to compile.
    """
    # In most steps the scales are at their minimum. Then the slow median is not computed.
    if (before <= sigma).all():
        return before
    middle = (residuals.shape[1] - 1) // 2
    median = np.partition(np.abs(residuals), middle, axis=1)[:, middle]
    return np.minimum(np.maximum(factor * median, sigma), before)


@no_type_check
@compiled
def robust_cost(
    residuals: Array, reliability: Array, scales: Array, lambda_intensity: float
) -> float:
    """The mean cost of the points, by the equation in the module's docstring.

    `residuals` (2 x n) and `scales` (2,) are of distance and intensity, `reliability` is (n,).
    """
    total, weight = 0.0, np.float32(lambda_intensity)
    per_scale_d, per_scale_i = np.float32(1 / scales[0]), np.float32(1 / scales[1])
    for i in range(len(reliability)):
        square_d = (residuals[0, i] * per_scale_d) ** 2
        square_i = (residuals[1, i] * per_scale_i) ** 2
        cost = square_d / (ONE + square_d) + weight * square_i / (ONE + square_i)
        total += reliability[i] * cost + (ONE - reliability[i]) * (ONE + weight)
    return total / len(reliability)


def point_costs(terms: Terms, scales: Array, lambda_intensity: float) -> Array:
    """The cost of each point (n,). Their mean is `robust_cost`."""
    squares = (terms.residuals / scales[:, None]) ** 2
    distance, intensity = squares / (1 + squares)
    cost = distance + lambda_intensity * intensity
    return terms.reliability * cost + (1 - terms.reliability) * (1 + lambda_intensity)


@no_type_check
@compiled
def normal_equations(terms: Terms, scales: Array, lambda_intensity: float) -> tuple[Array, Array]:
    """H (6 x 6) and b (6,) of the module's docstring, in double precision."""
    n_points = len(terms.reliability)
    jacobian, weights = np.empty((6, n_points), np.float32), np.empty(n_points, np.float32)
    matrix, vector = np.zeros((6, 6)), np.zeros(6)
    for k in range(2):  # distance, intensity
        scale, factor = np.float32(scales[k]), np.float32(lambda_intensity if k == 1 else 1.0)
        residuals, gradients = terms.residuals[k], terms.gradients[k]
        for i in range(n_points):
            gx, gy, gz = gradients[0, i], gradients[1, i], gradients[2, i]
            ax, ay, az = terms.lever_arms[0, i], terms.lever_arms[1, i], terms.lever_arms[2, i]
            # A column of the Jacobian: the cross product a x g of lever arm and gradient, then g.
            jacobian[0, i], jacobian[1, i] = ay * gz - az * gy, az * gx - ax * gz
            jacobian[2, i], jacobian[3, i] = ax * gy - ay * gx, gx
            jacobian[4, i], jacobian[5, i] = gy, gz
            divisor = (ONE + (residuals[i] / scale) ** 2) * scale
            weights[i] = factor * terms.reliability[i] / (divisor * divisor)
        for a in range(6):
            for i in range(n_points):
                vector[a] += weights[i] * jacobian[a, i] * residuals[i]
            for b in range(a + 1):
                total = 0.0
                for i in range(n_points):
                    total += weights[i] * jacobian[a, i] * jacobian[b, i]
                matrix[a, b] += total
                matrix[b, a] = matrix[a, b]
    return matrix, vector


@no_type_check
@compiled
def retract(T: Pose, twist: Array) -> Pose:
    """The pose after a twist (omega in rad, v in m; world axes), by Rodrigues' formula."""
    x, y, z = twist[0], twist[1], twist[2]
    angle = np.sqrt(x * x + y * y + z * z)
    # Near 0 both have their limits: sin(angle) / angle, and (1 - cos(angle)) / angle^2.
    sine = np.sin(angle) / angle if angle > 1e-9 else 1.0
    versine = 2 * (np.sin(angle / 2) / angle) ** 2 if angle > 1e-9 else 0.5
    after = T.copy()
    # A column of the rotation is an axis u = (a, b, c) of the camera. With w = (x, y, z) it turns
    # into u + sine w x u + versine w x (w x u), and w x u = (p, q, r).
    for k in range(3):
        a, b, c = T[0, k], T[1, k], T[2, k]
        p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
        after[0, k] += sine * p + versine * (y * r - z * q)
        after[1, k] += sine * q + versine * (z * p - x * r)
        after[2, k] += sine * r + versine * (x * q - y * p)
        after[k, 3] += twist[3 + k]
    return after


@no_type_check
@compiled
def damped_step(problem: Problem, T: Pose, terms: Terms, scales: Array, damping: float) -> Array:
    """The twist (6,) that solves the damped normal equations of residuals and pose prior."""
    matrix, vector = normal_equations(terms, scales, problem.lambda_intensity)
    for k in range(3):
        # sin(angle) axis is half of the differences Q_ij - Q_ji of the rotation Q = R R_start'.
        i, j = (k + 2) % 3, (k + 1) % 3
        difference = 0.0
        for m in range(3):
            difference += T[i, m] * problem.T_start[j, m] - T[j, m] * problem.T_start[i, m]
        vector[k] += PRIOR_WEIGHT * difference / 2
        vector[3 + k] += PRIOR_WEIGHT * (T[k, 3] - problem.T_start[k, 3])
    for k in range(6):
        matrix[k, k] += PRIOR_WEIGHT + damping * matrix[k, k]
    # Gaussian elimination, without pivots, since the matrix is positive definite. The substitution
    # after it gives -vector / matrix: the right side has a minus.
    for k in range(6):
        for i in range(k + 1, 6):
            share = matrix[i, k] / matrix[k, k]
            vector[i] -= share * vector[k]
            for j in range(k, 6):
                matrix[i, j] -= share * matrix[k, j]
    for k in range(5, -1, -1):
        for j in range(k + 1, 6):
            vector[k] += matrix[k, j] * vector[j]
        vector[k] /= -matrix[k, k]
    return vector


@no_type_check
@compiled
def try_step(
    problem: Problem, T: Pose, terms: Terms, scales: Array, damping: float, last_twist: Array
) -> tuple[bool, Pose, Terms, Array, float, float]:
    """Try a step from the pose `T`, whose terms are `terms`, and take it if it lowers the cost.

    `last_twist` is the step that was taken before (0 at first). Steps creep if each is hardly
    shorter than the last one and has nearly the same direction. They are then taken for a geometric
    series: its limit is tried first (Aitken 1926), as far as `_MAX_RATIO` allows, and the step
    alone if the cost at the limit is no lower.

    In the fine stage, the cost after the step takes the reliabilities from before the step, and 0
    for points that are not usable any more. For gradients of a grid jump from cell to cell, and
    reliabilities with them, although the pose is no worse. In the coarse stage the new
    reliabilities count: far from the pose, a reliable gradient is a sign that a surface is near.

    Returns, in this order, whether the step is taken; the pose and the terms after it, and its
    twist without extrapolation, or those from before if it is not taken; the largest component (rad
    or m) of the twist that was tried last; and the cost before the step.
    """
    twist = damped_step(problem, T, terms, scales, damping)
    before = robust_cost(terms.residuals, terms.reliability, scales, problem.lambda_intensity)
    along, square = (twist * last_twist).sum(), (last_twist * last_twist).sum()
    # along / square is the ratio of lengths. The angle between the twists must be below 45 degrees,
    # so that the square of its cosine is above 0.5.
    does_creep = along > _MIN_RATIO * square and along**2 > 0.5 * square * (twist * twist).sum()
    stride = 1 / (1 - min(along / square, _MAX_RATIO)) if does_creep else 1.0
    for factor in (stride, 1.0):
        T_after = retract(T, factor * twist)
        after = residual_terms(problem, T_after)
        reliability = after.reliability
        if problem.stage.is_fine:
            reliability = np.where(reliability > 0, terms.reliability, ZERO)
        cost = robust_cost(after.residuals, reliability, scales, problem.lambda_intensity)
        if cost < before:
            return True, T_after, after, twist, factor * np.abs(twist).max(), before
        if not does_creep:
            break
    return False, T, terms, last_twist, np.abs(twist).max(), before
