"""A map of points: measured pixels of posed frames, averaged by voxel, for ICP."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from nbtrack.core.arrays import Colors, Frames, Points, Values, WorldPoints
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import project
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Field, State
from nbtrack.machinery.errors import ConfigError
from nbtrack.machinery.settings import MANY, limited

_MAX_CELLS_A_SIDE = 2**20  # with more, a cell's number would not fit into 64 bits
_FRAMES_AT_ONCE = 8  # after so many frames their pixels are summed up, which bounds the memory


@dataclass(frozen=True)
class PointMapping:
    """Settings of a map of points."""

    voxel: float = 0.02  # m; edge of the cells in which measured points are averaged
    holdout_every: int = limited(10, 0, MANY)  # every n-th frame is left out


class PointCloud(Field):
    """A map of measured points with colours, at most one in each voxel. `fuse_points` makes it."""

    name = "points"
    label = "Points"
    is_distance = False
    Settings = PointMapping

    def __init__(self, points: Points, colors: Colors, voxel: float, bounds: SceneBounds) -> None:
        """Keep points (m, world frame), colours in [0, 1], and the edge (m) of their cells."""
        super().__init__(bounds)
        self.register_buffer("points", points)
        self.register_buffer("colors", colors)
        self.voxel = voxel

    @classmethod
    def from_frames(
        cls, sequence: RgbdSequence, frames: Frames, bounds: SceneBounds, settings: PointMapping
    ) -> "PointCloud":
        """Map a sequence by `fuse_points`, with the voxel of the settings."""
        return fuse_points(sequence, frames, bounds, settings.voxel)

    @classmethod
    def from_state(cls, state: State, made: dict[str, Any], bounds: SceneBounds) -> "PointCloud":
        """Read the cloud of a map file; ValueError unless points and colours are equally many."""
        if len(state["points"]) != len(state["colors"]):
            raise ValueError("points and colours are not equally many")
        return cls(**state, voxel=float(made["settings"]["voxel"]), bounds=bounds)

    def diagnostics(self) -> dict[str, float]:
        """The number of points, and the memory (bytes) of points and colours."""
        return {"points": len(self.points), "bytes": 2 * self.points.nbytes}  # colours take as much

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour of the nearest map point, and the unsigned distance (m) from it."""
        queries = points_world.detach().cpu().numpy()
        distance, nearest = self.tree.query(np.nan_to_num(queries))  # the tree takes no NaN
        distance[np.isnan(queries).any(axis=1)] = np.nan
        return self.colors[nearest], torch.from_numpy(distance).to(points_world)

    @cached_property
    def tree(self) -> cKDTree:
        """A search tree of the points."""
        return cKDTree(self.points.cpu().numpy())


def fuse_points(
    sequence: RgbdSequence,
    frames: Frames,
    bounds: SceneBounds,
    voxel: float,
    stride: int = 1,
    min_count: int = 1,
) -> PointCloud:
    """Average the frames' measured pixels in each voxel to one point of a map.

    A point is the mean position (m, world frame) and colour (in [0, 1]) of a voxel's pixels, which
    reduces noise. Every `stride`-th pixel along both axes is used, if its point is in the bounds.
    Voxels with fewer than `min_count` pixels have no point. If all have fewer, those with the most
    have one. Raises ConfigError for a voxel (m) that is far too fine, or longer than the scene.
    """
    extent = np.subtract(bounds.maximum, bounds.minimum)
    if not extent.max() / _MAX_CELLS_A_SIDE <= voxel <= extent.max():
        raise ConfigError(
            f"voxel is {voxel:g} m: the scene is {extent.max():.3g} m long, so allowed are "
            f"{extent.max() / _MAX_CELLS_A_SIDE:.2g} to {extent.max():.2g} m; set for instance 0.02"
        )
    shape = np.floor(extent / voxel).astype(np.int64) + 1
    tables = []  # rows of x y z (m), red green blue and 1, indexed by the voxel's number
    for count, index in enumerate(frames.tolist(), start=1):
        frame = sequence[index]
        T_world_camera = sequence.T_world_camera[index]
        rows, columns = frame.measured_pixels(stride)
        points_camera = frame.points(rows, columns)[0].double().numpy()
        points_world = points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        colors = frame.color[rows, columns].numpy() / 255.0
        voxels, inside = cells_of(points_world, np.array(bounds.minimum), shape, voxel)
        values = np.column_stack([points_world, colors, np.ones(len(colors))])[inside]
        tables.append(pd.DataFrame(values, voxels))
        # The rows of each voxel become their sum. The sum of the ones is the number of pixels.
        if count % _FRAMES_AT_ONCE == 0 or count == len(frames):
            tables = [pd.concat(tables).groupby(level=0).sum()]
    sums = tables[0].to_numpy()
    sums = sums[sums[:, 6] >= min(min_count, sums[:, 6].max(initial=0))]
    means = torch.from_numpy((sums[:, :6] / sums[:, 6:]).astype(np.float32))
    return PointCloud(means[:, :3].contiguous(), means[:, 3:].contiguous(), voxel, bounds)


def cells_of(
    points: WorldPoints, low: Float[np.ndarray, "3"], shape: Int[np.ndarray, "3"], voxel: float
) -> tuple[Int[np.ndarray, "_"], np.ndarray]:
    """Numbers of the cells that contain points, and a mask (n) of the points inside the grid.

    The grid has its lowest corner at `low` (m), and `shape` cells of `voxel` (m) along x, y and z.
    Its cells are numbered in row-major order: z is fastest. There is one number for each point
    inside the grid, in the order of the points, and none for points outside.
    """
    cells = np.floor((points - low) / voxel).astype(np.int64)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    return np.ravel_multi_index(tuple(cells[inside].T), tuple(shape)), inside


def min_depth_behind(points_world: Points, sequence: RgbdSequence, frames: Frames) -> Values:
    """How far (z-depth, m) points (m) lie behind the surfaces that frames measured: the minimum.

    In each frame a point is projected into the image, and the depth measured there is subtracted
    from the point's depth. The smallest difference over all frames is returned. It is negative if a
    frame saw through the point to something behind it, and infinite if no frame has the point in
    view or measured a depth there. Every fifth frame is used, since neighbours see the same.
    """
    behind = points_world.new_full(points_world.shape[:1], torch.inf)
    for index in frames[::5].tolist():
        frame = sequence[index]
        T_world_camera = torch.from_numpy(frame.T_world_camera).to(points_world)
        points_camera = (points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        columns, rows, depth = project(frame.camera, points_camera)
        columns, rows = columns.round(), rows.round()
        inside = (depth > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < frame.camera.width) & (rows < frame.camera.height)
        _, measured_depth = frame.at(rows[inside].long(), columns[inside].long())
        found = torch.where(measured_depth > 0, depth[inside] - measured_depth, torch.inf)
        behind[inside] = torch.minimum(behind[inside], found)
    return behind
