"""Least squares of what a grid's vertices shall be, by what its interpolation shall give at points.

Points touch few of a grid's vertices: only those near points are solved for, as the columns of a
sparse matrix.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array, dia_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg
from skimage.graph import pixel_graph

from nbtrack.beyond.grid import BakedField
from nbtrack.core.arrays import WorldPoints

# Weights of the squared difference between neighbouring corrections, and of a correction's square;
# the squared residual of a point that was seen from the mean depth has the weight 1.
_SMOOTHNESS = 0.1
_PULL = 0.1
Columns = Float[np.ndarray, "rows columns"]
Vertices = Int[np.ndarray, "points 8"]
Corners = Float[np.ndarray, "points 8"]
Mask = Bool[np.ndarray, "x y z"]
_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T  # of a cell, 8 x 3: z is fastest


def interpolation(points_world: WorldPoints, grid: BakedField) -> tuple[Vertices, Corners]:
    """Numbers of the eight vertices around points (m), and their weights in the interpolation.

    Points outside are moved to the border, as the grid itself does.
    """
    shape = np.array(grid.n_vertices)
    scaled = (points_world - grid.low.double().numpy()) / grid.voxel
    scaled = scaled.clip(0, shape - 1)
    cells = np.clip(np.floor(scaled).astype(np.int64), 0, shape - 2)
    # Of the two vertices along each axis: n x 3 x 2. A corner's weight is the product of three.
    along = np.stack([1 - (scaled - cells), scaled - cells], axis=-1)
    xy = along[:, 0, :, None, None] * along[:, 1, None, :, None]
    weights = xy * along[:, 2, None, None, :]
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return (cells @ strides)[:, None] + _CORNERS @ strides, weights.reshape(-1, 8)


def corrected_vertices(
    vertices: Vertices, weights: Corners, shape: tuple[int, ...]
) -> tuple[Mask, csr_array]:
    """Which of a grid's vertices to correct, those near points; and the interpolation from them.

    The latter is a matrix A (points x n): A x is at the points what x is at these vertices.
    """
    is_touched = np.zeros(shape, dtype=bool)
    is_touched.flat[vertices] = True
    is_corrected = binary_dilation(is_touched)  # by a vertex, over which corrections fade out
    column_of = is_corrected.cumsum() - 1
    # Every row has eight entries: weights, columns, and where rows begin.
    entries = (weights.ravel(), column_of[vertices].ravel(), np.arange(0, weights.size + 1, 8))
    return is_corrected, csr_array(entries, shape=(len(weights), column_of[-1] + 1))


def regularisation_of(is_corrected: Mask) -> tuple[Int[np.ndarray, "n"], csr_array]:
    """Numbers of the vertices to correct, and the regularisation of corrections as a matrix R.

    x' R x is its cost of corrections x. It has springs between the six neighbours, of
    `_SMOOTHNESS`, and to zero, of `_PULL`. Neighbours that are not corrected stand at zero, so that
    corrections fade out.
    """
    springs, numbers = pixel_graph(is_corrected, connectivity=1)  # 1 between neighbours
    own = eye_array(len(numbers)) * (_PULL + 6 * _SMOOTHNESS)
    return numbers, (own - _SMOOTHNESS * springs).tocsr()


def solve(
    matrix: csr_array,
    wanted: Columns,
    reliability: Float[np.ndarray, "rows"],
    regularisation: csr_array,
    huber: float,
    rounds: int,
) -> tuple[Columns, Float[np.ndarray, "n"]]:
    """The x that minimises |W^(1/2) (A x - wanted)|^2 + x' R x, and the Hessian's diagonal.

    A is the matrix, R the regularisation, W the reliability times Huber's weight. A row has one
    weight for all its columns, by their largest residual: 1 up to `huber`, else huber / |residual|.
    Each of the `rounds` solves by conjugate gradients, from the solution before and with its
    weights. The Hessian A'WA + R is applied to vectors, and never formed: its entries would take
    several times as long to sum up. Its diagonal is that of the last round.
    """
    solution = np.zeros((matrix.shape[1], wanted.shape[1]))
    squares = matrix.power(2)
    for _ in range(rounds):
        largest = np.abs(wanted - matrix @ solution).max(axis=1)
        weights = reliability * huber / np.maximum(largest, huber)

        def hessian_times(x, weights=weights):  # weights of this round
            return matrix.T @ (weights * (matrix @ x)) + regularisation @ x

        hessian = LinearOperator(regularisation.shape, matvec=hessian_times, dtype=float)
        diagonal = squares.T @ weights + regularisation.diagonal()
        preconditioner = dia_array((1 / diagonal[None], 0), shape=regularisation.shape)
        right_sides = matrix.T @ (weights[:, None] * wanted)
        for k in range(wanted.shape[1]):
            start = solution[:, k]
            solution[:, k], _ = cg(hessian, right_sides[:, k], start, rtol=1e-3, M=preconditioner)
    return solution, diagonal
