"""A map corrected at its surfaces: linear least squares on all measured depth, in closed form.

A network learns a distance everywhere, and is off by millimetres at surfaces. There the measured
points say it better, and say it linearly: trilinear interpolation in a grid is a weighted mean of
eight vertices. What the network says away from surfaces stays.
"""

import copy
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.linalg import cg
from torch import Tensor

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.views import spread_out, view_of
from nbtrack.core.arrays import Frames, WorldPoints
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.errors import DataError
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, field_class
from nbtrack.fields.base import LUMA, State

# All our choice, tried in the two rooms for tuning. Measured points, and where along their normals
# (m) the distance is that offset. Nearer than a voxel: farther out, planes end.
_N_POINTS, _OFFSETS = 300_000, (0.0, -0.03, -0.015, 0.015, 0.03)
# A larger place takes more, up to so many times, lest a frame see cells that none lies in: with so
# many a cell in the mean, as rooms have anyway (3 in an office of 15 by 17 m; see docs/tried.md).
_POINTS_A_CELL, _MAX_TIMES = 10, 4
# The residual (m) from which one counts less (Huber), and how often that is judged anew.
_HUBER, _ROUNDS = 0.01, 4
# What a difference between neighbouring corrections, and a correction itself, cost, in points seen
# from the mean distance. Corrections fade out over so many vertices beyond those that points touch.
_SMOOTHNESS, _PULL, _FADE = 0.1, 0.1, 1
# Of colours, which change faster than distances: their share of that stiffness, and as above.
_COLOR_STIFFNESS, _COLOR_HUBER, _COLOR_ROUNDS = 0.1, 0.05, 3
# The least scales of a tracker's residuals (distance, luma): so many medians of what the measured
# points leave, and no less. Chosen in the rooms for tuning and on a real recording, whose medians
# are 1.8 mm and 0.002, and 4 mm and 0.02.
_MEDIANS, _MIN_SCALES = np.array([5.5, 2.3]), np.array([0.01, 0.05])
_UNMEASURED = 0.1  # confidence where nothing was measured, and the network interpolates
CORRECTIONS = ("numbers", "corrections", "cameras", "views", "residual_medians")
"""What a file keeps of a correction, besides the field: see `CorrectedField`."""
_SOURCE = "source."  # how names of the field as mapped begin
Columns = Float[np.ndarray, "rows columns"]


class CorrectedField(BakedField):
    """A grid of a learned field with corrections at vertices near surfaces. Our choice.

    What a file keeps is the field itself and, by name: the `numbers` (n) of corrected vertices,
    their `corrections` (n x 5) of colour, distance (m) and confidence in half precision, some
    mapped poses `cameras` (n x 4 x 4) with the small `views` (n x 2 x 30 x 40) from them, by which
    a lost camera is found, and `residual_medians` (2), of distance (m) and luma, that the
    corrections leave at measured points: from them follow the least scales of a tracker's
    residuals.
    """

    form = "corrected"
    inlier_distance, min_inliers = 0.025, 0.8

    def __init__(self, source: Field, voxel: float, correction: dict[str, Tensor]) -> None:
        """Add to what a field gives at vertices; the correction's tensors are `CORRECTIONS`."""
        super().__init__(source, voxel)
        self.name, self.label, self.source = source.name, f"{source.label} corrected", source
        for name in CORRECTIONS:
            self.register_buffer(name, correction[name])
        medians = self.residual_medians.double().numpy()
        self.residual_sigma = tuple(np.maximum(_MEDIANS * medians, _MIN_SCALES).tolist())
        self.intensity_mad = float(medians[1])
        self.volume[4] = _UNMEASURED
        self.volume[:, self.numbers.long()] += self.corrections.float().T

    @property
    def T_world_cameras(self) -> Float[Tensor, "cameras 4 4"]:
        """Some of the poses that it was mapped from, spread by place and direction."""
        return self.cameras

    def state(self) -> State:
        """That of the field as mapped, and the corrections."""
        corrections = {name: getattr(self, name) for name in CORRECTIONS}
        return corrections | {f"{_SOURCE}{name}": x for name, x in self.source.state().items()}

    @classmethod
    def from_state(
        cls, state: State, made: dict[str, Any], bounds: SceneBounds
    ) -> "CorrectedField":
        """The field as mapped, sampled and corrected anew."""
        source = {n.removeprefix(_SOURCE): x for n, x in state.items() if n.startswith(_SOURCE)}
        mapped = field_class(made["field"]).from_state(source, made, bounds)
        correction = {name: state[name] for name in CORRECTIONS}
        return cls(mapped, float(made["settings"]["correct_voxel"]), correction)


def corrected(
    source: Field, sequence: RgbdSequence, frames: Frames, voxel: float
) -> CorrectedField:
    """A map with a signed distance, corrected in cells of `voxel` (m) by its mapped frames.

    At a measured point p with normal n the interpolated distance at p + s n shall be s, at five
    offsets s, and the colour at p that of the pixel: equations linear in the corrections of the
    vertices around, weighted by 1 / depth^2, solved by conjugate gradients together with a little
    stiffness (see `_unknowns`, `_solve`). Colours are asked for at the surface alone: off it a
    camera saw none. Raises DataError where no frame shows a plane.
    """
    source = copy.deepcopy(source).cpu()
    baked = BakedField(source, voxel)
    points, normals, depth, color = _enough_planes(sequence, frames, voxel)
    asked = np.concatenate([points + offset * normals for offset in _OFFSETS])
    numbers, design, stiffness = _unknowns(*interpolation(asked, baked), baked.n_vertices)
    values = baked.volume[:4].T.double().numpy()[numbers]
    reliability = (depth.mean() / depth) ** 2

    missing = np.repeat(_OFFSETS, len(points))[:, None] - design @ values[:, 3:]
    weights = np.tile(reliability, len(_OFFSETS))
    distance, diagonal = _solve(design, stiffness, missing, weights, _HUBER, _ROUNDS)
    # The share of measurements, not stiffness, in a vertex's diagonal.
    confidence = (1 - _UNMEASURED) * (1 - stiffness.diagonal() / diagonal)

    at_surface, missing = design[: len(points)], missing[: len(points), 0]
    missing_color, soft = color - at_surface @ values[:, :3], _COLOR_STIFFNESS * stiffness
    colors, _ = _solve(at_surface, soft, missing_color, reliability, _COLOR_HUBER, _COLOR_ROUNDS)

    left = missing - at_surface @ distance[:, 0], (missing_color - at_surface @ colors) @ LUMA
    corrections = torch.from_numpy(np.column_stack([colors, distance, confidence])).float().half()
    kept = frames[spread_out(sequence.T_world_camera[frames])]
    views = torch.stack([view_of(sequence[index]) for index in kept.tolist()])
    poses = torch.from_numpy(sequence.T_world_camera[kept]).float()
    medians = torch.from_numpy(np.median(np.abs(left), axis=1)).float()
    parts = torch.from_numpy(numbers).int(), corrections, poses, views, medians
    return CorrectedField(source, voxel, dict(zip(CORRECTIONS, parts, strict=True)))


def _enough_planes(sequence: RgbdSequence, frames: Frames, voxel: float) -> tuple[np.ndarray, ...]:
    """`_measured_planes`, as many as the cells (of `voxel`, m) that they lie in ask for."""
    planes = _measured_planes(sequence, frames, _N_POINTS)
    n_cells = len(np.unique(np.floor(planes[0] / voxel), axis=0))
    times = min(_POINTS_A_CELL * n_cells / len(planes[0]), _MAX_TIMES)
    return planes if times <= 1 else _measured_planes(sequence, frames, round(times * _N_POINTS))


def _measured_planes(
    sequence: RgbdSequence, frames: Frames, n_points: int
) -> tuple[np.ndarray, ...]:
    """Random measured points (n x 3, m) with normals, their z-depths (n, m) and colours (n x 3)."""
    sampler = PixelSampler(sequence, torch.device("cpu"))
    generator = torch.Generator().manual_seed(0)
    rays = sampler.draw(n_points, generator, torch.from_numpy(frames), tangent_planes=True)
    has_plane = rays.normals_world.any(dim=-1)
    if not has_plane.any():
        raise DataError(f"{sequence.name} shows no surface to correct a map by: check its depth")
    points = rays.points(rays.depth[:, None])[:, 0]
    parts = points, rays.normals_world, rays.depth, rays.color
    return tuple(part[has_plane].double().numpy() for part in parts)


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
        along = np.moveaxis(column, axis, 0)
        pairs = np.stack([along[:-1].ravel(), along[1:].ravel()])
        pairs = pairs[:, (pairs >= 0).all(axis=0)]
        spring = sparse.coo_array((np.ones(pairs.shape[1]), pairs), shape=2 * size[1:])
        stiffness = stiffness - _SMOOTHNESS * (spring + spring.T)
    return numbers, design, stiffness + 6 * _SMOOTHNESS * sparse.eye_array(len(numbers))


def _solve(
    design, stiffness, wanted: Columns, reliability: np.ndarray, huber: float, rounds: int
) -> tuple[Columns, np.ndarray]:
    """Minimise |W^(1/2) (design x - wanted)|^2 + x' stiffness x; and the system's diagonal.

    Of sparse matrices, and columns of `wanted` with an equation, and its reliability, a row. W
    holds the reliability, times huber / |residual| where the largest residual of an equation's
    columns is above that; it is judged anew in every round.
    """
    solution = np.zeros((design.shape[1], wanted.shape[1]))
    for _ in range(rounds):
        residual = np.abs(wanted - design @ solution).max(axis=1)
        weighted = (design * (reliability * huber / residual.clip(huber))[:, None]).tocsr()
        matrix, vectors = design.T @ weighted + stiffness, weighted.T @ wanted
        scaling = sparse.dia_array((1 / matrix.diagonal()[None], 0), shape=matrix.shape)
        for column, vector in enumerate(vectors.T):
            start = solution[:, column].copy()
            solution[:, column], _ = cg(matrix, vector, start, rtol=1e-3, M=scaling)
    return solution, matrix.diagonal()
