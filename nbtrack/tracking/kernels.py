"""Compiled sums over points in a grid: what `registration` computes, one point after the other.

Of every point a column of twelve numbers is kept: the residuals of distance (m) and intensity, how
reliable they are, the arm from the camera's centre (m, world axes), and both spatial gradients.
Loops are plain, which numba compiles soonest; no result depends on the number of threads.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from nbtrack.tracking.registration import LEAST_SLOPE, MOST_SLOPE, SLOPE_SCALE, START_PULL

# Sums may be reordered, so that they fill vector registers; what is no number stays none.
HOW = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "arcp", "nsz"}}
_ONE, _NONE = np.float32(1), np.float32(0)


@no_type_check
@njit(**HOW)
def _weigh(rows, normals, T):
    """Reliability by the slope and its angle to normals, and division by its length."""
    for i in range(rows.shape[1]):
        slope = np.sqrt(rows[6, i] ** 2 + rows[7, i] ** 2 + rows[8, i] ** 2)
        trust = _ONE / (_ONE + ((slope - _ONE) / np.float32(SLOPE_SCALE)) ** 2)
        rows[2, i] *= trust * trust if LEAST_SLOPE < slope < MOST_SLOPE else _NONE
        least = max(slope, np.float32(LEAST_SLOPE))
        if len(normals):
            along = 0.0
            for k in range(3):
                turned = T[k, 0] * normals[i, 0] + T[k, 1] * normals[i, 1] + T[k, 2] * normals[i, 2]
                along += rows[6 + k, i] * turned / least
            rows[2, i] *= max(along, 0.0) ** 2
        rows[0, i] /= least
        for k in range(6, 9):
            rows[k, i] /= least


@no_type_check
@njit(**HOW)
def _place(rows, points, T, shape, place):
    """Arms, and whether points are usable; their cells, where in them, and the slopes' unit."""
    inverse, numbers = 1 / place[3], np.zeros(len(points), np.int64)
    at, inside = np.empty((2, 3, len(points)), np.float32)
    rows[2] = _ONE
    for k in range(3):
        last = shape[k] - 1.0
        for i in range(len(points)):
            arm = T[k, 0] * points[i, 0] + T[k, 1] * points[i, 1] + T[k, 2] * points[i, 2]
            world = arm + T[k, 3]
            rows[3 + k, i] = arm
            rows[2, i] *= (place[4 + k] <= world) & (world <= place[7 + k])
            scaled = (world - place[k]) * inverse
            # Points outside are moved to the border, where they have no slope; so are NaNs.
            inside[k, i] = inverse if (scaled >= 0) & (scaled <= last) else 0.0
            scaled = min(scaled, last) if scaled > 0 else 0.0
            cell = min(int(scaled), shape[k] - 2)
            at[k, i], numbers[i] = scaled - cell, numbers[i] * shape[k] + cell
    return numbers, at, inside


@no_type_check
@njit(**HOW)
def residual_rows(observed, T, grid, near):
    """A column of every point at a pose; `registration.residuals_at` in a grid.

    A grid is its vertices (value, intensity, confidence), their numbers along x, y and z, and its
    place: the first vertex, the voxel, and both corners of the box whose points are usable.
    """
    (points, intensity, normals), (vertices, shape, place) = observed, grid
    rows = np.empty((12, len(points)), np.float32)
    numbers, at, inside = _place(rows, points, T, shape, place)
    step_x, step_y, one = np.uintp(shape[1] * shape[2]), np.uintp(shape[2]), np.uintp(1)
    for i in range(len(points)):
        v, x, y, z = np.uintp(numbers[i]), at[0, i], at[1, i], at[2, i]
        for k in range(3 if near else 2):
            a, b = vertices[v, k], vertices[v + one, k]
            c, d = vertices[v + step_y, k], vertices[v + step_y + one, k]
            e, f = vertices[v + step_x, k], vertices[v + step_x + one, k]
            g, h = vertices[v + step_x + step_y, k], vertices[v + step_x + step_y + one, k]
            ab, cd, ef, gh = a + z * (b - a), c + z * (d - c), e + z * (f - e), g + z * (h - g)
            low, high = ab + y * (cd - ab), ef + y * (gh - ef)
            if k == 2:
                rows[2, i] *= low + x * (high - low)
                break
            low_z, high_z = b - a + y * (d - c - b + a), f - e + y * (h - g - f + e)
            rows[k, i] = low + x * (high - low)
            rows[6 + 3 * k, i] = (high - low) * inside[0, i]
            rows[7 + 3 * k, i] = (cd - ab + x * (gh - ef - cd + ab)) * inside[1, i]
            rows[8 + 3 * k, i] = (low_z + x * (high_z - low_z)) * inside[2, i]
        rows[1, i] -= intensity[i]
    _weigh(rows, normals, T)
    return rows


@no_type_check
def scales_of(rows, before, least, medians):
    """`registration.scales_of`; numpy's own, whose compilation would take seconds."""
    if (before <= least).all():  # as in most steps: a median takes as long as many sums
        return before
    middle = (rows.shape[1] - 1) // 2
    median = np.partition(np.abs(rows[:2]), middle, axis=1)[:, middle]
    return np.minimum(np.maximum(medians * median, least), before)


@no_type_check
@njit(**HOW)
def robust_cost(rows, scales, weight):
    """`registration.robust_cost`."""
    total, weight = 0.0, np.float32(weight)
    first, second = np.float32(1 / scales[0]), np.float32(1 / scales[1])
    for i in range(rows.shape[1]):
        u, v = (rows[0, i] * first) ** 2, (rows[1, i] * second) ** 2
        cost = u / (_ONE + u) + weight * v / (_ONE + v)
        total += rows[2, i] * cost + (_ONE - rows[2, i]) * (_ONE + weight)
    return total / rows.shape[1]


@no_type_check
@njit(**HOW)
def normal_equations(rows, scales, weight):
    """`registration.normal_equations`."""
    n_points = rows.shape[1]
    jacobian, trust = np.empty((6, n_points), np.float32), np.empty(n_points, np.float32)
    matrix, vector = np.zeros((6, 6)), np.zeros(6)
    for k in range(2):
        scale, share = np.float32(scales[k]), np.float32(weight if k else 1.0)
        for i in range(n_points):
            gx, gy, gz = rows[6 + 3 * k, i], rows[7 + 3 * k, i], rows[8 + 3 * k, i]
            ax, ay, az = rows[3, i], rows[4, i], rows[5, i]
            jacobian[0, i], jacobian[1, i] = ay * gz - az * gy, az * gx - ax * gz
            jacobian[2, i], jacobian[3, i] = ax * gy - ay * gx, gx
            jacobian[4, i], jacobian[5, i] = gy, gz
            flat = (_ONE + (rows[k, i] / scale) ** 2) * scale
            trust[i] = share * rows[2, i] / (flat * flat)
        for a in range(6):
            for i in range(n_points):
                vector[a] += trust[i] * jacobian[a, i] * rows[k, i]
            for b in range(a + 1):
                total = 0.0
                for i in range(n_points):
                    total += trust[i] * jacobian[a, i] * jacobian[b, i]
                matrix[a, b] += total
                matrix[b, a] = matrix[a, b]
    return matrix, vector


@no_type_check
@njit(**HOW)
def moved(T, twist):
    """`registration.moved`, by Rodrigues' formula."""
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
@njit(**HOW)
def damped_step(rows, scales, weight, T_start, T, damping):
    """`registration.damped_step`."""
    matrix, vector = normal_equations(rows, scales, weight)
    for k in range(3):
        i, j = (k + 2) % 3, (k + 1) % 3
        turned = 0.0
        for m in range(3):
            turned += T[i, m] * T_start[j, m] - T[j, m] * T_start[i, m]
        vector[k] += START_PULL * turned / 2
        vector[3 + k] += START_PULL * (T[k, 3] - T_start[k, 3])
    for k in range(6):
        matrix[k, k] += START_PULL + damping * matrix[k, k]
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
@njit(**HOW)
def try_step(observed, grid, near, weight, T_start, T, rows, scales, damping):
    """A step: whether it is better, pose and rows after it, cost before, and its length."""
    twist = damped_step(rows, scales, weight, T_start, T, damping)
    T_after = moved(T, twist)
    rows_after = residual_rows(observed, T_after, grid, near)
    judged = rows_after[:3].copy()
    if weight > 0:  # by the reliabilities before; see `Search.step`
        judged[2] = np.where(judged[2] > 0, rows[2], _NONE)
    before, after = robust_cost(rows, scales, weight), robust_cost(judged, scales, weight)
    longest = np.abs(twist).max()
    if after < before:
        return True, T_after, rows_after, before, longest
    return False, T, rows, before, longest
