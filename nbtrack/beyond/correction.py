"""A map corrected at its surfaces: linear least squares on all measured depth, in closed form.

A network learns a distance everywhere, and is off by millimetres at surfaces. There the measured
points say it better, and say it linearly: trilinear interpolation in a grid is a weighted mean of
eight vertices. What the network says away from surfaces stays.
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
from nbtrack.mapping.holdout import split_holdout, usual_depth_residual

# All our choice, tried in the two rooms for tuning.
_N_POINTS = 300_000  # random pixels; those that show a plane are used
# Places along a measured point's normal, by the signed distance (m) that the map shall have there.
# The surface comes first, as `corrected` counts on; the others lie within a voxel, as planes end.
_OFFSETS = (0.0, -0.03, -0.015, 0.015, 0.03)
# A larger place takes more points, so that a frame sees no cells in which none lies. Rooms have so
# many a cell anyway; an office of 10 by 11 m had 3 (docs/tried.md).
_POINTS_A_CELL = 10
_MAX_TIMES = 4  # times `_N_POINTS` are drawn at most
# The least scales of a tracker's residuals (distance, luma): so many times the median residual that
# the corrected map leaves at measured points, and never below `_MIN_SCALES` (m, luma). Chosen in
# the rooms for tuning and on a real recording, whose medians are 1.8 mm and 0.002, and 4 mm and
# 0.02.
_SCALES_PER_MEDIAN = np.array([5.5, 2.3])
_MIN_SCALES = np.array([0.01, 0.05])
_UNMEASURED = 0.1  # confidence where nothing was measured, and the network interpolates
CORRECTIONS = ("numbers", "corrections", "cameras", "views", "residual_medians")
"""What a file keeps of a correction, besides the field: see `CorrectedField`."""
_SOURCE = "source."  # how names of the field as mapped begin


class CorrectedField(BakedField):
    """A grid of a learned field with corrections at vertices near surfaces. Our choice.

    What a file keeps is the field itself and, by name: the `numbers` (n) of corrected vertices,
    their `corrections` (n x 5) of colour, distance (m) and confidence in half precision, some
    mapped poses `cameras` (n x 4 x 4) with the small `views` (n x 2 x 15 x 20) from them, by which
    a lost camera is found, and `residual_medians` (2), of distance (m) and luma, that the
    corrections leave at measured points: from them follow the least scales of a tracker's
    residuals.
    """

    form = "corrected"

    def __init__(self, source: Field, voxel: float) -> None:
        """Sample a field as `BakedField` does; `add` then corrects it."""
        super().__init__(source, voxel)
        self.name = source.name
        self.label = f"{source.label} corrected"
        self.source = source

    def add(self, correction: State) -> None:
        """Add a correction, tensors by the names in `CORRECTIONS`, to the values at vertices."""
        for name in CORRECTIONS:
            self.register_buffer(name, correction[name])
        medians = self.residual_medians.double().numpy()  # of distance (m) and luma
        scales = np.maximum(_SCALES_PER_MEDIAN * medians, _MIN_SCALES)
        # A point fits within 2.5 cm of the surface.
        self.accuracy = Accuracy(tuple(scales.tolist()), 0.025, float(medians[1]))
        self.volume[4] = _UNMEASURED  # the channel of confidence
        self.volume[:, self.numbers.long()] += self.corrections.float().T

    @property
    def viewpoints(self) -> Viewpoints:
        """Some of the poses that it was mapped from, and their views."""
        return Viewpoints(self.cameras.double().numpy(), self.views)

    def state(self) -> State:
        """That of the field as mapped, and the corrections."""
        correction = {name: getattr(self, name) for name in CORRECTIONS}
        source = {f"{_SOURCE}{name}": tensor for name, tensor in self.source.state().items()}
        return correction | source

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> Self:
        """The field as mapped, sampled and corrected anew."""
        source = {n.removeprefix(_SOURCE): x for n, x in state.items() if n.startswith(_SOURCE)}
        mapped = field_class(made["field"]).from_state(source, made, bounds)
        field = cls(mapped, voxel=float(made["correction"]))  # m: its cells, as `correct_map` says
        field.add(state)
        return field


@usual_modes()
def correct_map(finished: Map, sequence: RgbdSequence, voxel: float) -> Map:
    """A map corrected in cells of `voxel` (m) by the frames it was made from; see `corrected`.

    Its record says how long that took, and how much memory (bytes) network and corrections take.
    """
    start = time.perf_counter()
    mapped, _ = split_holdout(len(sequence), finished.record["settings"]["holdout_every"])
    field = corrected(finished.field, sequence, mapped, voxel)
    seconds = time.perf_counter() - start
    record = {**finished.record, "correction": voxel, "correction_seconds": seconds}
    record["map_bytes"] = sum(tensor.nbytes for tensor in field.state_dict().values())
    record["seconds"] += seconds
    record["misfit_m"] = usual_depth_residual(field, sequence, mapped)
    return replace(finished, field=field, record=record)


@usual_modes()
def corrected(field: Field, sequence: RgbdSequence, frames: Frames, voxel: float) -> CorrectedField:
    """A map with a signed distance, corrected in cells of `voxel` (m) by its mapped frames.

    At a measured point p with normal n the interpolated distance at p + s n shall be s, at five
    offsets s, and the colour at p that of the pixel, but at the surface alone: off it a camera saw
    none. These equations, weighted by 1 / depth^2, are linear in the corrections of the vertices
    around; see `solve`. Raises DataError where no frame shows a plane, ConfigError for a density.
    """
    if not field.is_distance:
        raise ConfigError(f"{field.label} is no signed distance: only such a map can be corrected")
    grid = CorrectedField(copy.deepcopy(field).cpu(), voxel)
    points_world, normals_world, depth, seen_color = _measured_planes(sequence, frames, grid)
    n_points = len(points_world)
    asked_world = np.concatenate([points_world + s * normals_world for s in _OFFSETS])
    vertices, weights = interpolation(asked_world, grid)
    is_corrected, matrix = corrected_vertices(vertices, weights, grid.n_vertices)
    numbers, regularisation = regularisation_of(is_corrected)
    uncorrected = grid.volume[:4].T.double().numpy()[numbers]
    color_before, distance_before = uncorrected[:, :3], uncorrected[:, 3:]
    reliability = (depth.mean() / depth) ** 2
    wanted = np.repeat(_OFFSETS, n_points)[:, None] - matrix @ distance_before
    reliabilities = np.tile(reliability, len(_OFFSETS))
    # Residuals above 1 cm count less; their weights are computed anew four times.
    distance, diagonal = solve(matrix, wanted, reliabilities, regularisation, 0.01, rounds=4)
    # The share of measurements, not regularisation, in a vertex's diagonal.
    confidence = (1 - _UNMEASURED) * (1 - regularisation.diagonal() / diagonal)

    at_surface = matrix[:n_points]  # the rows of the first offset, which is 0
    wanted_color = seen_color - at_surface @ color_before
    # Colours, in [0, 1], change faster: a tenth of the regularisation.
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
    """Poses of some frames, `cameras` (n x 4 x 4), and what the camera saw from them, `views`."""
    kept = frames[spread_out(sequence.T_world_camera[frames])]
    views = torch.stack([view_of(sequence[index]) for index in kept.tolist()])
    return {"cameras": torch.from_numpy(sequence.T_world_camera[kept]).float(), "views": views}


def _measured_planes(
    sequence: RgbdSequence, frames: Frames, grid: BakedField
) -> tuple[np.ndarray, ...]:
    """Random measured points that show a plane; DataError if there is none.

    Returns points (n x 3, m, world), their planes' normals (n x 3), z-depths (n, m) and colours
    (n x 3, in [0, 1]). They come from `_N_POINTS` random pixels. If fewer than `_POINTS_A_CELL`
    points lie in a cell on average, as in a large place, all are drawn anew from more pixels, at
    most `_MAX_TIMES` as many. They are ordered by the grid's cells: vertices that neighbours share
    are then still in the processor's cache.
    """
    sampler, asked = PixelSampler(sequence, torch.device("cpu")), torch.from_numpy(frames)
    times = 1.0
    for _ in range(2):
        generator = torch.Generator().manual_seed(0)
        rays = sampler.draw(round(times * _N_POINTS), generator, asked, tangent_planes=True)
        ends = rays.points(rays.depth[:, None])[:, 0]
        low, high = grid.low, grid.low + grid.voxel * (ends.new_tensor(grid.n_vertices) - 1)
        # The grid has no values for points outside, such as a facade seen through a window.
        is_inside = ((ends >= low) & (ends <= high)).all(dim=1)
        has_plane = rays.normals_world.any(dim=1) & is_inside
        if not has_plane.any():
            found = f"{sequence.name} shows no surface to correct a map by"
            raise DataError(f"{found}: check its depth")
        vertices, _ = interpolation(ends[has_plane].double().numpy(), grid)
        cells = vertices[:, 0]  # a cell has the number of its first vertex
        times = min(_POINTS_A_CELL * len(np.unique(cells)) / len(cells), _MAX_TIMES)
        if times <= 1:
            break
    order = np.argsort(cells, kind="stable")
    drawn = ends, rays.normals_world, rays.depth, rays.color
    return tuple(each[has_plane].double().numpy()[order] for each in drawn)
