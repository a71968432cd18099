"""Least squares of what a grid's vertices shall be, by what its interpolation shall give at points.

Points touch few of a grid's vertices: only those near points are solved for, as the columns of a
sparse matrix.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import cg

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.observed import compiled
from nbtrack.core.arrays import WorldPoints

# What a difference between neighbouring corrections, and a correction itself, cost, in points seen
# from the mean distance.
_SMOOTHNESS = 0.1
_PULL = 0.1
_FADE = 1  # vertices beyond those that points touch, over which corrections fade out
Columns = Float[np.ndarray, "rows columns"]
Vertices = Int[np.ndarray, "points 8"]
Corners = Float[np.ndarray, "points 8"]
_CORNERS = np.stack(np.meshgrid(*3 * [[0, 1]], indexing="ij"), -1).reshape(8, 3)
# A vertex is coupled to the 27 around it, itself the middle one; and which of them, seen from one
# corner of a cell, is another corner.
_AROUND = np.stack(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij"), -1).reshape(27, 3)
_ITSELF = 13
_TO_CORNER = (_CORNERS[None] - _CORNERS[:, None] + 1) @ [9, 3, 1]


class Equations(NamedTuple):
    """Linear equations of corrections: eight of them, weighted, make up what is wanted."""

    columns: Vertices
    weights: Corners
    wanted: Columns
    reliability: np.ndarray


def interpolation(points_world: WorldPoints, grid: BakedField) -> tuple[Vertices, Corners]:
    """Numbers of the eight vertices around points (m), and their weights in the interpolation."""
    shape = np.array(grid.n_vertices)
    scaled = (points_world - grid.low.double().numpy()) / grid.voxel
    cells = np.clip(np.floor(scaled).astype(np.int64), 0, shape - 2)
    x, y, z = np.moveaxis(np.stack([1 - (scaled - cells), scaled - cells], axis=-1), 1, 0)
    weights = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return (cells @ strides)[:, None] + _CORNERS @ strides, weights.reshape(-1, 8)


def interpolated(columns: Vertices, weights: Corners, values: Columns) -> Columns:
    """Weighted means of the values of eight vertices."""
    return np.einsum("ij,ijc->ic", weights, values[columns])


def corrected_vertices(
    vertices: Vertices, shape: tuple[int, int, int]
) -> tuple[Int[np.ndarray, "_"], Vertices]:
    """The vertices to correct, which are those near points, and their numbers among these."""
    is_touched = np.zeros(shape, dtype=bool)
    is_touched.flat[vertices] = True
    numbers = np.flatnonzero(binary_dilation(is_touched, iterations=_FADE))
    column = np.empty(is_touched.size, dtype=np.int32)
    column[numbers] = np.arange(len(numbers), dtype=np.int32)
    return numbers, column[vertices]


def regularisation_of(
    numbers: Int[np.ndarray, "n"], shape: tuple[int, int, int]
) -> tuple[sparse.csr_array, Int[np.ndarray, "n 27"]]:
    """The regularisation of corrections as a matrix, with an entry for each two vertices of a cell.

    Besides: where these entries stand among its data, by vertex and neighbour (`_AROUND`).

    It is that of springs between neighbours and to zero; neighbours that are not corrected stand at
    zero, so that corrections fade out.
    """
    column = np.full([n + 2 for n in shape], -1)  # with a border that is never corrected
    column[1:-1, 1:-1, 1:-1].flat[numbers] = np.arange(len(numbers))
    places = np.stack(np.unravel_index(numbers, shape), axis=-1)[:, None] + 1 + _AROUND
    neighbours = column[tuple(np.moveaxis(places, -1, 0))]
    is_corrected = neighbours >= 0
    slots = np.where(is_corrected, is_corrected.cumsum().reshape(is_corrected.shape) - 1, -1)
    distances = np.abs(_AROUND).sum(axis=1)
    springs = np.where(distances == 1, -_SMOOTHNESS, 0.0)
    springs[_ITSELF] = _PULL + 6 * _SMOOTHNESS
    data = np.broadcast_to(springs, slots.shape)[is_corrected]
    rows = np.concatenate([[0], is_corrected.sum(axis=1).cumsum()])
    size = len(numbers), len(numbers)
    return sparse.csr_array((data, neighbours[is_corrected], rows), shape=size), slots


def solve(
    equations: Equations,
    regularisation: sparse.csr_array,
    slots: Int[np.ndarray, "n 27"],
    huber: float,
    rounds: int,
) -> tuple[Columns, np.ndarray]:
    """Minimise |W^(1/2) (A x - wanted)|^2 + x' regularisation x; and the diagonal of its matrix.

    W holds the reliability, times huber / |residual| where the largest residual of an equation's
    columns is above that; it is judged anew in every round.
    """
    solution = np.zeros((len(slots), equations.wanted.shape[1]))
    for _ in range(rounds):
        matrix = regularisation.copy()
        vectors = np.zeros_like(solution)
        add_equations(equations, huber, solution, slots, matrix.data, vectors)
        scaling = sparse.dia_array((1 / matrix.diagonal()[None], 0), shape=matrix.shape)
        for column, vector in enumerate(vectors.T):
            start = solution[:, column].copy()
            solution[:, column], _ = cg(matrix, vector, start, rtol=1e-3, M=scaling)
    return solution, matrix.diagonal()


@no_type_check
@compiled
def add_equations(equations, huber, solution, slots, matrix_data, vectors):
    """Add A' W A to the entries of a matrix, and A' W wanted to some vectors; see `solve`.

    The pattern of the matrix never changes: an equation adds 8 x 8 products to it, in place.
    """
    columns, weights, wanted, reliability = equations
    for equation in range(len(columns)):
        largest = huber
        for channel in range(wanted.shape[1]):
            residual = wanted[equation, channel]
            for corner in range(8):
                residual -= weights[equation, corner] * solution[columns[equation, corner], channel]
            largest = max(largest, abs(residual))
        weight = reliability[equation] * huber / largest
        for corner in range(8):
            row = columns[equation, corner]
            weighted = weight * weights[equation, corner]
            for other in range(8):
                slot = slots[row, _TO_CORNER[corner, other]]
                matrix_data[slot] += weighted * weights[equation, other]
            for channel in range(wanted.shape[1]):
                vectors[row, channel] += weighted * wanted[equation, channel]
