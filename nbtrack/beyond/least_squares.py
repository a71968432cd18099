"""Linear least squares for the values of a grid's vertices, given the wanted values at points.

A value at a point is a weighted mean of the eight vertices of its cell. The unknowns are
corrections of the vertices near points, which are few of a grid's. They are the columns of a sparse
matrix, and the points are its rows.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array, dia_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg
from skimage.graph import pixel_graph

from nbtrack.beyond.grid import BakedField
from nbtrack.core.arrays import WorldPoints

# Weights in the loss, in which the squared residual of a point at the mean depth has the weight 1.
_SMOOTHNESS = 0.1  # of the squared difference between neighbouring corrections
_PULL = 0.1  # of a squared correction: it is pulled to zero
Columns = Float[np.ndarray, "rows columns"]
Vertices = Int[np.ndarray, "points 8"]
Weights = Float[np.ndarray, "points 8"]
Mask = Bool[np.ndarray, "x y z"]
_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T  # offsets of a cell's corners, 8 x 3; z is fastest


def interpolation(points_world: WorldPoints, grid: BakedField) -> tuple[Vertices, Weights]:
    """The eight vertices of each point's cell, and the vertices' weights in its interpolation.

    Points are in m. Vertices are given by their row-major numbers, the lowest corner first. Points
    outside of the grid are moved to its border, as the grid itself does.
    """
    shape = np.array(grid.n_vertices)
    scaled = (points_world - grid.low.double().numpy()) / grid.voxel
    scaled = scaled.clip(0, shape - 1)
    cells = np.clip(np.floor(scaled).astype(np.int64), 0, shape - 2)
    # The weights of the lower and the upper vertex along each axis, n x 3 x 2. A corner's weight is
    # the product of one weight of each axis.
    along = np.stack([1 - (scaled - cells), scaled - cells], axis=-1)
    xy = along[:, 0, :, None, None] * along[:, 1, None, :, None]
    weights = xy * along[:, 2, None, None, :]
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return (cells @ strides)[:, None] + _CORNERS @ strides, weights.reshape(-1, 8)


def corrected_vertices(
    vertices: Vertices, weights: Weights, shape: tuple[int, ...]
) -> tuple[Mask, csr_array]:
    """A mask of the grid's vertices to correct, and the interpolation matrix A from them to points.

    `vertices` and `weights` are those of `interpolation`, and `shape` is the grid's. The vertices
    of cells with points are corrected, and so are their neighbours. If x holds a value for each of
    these n vertices, A x (A is points x n) holds the interpolated values at the points.
    """
    has_points = np.zeros(shape, dtype=bool)
    has_points.flat[vertices] = True
    is_corrected = binary_dilation(has_points)  # by one vertex, over which corrections fade out
    column_of = is_corrected.cumsum() - 1  # the column of A, by the number of a corrected vertex
    # The sparse matrix: its entries, their columns, and where its rows of eight entries begin.
    entries = (weights.ravel(), column_of[vertices].ravel(), np.arange(0, weights.size + 1, 8))
    return is_corrected, csr_array(entries, shape=(len(weights), column_of[-1] + 1))


def regularisation_of(is_corrected: Mask) -> tuple[Int[np.ndarray, "n"], csr_array]:
    """Row-major numbers of the n vertices to correct, and a matrix R (n x n) that regularises them.

    x' R x is the regularisation loss of corrections x: `_PULL` times the sum of their squares, plus
    `_SMOOTHNESS` times the sum of the squared differences between neighbours. A vertex has six
    neighbours. The correction of a neighbour that is not corrected is 0, so that corrections fade
    out.
    """
    adjacency, numbers = pixel_graph(is_corrected, connectivity=1)  # 1 between neighbours
    diagonal = eye_array(len(numbers)) * (_PULL + 6 * _SMOOTHNESS)
    return numbers, (diagonal - _SMOOTHNESS * adjacency).tocsr()


def solve(
    matrix: csr_array,
    wanted: Columns,
    reliability: Float[np.ndarray, "rows"],
    regularisation: csr_array,
    huber: float,
    rounds: int,
) -> tuple[Columns, Float[np.ndarray, "n"]]:
    """The x that minimises |W^(1/2) (A x - wanted)|^2 + x' R x, and the Hessian's diagonal.

    A is `matrix`, R `regularisation`, and W the diagonal matrix of reliability times Huber's
    weight. A row has the same weight for all its columns. It comes from the largest of their
    absolute residuals: 1 up to `huber`, and huber / |residual| above.

    Iteratively reweighted least squares: each of the `rounds` computes the weights at the solution
    so far, and solves by conjugate gradients from there. The Hessian A'WA + R is applied to
    vectors, and never formed: to sum up its entries would take longer. Its diagonal is returned for
    the weights of the last round.
    """
    solution = np.zeros((matrix.shape[1], wanted.shape[1]))
    squares = matrix.power(2)
    for _ in range(rounds):
        largest = np.abs(wanted - matrix @ solution).max(axis=1)
        weights = reliability * huber / np.maximum(largest, huber)

        def hessian_times(x, weights=weights):  # keeps the weights of this round
            return matrix.T @ (weights * (matrix @ x)) + regularisation @ x

        hessian = LinearOperator(regularisation.shape, matvec=hessian_times, dtype=float)
        diagonal = squares.T @ weights + regularisation.diagonal()
        preconditioner = dia_array((1 / diagonal[None], 0), shape=regularisation.shape)
        right_sides = matrix.T @ (weights[:, None] * wanted)
        for k in range(wanted.shape[1]):
            start = solution[:, k]
            solution[:, k], _ = cg(hessian, right_sides[:, k], start, rtol=1e-3, M=preconditioner)
    return solution, diagonal
