"""One Levenberg-Marquardt descent of a pose in a grid: residuals, normal equations, steps.

A point p of the frame (m, camera frame) has an intensity c (luma, in [0, 1]) and perhaps a unit
normal n. At the pose (R, t) it lies at x = R p + t, with the lever arm a = x - t. The grid
interpolates the signed distance f(x) (m), the intensity I(x) and the confidence k(x). With the
gradient norm g = |grad f(x)|, never below G_MIN where it divides, a point has two residuals and
their derivatives with respect to a twist (omega, v):

    r_d = f / g,   q_d = grad f / g,   J_d = [(a x q_d)', q_d']
    r_i = I - c,   q_i = grad I,       J_i = [(a x q_i)', q_i']

g is held fixed in J_d. Dividing by it corrects distances that grow too fast or too slowly to first
order. Source: paper, Eq. 2; f / |grad f| is an option in PIN-SLAM (Pan et al. 2024).

A twist changes the pose about the camera's centre, with world axes: x -> t + v + exp(omega) a.

The reliability w of a point, in [0, 1], is 0 outside of the bounds and their margin, and where
g <= G_MIN or g >= G_MAX (PIN-SLAM: 0.5 to 2); elsewhere

    w = (1 + ((g - 1) / G_SCALE)^2)^-2 * max(0, (R n)' grad f / g)^2 * k

The factor of the normal counts where one is given (coarse stage): the nearest surface is not the
observed one if it faces elsewhere. That of k counts in the fine stage: from afar, where no point
lies at its surface, none would count. With scales s, the weight l of intensity, u = r / s, and
Geman-McClure's rho(u) = u^2 / (1 + u^2), the cost of n points and the normal equations are

    cost = 1/n sum [w (rho(u_d) + l rho(u_i)) + (1 - w) (1 + l)]
    H = sum w [J_d' J_d / (s_d (1 + u_d^2))^2 + l J_i' J_i / (s_i (1 + u_i^2))^2]
    b = sum w [J_d' r_d / (s_d (1 + u_d^2))^2 + l J_i' r_i / (s_i (1 + u_i^2))^2]

so that an unusable point costs the most: no pose gets cheaper by moving points out of the map. A
step solves, with the damping m and the prior weight P,

    (H + P + m diag H) twist = -(b + P [sin(angle) axis, offset])

of the turn and the offset since the start: the pose prior P (1 - cos(angle) + offset^2 / 2).
Scales are a factor times the median of |r|, never below the field's residual sigma, and never grow.
"""

from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.observed import LUMA, Observed, compiled
from nbtrack.core.arrays import Pose

G_MIN = 0.3
G_MAX = 2.0
G_SCALE = 0.5
MARGIN = 0.3  # m beyond a field's bounds, where walls lie if the pose is off
# So weak that it decides only where the frame says nothing, as along a corridor: one point's worth
# at a twist of 0.5 rad or 0.5 m (our choice).
PRIOR_WEIGHT = 1 / 0.5**2
# A point fits if it lies as near to the surface as the field says, and is so like it in luma.
_INLIER_INTENSITY = 0.25
_FIRST_DAMPING = 1e-4
_MIN_DAMPING = 1e-9
_MAX_DAMPING = 1e3
_DAMPING_UP = 10.0
_DAMPING_DOWN = 0.2
_MIN_RATIO = 0.5  # of two steps' lengths, from which on they creep
_MAX_RATIO = 0.9  # of theirs, up to which the limit of the series is tried
# The coarse stage may lead away from a good start: the better of both goes on, at these scales.
NEAR_SCALES = np.array([0.02, 0.05])
_ONE = np.float32(1)
_ZERO = np.float32(0)


class Stage(NamedTuple):
    """Which residuals count in a part of a descent, and when it ends."""

    is_fine: bool  # all points, both residuals and confidence; else some points' distances, normals
    mad_factor: float  # medians of |r| in a robust scale
    min_step: float  # rad and m: a shorter twist ends the stage


# From afar distances say where the camera is; intensities mislead: their basin is as wide as the
# texture. 3 medians are two standard deviations, were residuals normal.
COARSE = Stage(False, 10.0, 1e-2)
FINE = Stage(True, 3.0, 3e-4)
_SIGMAS = 0.6745 * FINE.mad_factor


class Grid:
    """A baked field as the compiled functions take it."""

    def __init__(self, field: BakedField) -> None:
        """The grid of a field on the host."""
        low, high = np.array(field.bounds.minimum), np.array(field.bounds.maximum)
        usable = low - MARGIN, high + MARGIN
        place = np.concatenate([field.low.double().numpy(), [field.voxel], *usable])
        intensity = field.volume[:3].T @ torch.tensor(LUMA)
        value, confidence = field.volume[3:]
        vertices = torch.stack([value, intensity, confidence], dim=-1).numpy()
        # Vertices as (distance, intensity, confidence), their numbers along x, y and z, and their
        # place: the first vertex, the voxel, and both corners of the box whose points are usable.
        self.arrays = vertices, np.array(field.n_vertices), place
        self.residual_sigma = np.array(field.residual_sigma)
        self.inlier_distance = field.inlier_distance


class Descent:
    """A search from a start, on some of a frame's points, then on all, in double precision.

    The caller takes steps until `is_ended`, refines, and takes steps until `is_ended` again.

    A step is taken only if it lowers the robust cost; else the damping grows. Robust scales follow
    the residuals down, so that far-off starts converge and outliers are down-weighted in the end.
    """

    def __init__(
        self, grid: Grid, some: Observed, all: Observed, lambda_intensity: float, T_start: Pose
    ) -> None:
        """Begin with some points, for the coarse stage, and all, for the fine one."""
        self.grid = grid
        self.points = some, all
        self.lambda_intensity = lambda_intensity
        self.T_start = self.T_world_camera = T_start
        self.last_step = np.inf  # rad or m, whichever is more
        self._begin(COARSE)
        self._start_cost = self.cost(NEAR_SCALES)

    def step(self) -> float:
        """One step, taken or refused; returns the robust cost before it."""
        is_better, self.T_world_camera, self.terms, before, self.twist, self.last_step = _try_step(
            self.points[self.stage.is_fine], self.grid.arrays, self.stage.is_fine, self.weight,
            self.T_start, self.T_world_camera, self.terms, self.scales, self.damping, self.twist,
        )  # fmt: skip
        if is_better:
            self._narrow()
        down = max(self.damping * _DAMPING_DOWN, _MIN_DAMPING)
        self.damping = down if is_better else self.damping * _DAMPING_UP
        self.is_ended = self.last_step < self.stage.min_step or self.damping > _MAX_DAMPING
        return before

    def refine(self) -> None:
        """Go on with all points from where the coarse stage ended, or from the start if better."""
        if self.cost(NEAR_SCALES) > self._start_cost:
            self.T_world_camera = self.T_start
        self._begin(FINE)

    @property
    def is_finished(self) -> bool:
        """Whether further steps would change nothing."""
        return self.is_ended and self.stage.is_fine

    def cost(self, scales: Float[np.ndarray, "2"]) -> float:
        """The robust cost of both residuals at given scales, by which descents are compared.

        Intensities have the weight of the fine stage, in the coarse one too.
        """
        return robust_cost(self.terms, scales, self.lambda_intensity)

    def certainty(self) -> dict[str, float]:
        """The share of points that fit, and how well the curvature of their cost holds the pose.

        `known_ratio` is the mean reliability of the points, `fitting_ratio` the share of those that
        fit, each counted by its reliability: where little was mapped, few can fit at any pose.
        Intensities count by their differences from the median of all; `intensity_mad` is the median
        of those (MAD), 0 where they have no weight. Standard deviations are along the least certain
        direction, the condition number without the pose prior, rotations at a lever arm of 1 m.
        Errors of the map are not independent, as residuals are here taken to be: these are lower
        bounds, good for telling poses apart, not for error bars.
        """
        distance, intensity, reliability = self.terms[:3]
        is_inlier = np.abs(distance) < self.grid.inlier_distance
        is_inlier &= reliability > 0
        # A picture that is darker as a whole says nothing against a pose.
        off = np.abs(intensity - _median(intensity)) * (self.lambda_intensity > 0)
        is_inlier &= off < _INLIER_INTENSITY
        known_ratio = float(reliability.mean())
        fitting = float((reliability * is_inlier).mean()) / max(known_ratio, 1e-6)
        matrix, _ = normal_equations(self.terms, self.scales, self.weight)
        values = np.linalg.eigvalsh(matrix)
        covariance = np.linalg.inv(matrix + PRIOR_WEIGHT * np.eye(6)) / _SIGMAS**2  # rad, m
        blocks = np.stack([covariance[:3, :3], covariance[3:, 3:]])
        rotation, position = np.linalg.eigvalsh(blocks)[:, -1] ** 0.5
        return {
            "inlier_ratio": float(is_inlier.mean()),
            "known_ratio": known_ratio,
            "fitting_ratio": fitting,
            "intensity_mad": float(_median(off)),
            "position_std_m": float(position),
            "rotation_std_deg": float(np.rad2deg(rotation)),
            "condition_number": float(values[-1] / max(values[0], 1e-9)),
        }

    def _begin(self, stage: Stage) -> None:
        self.stage = stage
        self.damping = _FIRST_DAMPING
        self.is_ended = False
        self.twist = np.zeros(6)  # of the step before
        self.weight = self.lambda_intensity if stage.is_fine else 0.0
        observed = self.points[stage.is_fine]
        T = self.T_world_camera
        self.terms = residual_terms(observed, T, self.grid.arrays, stage.is_fine)
        self.scales = np.full(2, np.inf)
        self._narrow()

    def _narrow(self) -> None:
        residual_sigma = self.grid.residual_sigma
        factor = self.stage.mad_factor
        self.scales = scales_of(self.terms, self.scales, residual_sigma, factor)


def _median(values: Float[np.ndarray, "n"]) -> float:
    return np.partition(values, len(values) // 2)[len(values) // 2]


@no_type_check
@compiled
def _weigh(terms, normals, T):
    """Reliability by the gradient norm and the angle to normals, and division by the norm."""
    for i in range(terms.shape[1]):
        g = np.sqrt(terms[6, i] ** 2 + terms[7, i] ** 2 + terms[8, i] ** 2)
        weight = _ONE / (_ONE + ((g - _ONE) / np.float32(G_SCALE)) ** 2)
        terms[2, i] *= weight * weight if G_MIN < g < G_MAX else _ZERO
        divisor = max(g, np.float32(G_MIN))
        if len(normals):
            cosine = 0.0
            for k in range(3):
                turned = T[k, 0] * normals[i, 0] + T[k, 1] * normals[i, 1] + T[k, 2] * normals[i, 2]
                cosine += terms[6 + k, i] * turned / divisor
            terms[2, i] *= max(cosine, 0.0) ** 2
        terms[0, i] /= divisor
        for k in range(6, 9):
            terms[k, i] /= divisor


@no_type_check
@compiled
def _locate(terms, points, T, shape, place):
    """Lever arms, and whether points are usable; their cells, where in them, and 1 / voxel."""
    inverse, numbers = 1 / place[3], np.zeros(len(points), np.int64)
    at, inside = np.empty((2, 3, len(points)), np.float32)
    terms[2] = _ONE
    for k in range(3):
        last = shape[k] - 1.0
        for i in range(len(points)):
            lever_arm = T[k, 0] * points[i, 0] + T[k, 1] * points[i, 1] + T[k, 2] * points[i, 2]
            world = lever_arm + T[k, 3]
            terms[3 + k, i] = lever_arm
            terms[2, i] *= (place[4 + k] <= world) & (world <= place[7 + k])
            scaled = (world - place[k]) * inverse
            # Points outside are moved to the border, where the gradient is 0; so are NaNs.
            inside[k, i] = inverse if (scaled >= 0) & (scaled <= last) else 0.0
            scaled = min(scaled, last) if scaled > 0 else 0.0
            cell = min(int(scaled), shape[k] - 2)
            at[k, i], numbers[i] = scaled - cell, numbers[i] * shape[k] + cell
    return numbers, at, inside


@no_type_check
@compiled
def residual_terms(observed, T, grid, is_fine):
    """A column of twelve a point: r_d, r_i, w, a (3), q_d (3), q_i (3), at a pose.

    Loops are plain, which numba compiles soonest; no result depends on the number of threads.
    """
    (points, intensity, normals), (vertices, shape, place) = observed, grid
    terms = np.empty((12, len(points)), np.float32)
    numbers, at, inside = _locate(terms, points, T, shape, place)
    step_x, step_y, one = np.uintp(shape[1] * shape[2]), np.uintp(shape[2]), np.uintp(1)
    for i in range(len(points)):
        v, x, y, z = np.uintp(numbers[i]), at[0, i], at[1, i], at[2, i]
        for k in range(3 if is_fine else 2):
            a, b = vertices[v, k], vertices[v + one, k]
            c, d = vertices[v + step_y, k], vertices[v + step_y + one, k]
            e, f = vertices[v + step_x, k], vertices[v + step_x + one, k]
            g, h = vertices[v + step_x + step_y, k], vertices[v + step_x + step_y + one, k]
            ab, cd, ef, gh = a + z * (b - a), c + z * (d - c), e + z * (f - e), g + z * (h - g)
            low, high = ab + y * (cd - ab), ef + y * (gh - ef)
            if k == 2:
                terms[2, i] *= low + x * (high - low)
                break
            low_z, high_z = b - a + y * (d - c - b + a), f - e + y * (h - g - f + e)
            terms[k, i] = low + x * (high - low)
            terms[6 + 3 * k, i] = (high - low) * inside[0, i]
            terms[7 + 3 * k, i] = (cd - ab + x * (gh - ef - cd + ab)) * inside[1, i]
            terms[8 + 3 * k, i] = (low_z + x * (high_z - low_z)) * inside[2, i]
        terms[1, i] -= intensity[i]
    _weigh(terms, normals, T)
    return terms


def scales_of(terms, before, residual_sigma, mad_factor):
    """Robust scales of both residuals; numpy's own median, whose compilation would take seconds."""
    if (before <= residual_sigma).all():  # as in most steps: a median takes as long as many sums
        return before
    middle = (terms.shape[1] - 1) // 2
    median = np.partition(np.abs(terms[:2]), middle, axis=1)[:, middle]
    return np.minimum(np.maximum(mad_factor * median, residual_sigma), before)


@no_type_check
@compiled
def robust_cost(terms, scales, weight):
    """The mean cost of the points; `weight` is that of intensity."""
    total, weight = 0.0, np.float32(weight)
    first, second = np.float32(1 / scales[0]), np.float32(1 / scales[1])
    for i in range(terms.shape[1]):
        u, v = (terms[0, i] * first) ** 2, (terms[1, i] * second) ** 2
        cost = u / (_ONE + u) + weight * v / (_ONE + v)
        total += terms[2, i] * cost + (_ONE - terms[2, i]) * (_ONE + weight)
    return total / terms.shape[1]


@no_type_check
@compiled
def normal_equations(terms, scales, weight):
    """H (6 x 6) and b (6), in double precision."""
    n_points = terms.shape[1]
    jacobian, weights = np.empty((6, n_points), np.float32), np.empty(n_points, np.float32)
    matrix, vector = np.zeros((6, 6)), np.zeros(6)
    for k in range(2):
        scale, share = np.float32(scales[k]), np.float32(weight if k else 1.0)
        for i in range(n_points):
            gx, gy, gz = terms[6 + 3 * k, i], terms[7 + 3 * k, i], terms[8 + 3 * k, i]
            ax, ay, az = terms[3, i], terms[4, i], terms[5, i]
            jacobian[0, i], jacobian[1, i] = ay * gz - az * gy, az * gx - ax * gz
            jacobian[2, i], jacobian[3, i] = ax * gy - ay * gx, gx
            jacobian[4, i], jacobian[5, i] = gy, gz
            flat = (_ONE + (terms[k, i] / scale) ** 2) * scale
            weights[i] = share * terms[2, i] / (flat * flat)
        for a in range(6):
            for i in range(n_points):
                vector[a] += weights[i] * jacobian[a, i] * terms[k, i]
            for b in range(a + 1):
                total = 0.0
                for i in range(n_points):
                    total += weights[i] * jacobian[a, i] * jacobian[b, i]
                matrix[a, b] += total
                matrix[b, a] = matrix[a, b]
    return matrix, vector


@no_type_check
@compiled
def retract(T, twist):
    """The pose after a twist (omega in rad, v in m), by Rodrigues' formula; finite at zero."""
    x, y, z = twist[0], twist[1], twist[2]
    angle = np.sqrt(x * x + y * y + z * z)
    sine = np.sin(angle) / angle if angle > 1e-9 else 1.0
    versine = 2 * (np.sin(angle / 2) / angle) ** 2 if angle > 1e-9 else 0.5
    after = T.copy()
    for k in range(3):  # an axis a of the camera turns into a + sine w x a + versine w x (w x a)
        a, b, c = T[0, k], T[1, k], T[2, k]
        p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
        after[0, k] += sine * p + versine * (y * r - z * q)
        after[1, k] += sine * q + versine * (z * p - x * r)
        after[2, k] += sine * r + versine * (x * q - y * p)
        after[k, 3] += twist[3 + k]
    return after


@no_type_check
@compiled
def damped_step(terms, scales, weight, T_start, T, damping):
    """The twist (6,) that solves the damped normal equations of data and prior."""
    matrix, vector = normal_equations(terms, scales, weight)
    for k in range(3):
        i, j = (k + 2) % 3, (k + 1) % 3
        turned = 0.0
        for m in range(3):
            turned += T[i, m] * T_start[j, m] - T[j, m] * T_start[i, m]
        vector[k] += PRIOR_WEIGHT * turned / 2
        vector[3 + k] += PRIOR_WEIGHT * (T[k, 3] - T_start[k, 3])
    for k in range(6):
        matrix[k, k] += PRIOR_WEIGHT + damping * matrix[k, k]
    for k in range(6):  # elimination without pivots, which positive definite matrices do not need
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
def _try_step(observed, grid, is_fine, weight, T_start, T, terms, scales, damping, last):
    """A step: whether it is better, pose and terms after it, cost before, its twist and length.

    Steps that creep, each hardly shorter than the last one, are a geometric series: first its
    limit is tried (Aitken 1926), so far as `_MAX_RATIO` allows.

    From cell to cell of a grid gradients jump, and reliabilities: in the fine stage a pose is no
    worse for that. But at first, from afar, the gradient tells that a surface is near.
    """
    twist = damped_step(terms, scales, weight, T_start, T, damping)
    before = robust_cost(terms, scales, weight)
    along, length = (twist * last).sum(), (last * last).sum()
    does_creep = along > _MIN_RATIO * length and along**2 > 0.5 * length * (twist * twist).sum()
    stride = 1 / (1 - min(along / length, _MAX_RATIO)) if does_creep else 1.0
    for factor in (stride, 1.0):
        T_after = retract(T, factor * twist)
        terms_after = residual_terms(observed, T_after, grid, is_fine)
        judged = terms_after[:3].copy()
        if is_fine:
            judged[2] = np.where(judged[2] > 0, terms[2], _ZERO)
        if robust_cost(judged, scales, weight) < before:
            return True, T_after, terms_after, before, twist, factor * np.abs(twist).max()
        if factor == 1:
            break
    return False, T, terms, before, last, np.abs(twist).max()
