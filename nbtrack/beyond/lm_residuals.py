"""Residuals of a frame's points at a pose in a grid, with derivatives and reliabilities; compiled.

A point p of the frame (m, camera frame) has an intensity c (luma, in [0, 1]) and perhaps a unit
normal n. At the pose (R, t) it lies at x = R p + t, with the lever arm a = x - t. The grid
interpolates the signed distance f(x) (m), the intensity I(x) and the confidence k(x). The gradient
norm is g = |grad f(x)|, and at least G_MIN in divisions. A point has two residuals and their
derivatives with respect to a twist (omega, v):

    r_d = f / g,   q_d = grad f / g,   J_d = [(a x q_d)', q_d']
    r_i = I - c,   q_i = grad I,       J_i = [(a x q_i)', q_i']

J_d takes g as constant. The division by g corrects, to first order, distances that grow too fast or
too slowly. Source: paper, Eq. 2; f / |grad f| is an option in PIN-SLAM (Pan et al. 2024).

A twist changes the pose about the camera's centre, with world axes: x -> t + v + exp(omega) a.

The reliability w of a point lies in [0, 1]. It is 0 farther than a margin outside of the bounds,
and if g <= G_MIN or g >= G_MAX (PIN-SLAM: 0.5 to 2). Otherwise

    w = (1 + ((g - 1) / G_SCALE)^2)^-2 * max(0, (R n)' grad f / g)^2 * k

The second factor is used if the points have normals, as in the coarse stage: a surface that faces
another way is not the observed one. The factor k is used in the fine stage alone. In the coarse
stage no point may lie at its surface yet, and none would count.
"""

from typing import NamedTuple, no_type_check

import numpy as np
import torch

from nbtrack.beyond.grid import Accuracy, BakedField
from nbtrack.beyond.observed import LUMA, Array, Observed, compiled
from nbtrack.core.arrays import Pose

G_MIN = 0.3
G_MAX = 2.0
G_SCALE = 0.5
# m. Points up to so far outside of the bounds are used: walls lie there while the pose is off.
MARGIN = 0.3
ONE = np.float32(1)
ZERO = np.float32(0)


class Grid(NamedTuple):
    """A baked field in a form that compiled functions can take. Lengths in m."""

    vertices: np.ndarray  # n x 3: distance, intensity, confidence; row-major, z is fastest
    n_vertices: np.ndarray  # 3, along x, y and z
    low: np.ndarray  # 3, position of the first vertex
    voxel: float
    usable_low: np.ndarray  # 3, lowest and highest corner of the box in which points are used
    usable_high: np.ndarray
    accuracy: Accuracy


class Stage(NamedTuple):
    """Settings of the coarse or the fine stage of a descent."""

    # True: all points, with both residuals and the confidence. False: some points, with distances
    # and normals.
    is_fine: bool
    mad_factor: float  # a robust scale is so many medians of |r|
    min_step: float  # rad and m: a shorter twist ends the stage


class Problem(NamedTuple):
    """All that stays the same in a stage: what `lm_solver` needs besides the pose."""

    observed: Observed
    grid: Grid
    stage: Stage
    lambda_intensity: float
    T_start: Pose  # the pose prior's mean


class Terms(NamedTuple):
    """Residuals, reliabilities and derivatives of n points at a pose, in single precision.

    Of two rows the first is for the distance, the second for the intensity.
    """

    residuals: np.ndarray  # 2 x n: r_d (m) and r_i
    reliability: np.ndarray  # n: w
    lever_arms: np.ndarray  # 3 x n: a (m)
    gradients: np.ndarray  # 2 x 3 x n: q_d and q_i


def grid_of(field: BakedField) -> Grid:
    """Convert a baked field on the host for the compiled functions."""
    intensity = field.volume[:3].T @ torch.tensor(LUMA, dtype=torch.float32)
    value, confidence = field.volume[3:]
    vertices = torch.stack([value, intensity, confidence], dim=1).numpy()
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])
    shape, first = np.array(field.n_vertices), field.low.double().numpy()
    usable = low - MARGIN, high + MARGIN
    return Grid(vertices, shape, first, field.voxel, *usable, field.accuracy)


@no_type_check
@compiled
def residual_terms(problem: Problem, T: Pose) -> Terms:
    """The terms of a problem's points at the pose `T`.

    Plain loops compile fastest in numba, and no result depends on the number of threads.
    """
    points, grid = problem.observed.points, problem.grid
    n_points = len(points)
    residuals = np.empty((2, n_points), np.float32)
    gradients = np.empty((2, 3, n_points), np.float32)
    lever_arms, reliability, cells, in_cell, per_metre = _locate(points, T, grid)
    # Indices of vertices are unsigned, so that numba adds no check for negative ones.
    vertices, step_z = grid.vertices, np.uintp(1)
    step_x, step_y = np.uintp(grid.n_vertices[1] * grid.n_vertices[2]), np.uintp(grid.n_vertices[2])
    for i in range(n_points):
        v, x, y, z = np.uintp(cells[i]), in_cell[0, i], in_cell[1, i], in_cell[2, i]
        for k in range(3 if problem.stage.is_fine else 2):  # distance, intensity, confidence
            # Trilinear interpolation. The digits are of x, y and z, 0 for the low side of the cell:
            # c011 is at the corner with low x, high y and high z. c01 is interpolated along z, and
            # c0 along z and y.
            c000, c001 = vertices[v, k], vertices[v + step_z, k]
            c010, c011 = vertices[v + step_y, k], vertices[v + step_y + step_z, k]
            c100, c101 = vertices[v + step_x, k], vertices[v + step_x + step_z, k]
            c110, c111 = vertices[v + step_x + step_y, k], vertices[v + step_x + step_y + step_z, k]
            c00, c01 = c000 + z * (c001 - c000), c010 + z * (c011 - c010)
            c10, c11 = c100 + z * (c101 - c100), c110 + z * (c111 - c110)
            c0, c1 = c00 + y * (c01 - c00), c10 + y * (c11 - c10)
            if k == 2:  # the confidence, whose derivatives are not used
                reliability[i] *= c0 + x * (c1 - c0)
                break
            # Derivatives along z at low x and at high x, interpolated along y.
            low_z = c001 - c000 + y * (c011 - c010 - c001 + c000)
            high_z = c101 - c100 + y * (c111 - c110 - c101 + c100)
            residuals[k, i] = c0 + x * (c1 - c0)
            gradients[k, 0, i] = (c1 - c0) * per_metre[0, i]
            gradients[k, 1, i] = (c01 - c00 + x * (c11 - c10 - c01 + c00)) * per_metre[1, i]
            gradients[k, 2, i] = (low_z + x * (high_z - low_z)) * per_metre[2, i]
        residuals[1, i] -= problem.observed.intensity[i]
    terms = Terms(residuals, reliability, lever_arms, gradients)
    _weigh(terms, problem.observed.normals, T)
    return terms


@no_type_check
@compiled
def _locate(points: Array, T: Pose, grid: Grid) -> tuple[Array, ...]:
    """Locate points (n x 3, m, camera frame) in the grid at the pose `T`.

    Returns five arrays:

    - lever arms (3 x n, m);
    - reliabilities (n): 1, or 0 outside of the usable box;
    - cells (n): the row-major numbers of their lowest vertices;
    - positions in the cells (3 x n, from 0 to 1);
    - factors (3 x n, 1/m) that make derivatives per cell derivatives per metre: 1 / voxel, or 0 for
      points outside of the grid along that axis.
    """
    n_points, inverse = len(points), 1 / grid.voxel
    reliability, cells = np.ones(n_points, np.float32), np.zeros(n_points, np.int64)
    lever_arms = np.empty((3, n_points), np.float32)
    in_cell, per_metre = np.empty((2, 3, n_points), np.float32)
    for k in range(3):
        last = grid.n_vertices[k] - 1.0
        for i in range(n_points):
            lever_arm = T[k, 0] * points[i, 0] + T[k, 1] * points[i, 1] + T[k, 2] * points[i, 2]
            world = lever_arm + T[k, 3]
            lever_arms[k, i] = lever_arm
            if not grid.usable_low[k] <= world <= grid.usable_high[k]:
                reliability[i] = 0
            scaled = (world - grid.low[k]) * inverse
            # Points outside of the grid, and NaN, are moved to its border. Their gradient is 0.
            per_metre[k, i] = inverse if (scaled >= 0) & (scaled <= last) else 0.0
            scaled = min(scaled, last) if scaled > 0 else 0.0
            cell = min(int(scaled), grid.n_vertices[k] - 2)
            in_cell[k, i] = scaled - cell
            cells[i] = cells[i] * grid.n_vertices[k] + cell  # row-major after all axes
    return lever_arms, reliability, cells, in_cell, per_metre


@no_type_check
@compiled
def _weigh(terms: Terms, normals: Array, T: Pose) -> None:
    """Complete the terms in place.

    Distances and their gradients are divided by the gradient norm g. Reliabilities are multiplied
    by the factor of g and, if the points have normals, by that of the normals.
    """
    gradient = terms.gradients[0]
    for i in range(len(terms.reliability)):
        g = np.sqrt(gradient[0, i] ** 2 + gradient[1, i] ** 2 + gradient[2, i] ** 2)
        weight = ONE / (ONE + ((g - ONE) / np.float32(G_SCALE)) ** 2)
        terms.reliability[i] *= weight * weight if G_MIN < g < G_MAX else ZERO
        divisor = max(g, np.float32(G_MIN))
        if len(normals):
            cosine = 0.0
            for k in range(3):
                turned = T[k, 0] * normals[i, 0] + T[k, 1] * normals[i, 1] + T[k, 2] * normals[i, 2]
                cosine += gradient[k, i] * turned / divisor
            terms.reliability[i] *= max(cosine, 0.0) ** 2
        terms.residuals[0, i] /= divisor
        for k in range(3):
            gradient[k, i] /= divisor
