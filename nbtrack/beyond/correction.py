"""Correction of a map at its surfaces, by linear least squares on measured depth.

A network learns a distance everywhere, and is off by millimetres at surfaces. Measured points give
a more accurate distance there. Their equations are linear if the map is a grid, since trilinear
interpolation is a weighted mean of eight vertices. Away from surfaces the map stays as it was.
"""

import copy
import time
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch

from nbtrack.beyond.grid import Accuracy, BakedField
from nbtrack.beyond.least_squares import corrected_vertices, interpolation, regularisation_of, solve
from nbtrack.beyond.observed import LUMA
from nbtrack.beyond.views import Viewpoints, spread_out, view_of
from nbtrack.core.arrays import Frames
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, field_class
from nbtrack.fields.base import State
from nbtrack.machinery.device import usual_modes
from nbtrack.machinery.errors import ConfigError, DataError
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import split_holdout, usual_misfit

# All our choice, tried in the two rooms for tuning.
_N_POINTS = 300_000  # random pixels that are drawn; those that show a plane are used
# Offsets (m) from a measured point along its normal, and so the signed distances that the map shall
# have there. The surface must come first: `corrected` relies on it. The others lie within a voxel,
# since surfaces are flat only nearby.
_OFFSETS = (0.0, -0.03, -0.015, 0.015, 0.03)
# More pixels are drawn in large scenes, until cells with points have so many on average, but at
# most `_MAX_TIMES` as many. Without more pixels three rooms have 11 to 14 points a cell, and an
# office of 10 by 11 m has 2.8 (docs/tried.md).
_POINTS_A_CELL = 10
_MAX_TIMES = 4
# The smallest robust scales of a tracker's residuals (distance in m, luma) are so many times the
# median residual that the corrected map leaves at measured points, and at least `_MIN_SCALES`.
# Chosen in the rooms for tuning, whose medians are 1.8 mm and 0.002, and on a real recording, whose
# medians are 4 mm and 0.02.
_SCALES_PER_MEDIAN = np.array([5.5, 2.3])
_MIN_SCALES = np.array([0.01, 0.05])
_UNMEASURED = 0.1  # confidence at vertices where nothing was measured, and the network interpolates
CORRECTIONS = ("numbers", "corrections", "cameras", "views", "residual_medians")
"""Names of a correction's tensors in a map file; `CorrectedField` explains them."""
_SOURCE = "source."  # prefix of the uncorrected field's tensors in `state_dict`


class CorrectedField(BakedField):
    """A grid of a learned field with corrections at vertices near surfaces. Our choice.

    A map file has the tensors of the learned field, and of the correction:

    - `numbers` (n): row-major numbers of the corrected vertices;
    - `corrections` (n x 5): what is added to their colour, distance (m) and confidence, in half
      precision;
    - `cameras` (m x 4 x 4) and `views` (m x 2 x 15 x 20): some mapped poses and the small views
      from them, by which a lost camera is found;
    - `residual_medians` (2): the median absolute residuals of distance (m) and luma that the
      corrected grid leaves at measured points. A tracker's robust scales follow from them.
    """

    form = "corrected"

    def __init__(self, source: Field, voxel: float) -> None:
        """Sample the field `source` in cells of `voxel` (m). `add` then corrects the grid."""
        super().__init__(source, voxel)
        self.name = source.name
        self.label = f"{source.label} corrected"
        self.source = source

    def add(self, correction: State) -> None:
        """Apply a correction, whose tensors have the names in `CORRECTIONS`, to the vertices."""
        for name in CORRECTIONS:
            self.register_buffer(name, correction[name])
        medians = self.residual_medians.double().numpy()  # of distance (m) and luma
        scales = np.maximum(_SCALES_PER_MEDIAN * medians, _MIN_SCALES)
        # A point is an inlier within 2.5 cm of the surface.
        self.accuracy = Accuracy(tuple(scales.tolist()), 0.025, float(medians[1]))
        self.viewpoints = Viewpoints(self.cameras.double().numpy(), self.views)
        # Channel 4 is the confidence, to which corrections add what was measured.
        self.volume[4] = _UNMEASURED
        self.volume[:, self.numbers.long()] += self.corrections.float().T

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> Self:
        """The corrected field of a map file: its learned field is sampled and corrected anew.

        `made`, the record of the map, has the voxel (m) as "correction": `correct_map` wrote it.
        """
        # The tensors of the learned field, by the names that they have in this field.
        source = {n.removeprefix(_SOURCE): x for n, x in state.items() if n.startswith(_SOURCE)}
        mapped = field_class(made["field"]).from_state(source, made, bounds)
        field = cls(mapped, voxel=float(made["correction"]))
        field.add(state)
        return field


@usual_modes()
def correct_map(finished: Map, sequence: RgbdSequence, voxel: float) -> Map:
    """Correct a map in cells of `voxel` (m) by its mapped frames, as `corrected` does.

    `sequence` must be the one that was mapped. The record of the new map has the seconds that the
    correction took, which its `seconds` include, and the misfit of the corrected map. Raises what
    `corrected` raises.
    """
    start = time.perf_counter()
    mapped, _ = split_holdout(len(sequence), finished.record["settings"]["holdout_every"])
    field = corrected(finished.field, sequence, mapped, voxel)
    seconds = time.perf_counter() - start
    record = {**finished.record, "correction": voxel, "correction_seconds": seconds}
    record["seconds"] += seconds
    record["misfit_m"] = usual_misfit(field, sequence, mapped)
    return replace(finished, field=field, record=record)


@usual_modes()
def corrected(field: Field, sequence: RgbdSequence, frames: Frames, voxel: float) -> CorrectedField:
    """Sample a signed distance field in cells of `voxel` (m), and correct it by its mapped frames.

    At a measured point p with normal n, the interpolated distance at p + s n shall be s for five
    offsets s. The colour at p shall be that of the pixel; off the surface no camera saw a colour.
    These equations have the weight 1 / depth^2, and are linear in the corrections of vertices.
    `solve` finds these. Raises DataError if no frame shows a plane, and ConfigError for a density.
    """
    if not field.is_distance:
        raise ConfigError(f"{field.label} is no signed distance: only such a map can be corrected")
    grid = CorrectedField(copy.deepcopy(field).cpu(), voxel)
    points_world, normals_world, depth, seen_color = _measured_planes(sequence, frames, grid)
    n_points = len(points_world)
    offset_world = np.concatenate([points_world + s * normals_world for s in _OFFSETS])
    vertices, weights = interpolation(offset_world, grid)
    is_corrected, matrix = corrected_vertices(vertices, weights, grid.n_vertices)
    numbers, regularisation = regularisation_of(is_corrected)
    uncorrected = grid.volume[:4].T.double().numpy()[numbers]
    color_before, distance_before = uncorrected[:, :3], uncorrected[:, 3:]
    reliability = (depth.mean() / depth) ** 2
    wanted = np.repeat(_OFFSETS, n_points)[:, None] - matrix @ distance_before  # corrections, m
    reliabilities = np.tile(reliability, len(_OFFSETS))
    # Residuals above 0.01 m are down-weighted; and those of colours, in [0, 1], above 0.05.
    distance, diagonal = solve(matrix, wanted, reliabilities, regularisation, 0.01, rounds=4)
    # The share of the Hessian's diagonal that comes from measurements, not from regularisation.
    confidence = (1 - _UNMEASURED) * (1 - regularisation.diagonal() / diagonal)

    at_surface = matrix[:n_points]  # the rows of the first offset, which is 0
    wanted_color = seen_color - at_surface @ color_before
    # A tenth of the regularisation, since colours change faster from vertex to vertex.
    color, _ = solve(at_surface, wanted_color, reliability, 0.1 * regularisation, 0.05, rounds=3)

    distance_residuals = wanted[:n_points] - at_surface @ distance
    luma_residuals = (wanted_color - at_surface @ color) @ LUMA
    medians = [float(np.median(np.abs(each))) for each in (distance_residuals, luma_residuals)]
    corrections = torch.from_numpy(np.column_stack([color, distance, confidence])).float().half()
    correction = {"numbers": torch.from_numpy(numbers).int(), "corrections": corrections}
    correction["residual_medians"] = torch.tensor(medians, dtype=torch.float32)
    grid.add(correction | _views(sequence, frames))
    return grid


def _views(sequence: RgbdSequence, frames: Frames) -> State:
    """The tensors `cameras` and `views` that `CorrectedField` explains, from mapped frames."""
    kept = frames[spread_out(sequence.T_world_camera[frames])]
    views = torch.stack([view_of(sequence[index]) for index in kept.tolist()])
    return {"cameras": torch.from_numpy(sequence.T_world_camera[kept]).float(), "views": views}


def _measured_planes(
    sequence: RgbdSequence, frames: Frames, grid: BakedField
) -> tuple[np.ndarray, ...]:
    """Random measured points whose tangent plane is known, ordered by the grid's cells.

    Returns points (n x 3, m, world), their planes' normals (n x 3), z-depths (n, m) and colours
    (n x 3, in [0, 1]). By their order, vertices that neighbours share stay in the processor's
    cache.

    The points come from `_N_POINTS` random pixels. If cells with points have fewer than
    `_POINTS_A_CELL` on average, as in a large scene, all are drawn anew from more pixels, at most
    `_MAX_TIMES` as many.
    """
    planes, cells = _drawn_planes(sequence, frames, grid, _N_POINTS)
    times = min(_POINTS_A_CELL * len(np.unique(cells)) / len(cells), _MAX_TIMES)
    if times > 1:
        planes, cells = _drawn_planes(sequence, frames, grid, round(times * _N_POINTS))
    order = np.argsort(cells, kind="stable")
    return tuple(part[order] for part in planes)


def _drawn_planes(
    sequence: RgbdSequence, frames: Frames, grid: BakedField, n_pixels: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """The four arrays of `_measured_planes` from `n_pixels` random pixels, and the points' cells.

    Pixels without a known tangent plane, and points outside of the grid, are left out. Raises
    DataError if none is left.
    """
    sampler, generator = PixelSampler(sequence, torch.device("cpu")), torch.Generator()
    mapped = torch.from_numpy(frames)
    rays = sampler.draw(n_pixels, generator.manual_seed(0), mapped, tangent_planes=True)
    ends = rays.points(rays.depth[:, None])[:, 0]
    low, high = grid.low, grid.low + grid.voxel * (ends.new_tensor(grid.n_vertices) - 1)
    # The grid has no values for points outside, such as a facade seen through a window.
    is_inside = ((ends >= low) & (ends <= high)).all(dim=1)
    is_used = rays.normals_world.any(dim=1) & is_inside  # an unknown normal is 0
    if not is_used.any():
        raise DataError(f"{sequence.name} shows no surface to correct a map by: check its depth")
    drawn = ends, rays.normals_world, rays.depth, rays.color
    planes = [part[is_used].double().numpy() for part in drawn]
    vertices, _ = interpolation(planes[0], grid)
    return planes, vertices[:, 0]  # the number of a cell is that of its lowest vertex
