"""Least squares of what a grid's vertices shall be, by what its interpolation shall give at points.

Points touch few of a grid's vertices: only those near points are solved for, as the columns of a
sparse matrix.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import LinearOperator, cg

from nbtrack.beyond.grid import BakedField
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


def interpolation(points_world: WorldPoints, grid: BakedField) -> tuple[Vertices, Corners]:
    """Numbers of the eight vertices around points (m), and their weights in the interpolation."""
    shape = np.array(grid.n_vertices)
    scaled = (points_world - grid.low.double().numpy()) / grid.voxel
    cells = np.clip(np.floor(scaled).astype(np.int64), 0, shape - 2)
    x, y, z = np.moveaxis(np.stack([1 - (scaled - cells), scaled - cells], axis=-1), 1, 0)
    weights = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return (cells @ strides)[:, None] + _CORNERS @ strides, weights.reshape(-1, 8)


def corrected_vertices(
    vertices: Vertices, weights: Corners, shape: tuple[int, int, int]
) -> tuple[Int[np.ndarray, "n"], sparse.csr_array]:
    """The vertices to correct, which are those near points, and the interpolation between them.

    The latter is a matrix: a row a point, a column for each of these vertices.
    """
    is_touched = np.zeros(shape, dtype=bool)
    is_touched.flat[vertices] = True
    numbers = np.flatnonzero(binary_dilation(is_touched, iterations=_FADE))
    column = np.empty(is_touched.size, dtype=np.int32)
    column[numbers] = np.arange(len(numbers), dtype=np.int32)
    entries = weights.ravel(), column[vertices].ravel(), np.arange(0, weights.size + 1, 8)
    return numbers, sparse.csr_array(entries, shape=(len(weights), len(numbers)))


def regularisation_of(
    numbers: Int[np.ndarray, "n"], shape: tuple[int, int, int]
) -> sparse.csr_array:
    """The regularisation of corrections as a matrix: springs between neighbours, and to zero.

    Neighbours that are not corrected stand at zero, so that corrections fade out.
    """
    column = np.full(shape, -1)
    column.flat[numbers] = np.arange(len(numbers))
    springs = sparse.csr_array((len(numbers), len(numbers)))
    for axis in range(3):
        pairs = np.stack([np.delete(column, -1, axis), np.delete(column, 0, axis)]).reshape(2, -1)
        pairs = pairs[:, (pairs >= 0).all(axis=0)]
        ones = np.ones(pairs.shape[1])
        springs += sparse.coo_array((ones, tuple(pairs)), shape=springs.shape)
    own = sparse.eye_array(len(numbers)) * (_PULL + 6 * _SMOOTHNESS)
    return (own - _SMOOTHNESS * (springs + springs.T)).tocsr()


def solve(
    matrix: sparse.csr_array,
    wanted: Columns,
    reliability: Float[np.ndarray, "rows"],
    regularisation: sparse.csr_array,
    huber: float,
    rounds: int,
) -> tuple[Columns, Float[np.ndarray, "n"]]:
    """Minimise |W^(1/2) (A x - wanted)|^2 + x' regularisation x; and the diagonal of its Hessian.

    W holds the reliability, times huber / |residual| where the largest residual of a row's columns
    is above that; it is judged anew in every round. A'WA is applied, and never formed: its entries
    would take several times as long to sum up.
    """
    solution = np.zeros((matrix.shape[1], wanted.shape[1]))
    squares = matrix.power(2)
    for _ in range(rounds):
        largest = np.abs(wanted - matrix @ solution).max(axis=1)
        weights = reliability * huber / np.maximum(largest, huber)

        def curvature(x, weights=weights):
            return matrix.T @ (weights * (matrix @ x)) + regularisation @ x

        hessian = LinearOperator(regularisation.shape, matvec=curvature, dtype=float)
        diagonal = squares.T @ weights + regularisation.diagonal()
        scaling = sparse.dia_array((1 / diagonal[None], 0), shape=regularisation.shape)
        for column, vector in enumerate((matrix.T @ (weights[:, None] * wanted)).T):
            start = solution[:, column].copy()
            solution[:, column], _ = cg(hessian, vector, start, rtol=1e-3, M=scaling)
    return solution, diagonal
