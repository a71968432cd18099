"""A map corrected at its surfaces: linear least squares on all measured depth, in closed form.

A network learns a distance everywhere, and is off by millimetres at surfaces. There the measured
points say it better, and say it linearly: trilinear interpolation in a grid is a weighted mean of
eight vertices. What the network says away from surfaces stays.
"""

import copy

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import cg
from torch import Tensor

from nbtrack.core.arrays import Frames, WorldPoints
from nbtrack.core.errors import DataError
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Field
from nbtrack.fields.grid import BakedField

# All our choice, tried in the two rooms for tuning. Measured points, and where along their normals
# (m) the distance is that offset. Nearer than a voxel: farther out, planes end.
_N_POINTS, _OFFSETS = 300_000, (-0.03, -0.015, 0.0, 0.015, 0.03)
# The residual (m) from which one counts less (Huber), and how often that is judged anew.
_HUBER, _ROUNDS = 0.01, 4
# What a difference between neighbouring corrections, and a correction itself, cost, in points seen
# from the mean distance. Corrections fade out over so many vertices beyond those that points touch.
_SMOOTHNESS, _PULL, _FADE = 0.1, 0.1, 1
_GUESS = 0.1  # confidence where nothing was measured: the word of the network is a guess
_MOST_CAMERAS = 200  # poses kept, evenly spread: where a lost camera may be looked for
CORRECTIONS = ("numbers", "corrections", "T_world_cameras")
"""What a file keeps of a correction: arguments of `CorrectedField`, in their order."""


class CorrectedField(BakedField):
    """A grid of a learned field with corrections at vertices near surfaces. Our choice.

    What a file keeps is the field itself, the corrections in half precision, and mapped poses.
    """

    # Distances are better than the field's, intensities of small things are not: a voxel is wide.
    accuracy, least_inliers = (0.01, 0.1), 0.8

    def __init__(
        self,
        source: Field,
        voxel: float,
        numbers: Int[Tensor, "corrected"],
        corrections: Float[Tensor, "corrected 5"],
        T_world_cameras: Float[Tensor, "cameras 4 4"],
    ) -> None:
        """Add to colour, distance (m) and confidence at the numbered vertices of a baked field."""
        super().__init__(source, voxel)
        self.name, self.label, self.source = source.name, f"{source.label} corrected", source
        self.register_buffer("numbers", numbers)
        self.register_buffer("corrections", corrections.half())
        self.register_buffer("T_world_cameras", T_world_cameras)
        self.volume[4] = _GUESS
        self.volume[:, numbers.long()] += self.corrections.float().T


def corrected(
    source: Field, sequence: RgbdSequence, frames: Frames, voxel: float, seed: int = 0
) -> CorrectedField:
    """A map with a signed distance, corrected in cells of `voxel` (m) by its mapped frames.

    At a measured point p with normal n the interpolated distance at p + s n shall be s, and the
    colour that of the pixel: equations linear in the corrections of the vertices around, weighted
    by 1 / depth^2, solved by conjugate gradients together with a little smoothness. Raises
    DataError where no frame shows a plane.
    """
    source = copy.deepcopy(source).cpu()
    baked = BakedField(source, voxel)
    sampler = PixelSampler(sequence, torch.device("cpu"))
    generator = torch.Generator().manual_seed(seed)
    rays = sampler.draw(_N_POINTS, generator, torch.from_numpy(frames), tangent_planes=True)
    has_plane = rays.normals_world.any(dim=-1)
    if not has_plane.any():
        raise DataError(f"{sequence.name} shows no surface to correct a map by: check its depth")
    depth, normals, points, color = (
        part[has_plane].double().numpy()
        for part in (
            rays.depth,
            rays.normals_world,
            rays.points(rays.depth[:, None])[:, 0],
            rays.color,
        )
    )
    offsets = np.repeat(_OFFSETS, len(points))
    asked = np.concatenate([points + offset * normals for offset in _OFFSETS])
    vertices, weights = interpolation(asked, baked)
    numbers, design, stiffness = _unknowns(vertices, weights, baked.n_vertices)
    values = baked.volume[:4].T.double().numpy()[numbers]
    wanted = np.column_stack([np.tile(color, (len(_OFFSETS), 1)), offsets]) - design @ values
    reliability = np.tile((depth.mean() / depth) ** 2, len(_OFFSETS))
    corrections = _solve(design, stiffness, wanted, reliability)
    spread = np.linspace(0, len(frames) - 1, min(_MOST_CAMERAS, len(frames))).round().astype(int)
    poses = torch.from_numpy(sequence.T_world_camera[frames[spread]]).float()
    numbers, corrections = torch.from_numpy(numbers).int(), torch.from_numpy(corrections).float()
    return CorrectedField(source, voxel, numbers, corrections, poses)


def interpolation(
    points_world: WorldPoints, grid: BakedField
) -> tuple[Int[np.ndarray, "_ 8"], Float[np.ndarray, "_ 8"]]:
    """Numbers of the eight vertices around points (m), and their weights in the interpolation."""
    shape = np.array(grid.n_vertices)
    scaled = (points_world - grid.low.double().numpy()) / grid.voxel
    cells = np.clip(np.floor(scaled).astype(np.int64), 0, shape - 2)
    corners = np.stack(np.meshgrid(*3 * [[0, 1]], indexing="ij"), -1).reshape(8, 3)
    fraction = (scaled - cells)[:, None]
    weights = np.where(corners, fraction, 1 - fraction).prod(axis=-1)
    around = (cells[:, None] + corners).reshape(-1, 3)
    return np.ravel_multi_index(tuple(around.T), tuple(shape)).reshape(-1, 8), weights


def _unknowns(
    vertices, weights, shape
) -> tuple[Int[np.ndarray, "_"], sparse.csr_array, sparse.csr_array]:
    """The vertices to correct, the interpolation as a matrix over them, and their stiffness.

    The stiffness is that of springs between neighbours and to zero; neighbours that are not
    corrected stand at zero, so that corrections fade out.
    """
    is_touched = np.zeros(shape, dtype=bool)
    is_touched.flat[vertices] = True
    is_free = binary_dilation(is_touched, iterations=_FADE)
    numbers, column = np.flatnonzero(is_free), np.full(shape, -1)
    column.flat[numbers] = np.arange(len(numbers))
    rows = np.arange(0, vertices.size + 1, 8)
    size = (len(vertices), len(numbers))
    design = sparse.csr_array((weights.ravel(), column.flat[vertices].ravel(), rows), shape=size)
    stiffness = _PULL * sparse.eye_array(len(numbers), format="csr")
    for axis in range(3):
        pair = (np.moveaxis(column, axis, 0)[part].ravel() for part in (slice(-1), slice(1, None)))
        low, high = pair
        low, high = low[(low >= 0) & (high >= 0)], high[(low >= 0) & (high >= 0)]
        spring = sparse.coo_array((np.ones(len(low)), (low, high)), shape=2 * size[1:])
        stiffness = stiffness - _SMOOTHNESS * (spring + spring.T)
    return numbers, design, stiffness + 6 * _SMOOTHNESS * sparse.eye_array(len(numbers))


def _solve(design, stiffness, wanted, reliability) -> Float[np.ndarray, "_ 5"]:
    """Corrections of colour and distance by least squares, where outliers lose their say.

    And of confidence, by the share of measurements, not stiffness, in a vertex's diagonal.
    """
    found = np.zeros((design.shape[1], wanted.shape[1]))
    for round_ in range(_ROUNDS):
        residual = np.abs(wanted[:, 3] - design @ found[:, 3])
        weighted = (design * (reliability * _HUBER / residual.clip(_HUBER))[:, None]).tocsr()
        matrix, vectors = design.T @ weighted + stiffness, weighted.T @ wanted
        scaling = sparse.dia_array((1 / matrix.diagonal()[None], 0), shape=matrix.shape)
        for column in range(4) if round_ == _ROUNDS - 1 else [3]:  # weights are those of distances
            start = found[:, column].copy()
            found[:, column], _ = cg(matrix, vectors[:, column], start, rtol=1e-3, M=scaling)
    share = 1 - stiffness.diagonal() / matrix.diagonal()
    return np.column_stack([found, (1 - _GUESS) * share])
