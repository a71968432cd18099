"""Residuals of a frame's points at a pose in a grid, with derivatives and reliabilities; compiled.

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
lies at its surface, none would count.
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
MARGIN = 0.3  # m beyond a field's bounds, where walls lie if the pose is off
ONE = np.float32(1)
ZERO = np.float32(0)


class Grid(NamedTuple):
    """A baked field as the compiled functions take it. Lengths in m."""

    vertices: np.ndarray  # n x 3: distance, intensity, confidence; z is fastest
    n_vertices: np.ndarray  # 3, along x, y and z
    low: np.ndarray  # 3, the first vertex
    voxel: float
    usable_low: np.ndarray  # 3, corners of the box whose points are usable
    usable_high: np.ndarray
    accuracy: Accuracy


class Stage(NamedTuple):
    """Which residuals count in a part of a search, and when it ends."""

    is_fine: bool  # all points, both residuals and confidence; else some points' distances, normals
    mad_factor: float  # medians of |r| in a robust scale
    min_step: float  # rad and m: a shorter twist ends the stage


class Problem(NamedTuple):
    """What the cost and the prior of `lm_solver` need to be computed at a pose."""

    observed: Observed
    grid: Grid
    stage: Stage
    lambda_intensity: float
    T_start: Pose


class Terms(NamedTuple):
    """What the cost needs of n points at a pose, in single precision. Distances come first."""

    residuals: np.ndarray  # 2 x n: r_d (m) and r_i
    reliability: np.ndarray  # n: w
    lever_arms: np.ndarray  # 3 x n: a (m)
    gradients: np.ndarray  # 2 x 3 x n: q_d and q_i


def grid_of(field: BakedField) -> Grid:
    """The grid of a field on the host."""
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
    """The terms of all points at a pose.

    Loops are plain, which numba compiles soonest; no result depends on the number of threads.
    """
    points, grid = problem.observed.points, problem.grid
    n_points = len(points)
    residuals = np.empty((2, n_points), np.float32)
    gradients = np.empty((2, 3, n_points), np.float32)
    lever_arms, reliability, cells, in_cell, per_metre = _locate(points, T, grid)
    # Unsigned numbers of vertices, so that numba adds no check for negative indices.
    vertices, step_z = grid.vertices, np.uintp(1)
    step_x, step_y = np.uintp(grid.n_vertices[1] * grid.n_vertices[2]), np.uintp(grid.n_vertices[2])
    for i in range(n_points):
        v, x, y, z = np.uintp(cells[i]), in_cell[0, i], in_cell[1, i], in_cell[2, i]
        for k in range(3 if problem.stage.is_fine else 2):  # distance, intensity, confidence
            # Trilinear interpolation: c011 is the value at the cell's corner that is low in x, high
            # in y and z; c01 is interpolated along z, c0 along y as well.
            c000, c001 = vertices[v, k], vertices[v + step_z, k]
            c010, c011 = vertices[v + step_y, k], vertices[v + step_y + step_z, k]
            c100, c101 = vertices[v + step_x, k], vertices[v + step_x + step_z, k]
            c110, c111 = vertices[v + step_x + step_y, k], vertices[v + step_x + step_y + step_z, k]
            c00, c01 = c000 + z * (c001 - c000), c010 + z * (c011 - c010)
            c10, c11 = c100 + z * (c101 - c100), c110 + z * (c111 - c110)
            c0, c1 = c00 + y * (c01 - c00), c10 + y * (c11 - c10)
            if k == 2:
                reliability[i] *= c0 + x * (c1 - c0)
                break
            # The derivative along z, at low and at high x.
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
    """Where points (m, camera frame) lie in the grid at a pose.

    Returns lever arms (3 x n, m); reliabilities (n), 1 or, out of the usable box, 0; cells (n), as
    numbers of their first vertices; positions in them (3 x n, from 0 to 1); and 1 / voxel (3 x n,
    1/m), by which derivatives along a cell are multiplied, or 0 outside of the grid.
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
            # Points outside of the grid, and NaN, are moved to its border; the gradient is 0 there.
            per_metre[k, i] = inverse if (scaled >= 0) & (scaled <= last) else 0.0
            scaled = min(scaled, last) if scaled > 0 else 0.0
            cell = min(int(scaled), grid.n_vertices[k] - 2)
            in_cell[k, i] = scaled - cell
            cells[i] = cells[i] * grid.n_vertices[k] + cell  # after all axes: z is fastest
    return lever_arms, reliability, cells, in_cell, per_metre


@no_type_check
@compiled
def _weigh(terms: Terms, normals: Array, T: Pose) -> None:
    """Complete the terms in place: weigh points by their gradient's norm and, if given, by normals;
    divide distances and their gradients by that norm.
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
