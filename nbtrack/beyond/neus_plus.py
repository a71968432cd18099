"""NeuS+: NeuS whose signed distance is also supervised directly by the measured depths.

Its distance is that of the large network, or of a small one that reads features in grids, which is
mapped in a fraction of the time.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Generator, Tensor, nn

from nbtrack.beyond.grid import trilinear
from nbtrack.beyond.points import cells_of, fuse_points, min_depth_behind
from nbtrack.core.arrays import Colors, Frames, Points, RaySamples, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Draw, Losses, measured_mean, rendered_losses
from nbtrack.fields.mlp import empty_linear
from nbtrack.fields.neus import NeuSField, NeusMapping, guided_depths
from nbtrack.machinery.settings import limited

_MIN_VOXEL = 0.05  # m between the corners at which distances are kept
_MAX_CELLS_A_SIDE = 128  # larger scenes have larger voxels
_POINTS_PER_FRAME = 10_000  # about, on a regular grid of its pixels
# The tangent plane gives a sample's distance if that differs by less (m) from the distance to the
# nearest point: half a voxel of the points, and the rounding of distances near the surface.
_PLANE_TOLERANCE = 0.015
Flags = Bool[Tensor, "rays samples"]


@dataclass(frozen=True)
class NeusPlusMapping(NeusMapping):
    """Mapping of NeuS+: half the rays, and measured points besides."""

    iterations: int = 10_000
    n_rays: int = limited(512, 1, 65536)
    lambda_color: float = 6.0
    eikonal_share: float = limited(0.125, 0.0, 1.0)
    lambda_sdf: float = 10.0  # per metre
    n_surface_points: int = limited(4096, 1, 65536)  # measured ones, besides the rays
    lambda_rendering: float = 1.0  # factor of rendered depth and colour; 0: none


class NeuSPlusField(NeuSField):
    """NeuS with signed-distance targets (m) besides: the paper's future work (Sec. IV)."""

    name = "neus_plus"
    label = "NeuS+"
    Settings = NeusPlusMapping

    def prepare(self, sequence: RgbdSequence, frames: Frames) -> None:
        """Collect the surface that the frames saw: distances in free space are measured from it."""
        self.observed = ObservedDistance(sequence, frames, self.bounds, self.device)

    def mapping_losses(self, draw: Draw, settings: NeusPlusMapping, generator: Generator) -> Losses:
        """The terms of NeuS, and L1 errors of the signed distance and of the surface's colour."""
        rays = draw(settings.n_rays, tangent_planes=True)
        depths = guided_depths(rays, self.bounds, settings, generator)
        surface = draw(settings.n_surface_points)
        colors, sdf = self.query_along(rays, depths)
        nearest, is_free = self.observed(rays.points(depths))
        target, known = distance_targets(rays, depths, nearest, is_free, settings)
        lambda_color = settings.lambda_rendering * settings.lambda_color
        lambda_depth = settings.lambda_rendering * settings.lambda_depth
        rendering = self.composite(colors, sdf, rays, depths)
        # At measured points the distance is zero, and the colour is that of the pixel.
        surface_color, surface_sdf = self(surface.points(surface.depth[:, None])[:, 0])
        measured = (surface.depth > 0).float()
        color_error = (surface_color - surface.color).abs().mean(dim=1)
        losses = {
            **rendered_losses(rendering, rays, lambda_color, lambda_depth),
            "sdf": settings.lambda_sdf * measured_mean((sdf - target).abs(), known),
            "surface": settings.lambda_sdf * measured_mean(surface_sdf.abs(), measured),
            "surface_color": settings.lambda_color * measured_mean(color_error, measured),
        }
        if settings.lambda_eikonal:
            losses["eikonal"] = self._eikonal(rays.points(depths), settings, generator)
        return losses


def distance_targets(
    rays: Rays, depths: RaySamples, nearest: RaySamples, is_free: Flags, settings: NeusPlusMapping
) -> tuple[RaySamples, RaySamples]:
    """Signed distances (m) to aim at, and a mask of 0 and 1: where one is known.

    A measured pixel gives the distance from its tangent plane, (D - d) times the ray's length
    times the cosine of incidence: exact where the surface is flat, with noise that averages out.
    In front of the surface it only holds where no other surface is nearer; there, and where the
    plane is not known, the distance `nearest` from any observed point (m) takes its place, but only
    farther than `surface_band` from the surface, where it is right to millimetres (see
    `ObservedDistance`). Just behind the surface the plane is continued, unless a camera saw through
    the place (`is_free`): thin things end there. Farther behind nothing is known.

    Source: distances along the ray as iSDF (Ortiz et al. 2022), nearest points as its "pc" bounds,
    but over all frames rather than one batch; the choice between them is ours.
    """
    before = rays.depth[:, None] - depths  # z-depth from a sample to the surface; negative behind
    # Distance from the plane for one metre of z-depth; 0 where the normal is not known.
    per_depth = (rays.normals_world * rays.directions_world).sum(dim=1).abs()[:, None]
    plane = before * per_depth
    is_plane_nearest = (per_depth > 0) & ((plane.abs() - nearest).abs() < _PLANE_TOLERANCE)
    target = torch.where(is_plane_nearest, plane, nearest)
    in_front = (before > 0) & (is_plane_nearest | (before > settings.surface_band))
    just_behind = (before <= 0) & (plane > -0.1)  # m
    known = in_front | (just_behind & is_plane_nearest & ~is_free)
    return target, (known & (rays.depth[:, None] > 0)).float()


class ObservedDistance:
    """Unsigned distance from the observed surface, and where cameras saw through, on a grid.

    The grid covers the scene's bounds; at its corners distances are those from a mean of measured
    points, the nearest by an exact Euclidean distance transform. Between corners they are right to
    millimetres but for the last `voxel` before a surface, where tangent planes serve.
    """

    def __init__(
        self, sequence: RgbdSequence, frames: Frames, bounds: SceneBounds, device: torch.device
    ) -> None:
        low, high = np.array(bounds.minimum), np.array(bounds.maximum)
        self.voxel = max(_MIN_VOXEL, (high - low).max() / _MAX_CELLS_A_SIDE)
        # Points are fused in cells of half the size; the centre of every second one is a corner of
        # the grid.
        fine = self.voxel / 2
        shape = np.ceil((high - low) / fine).astype(int) + 1
        n_pixels = sequence.intrinsics.width * sequence.intrinsics.height
        stride = max(1, round((n_pixels / _POINTS_PER_FRAME) ** 0.5))
        # Fewer than three points of a cell are noise.
        cloud = fuse_points(sequence, frames, bounds, fine, stride, min_count=3)
        points = cloud.points.double().numpy()
        point_in = np.full(shape, -1)  # each cell's point, by number; -1 where there is none
        cells, inside = cells_of(points, low, shape, fine)
        point_in.flat[cells] = np.flatnonzero(inside)
        # Of each cell the nearest one that has a point, as three indices.
        place = distance_transform_edt(point_in < 0, return_distances=False, return_indices=True)
        x, y, z = place[:, ::2, ::2, ::2]
        nearest = points[point_in[x, y, z]]
        # The corners of the grid, m: the centres of every second cell.
        corners = np.stack(np.indices(shape)[:, ::2, ::2, ::2], -1) * fine + low + fine / 2
        distance = torch.from_numpy(np.linalg.norm(corners - nearest, axis=-1)).float()
        corners_world = torch.from_numpy(corners.reshape(-1, 3)).float()
        is_free = min_depth_behind(corners_world, sequence, frames) < -0.05  # m
        self.values = torch.stack([distance, is_free.view(distance.shape).float()]).to(device)
        self.low = corners_world[0].to(device)

    def __call__(self, points_world: Float[Tensor, "rays samples 3"]) -> tuple[RaySamples, Flags]:
        """Distance (m), and whether a camera saw through, at points (m).

        Points outside of the grid get the values at its border.
        """
        values = trilinear(self.values, self.low, self.voxel, points_world.flatten(0, 1))
        distance, free = values.view(2, *points_world.shape[:2])
        return distance, free > 0.5


@dataclass(frozen=True)
class GridNetwork:
    """Features at the vertices of some grids, and the small network that reads them."""

    finest: float = limited(0.12, 0.04, 10.0)  # m, edge of the finest cells
    levels: int = limited(3, 1, 16)  # grids, each twice as coarse as the one before
    features: int = limited(4, 1, 16)  # a vertex
    hidden: int = limited(32, 1, 4096)  # units of the one hidden layer


@dataclass(frozen=True)
class GridPlusMapping(NeusPlusMapping):
    """Mapping of NeuS+ on grids. All chosen in the rooms for tuning (docs/tried.md)."""

    iterations: int = 300
    n_rays: int = limited(96, 1, 65536)
    n_stratified: int = limited(8, 2, 1024)
    n_surface: int = limited(8, 0, 1024)
    n_surface_points: int = limited(1024, 1, 65536)
    learning_rate: float = 0.01
    lambda_eikonal: float = limited(0.0, 0.0, 0.0)  # not tried in grids


class FeatureGrid(nn.Module):
    """Colour logits and one value at points, of features that are interpolated in some grids.

    Source: the dense levels of Instant-NGP (Müller et al. 2022), without its hash table: a room has
    few vertices.
    """

    def __init__(self, settings: GridNetwork, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__()
        self.metres_per_unit = bounds.metres_per_unit
        self.register_buffer(
            "low", torch.tensor(bounds.minimum, dtype=torch.float32), persistent=False
        )
        extent = self.low.new_tensor(bounds.maximum) - self.low
        self.voxels = [settings.finest * 2**level for level in range(settings.levels)]
        shapes = [((extent / voxel).ceil().long() + 1).tolist() for voxel in self.voxels]
        drawn = {"generator": generator, "dtype": torch.float32}
        volumes = [torch.randn(settings.features, *shape, **drawn) for shape in shapes]
        self.volumes = nn.ParameterList(0.01 * volume for volume in volumes)
        self.layer = empty_linear(settings.levels * settings.features + 3, settings.hidden)
        self.head = empty_linear(settings.hidden, 4)  # colour and value
        for part in (self.layer, self.head):
            nn.init.normal_(part.weight, std=part.in_features**-0.5, generator=generator)
            nn.init.normal_(part.bias, std=0.5, generator=generator)

    def features(self, points_world: Points) -> Float[Tensor, "n hidden"]:
        """Activations of the hidden layer at points (m, world frame)."""
        levels = zip(self.volumes, self.voxels, strict=True)
        inputs = [trilinear(volume, self.low, voxel, points_world).T for volume, voxel in levels]
        # The point itself, from about -1 to 1: a unit is half the longest side of the bounds.
        inputs.append((points_world - self.low) / self.metres_per_unit - 1)
        return nn.functional.silu(self.layer(torch.cat(inputs, dim=1)))

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Raw colour and the raw fourth output, before a field gives them a meaning."""
        color, value = self.head(self.features(points_world)).split([3, 1], dim=1)
        return color, value.squeeze(1)


class GridPlusField(NeuSPlusField):
    """NeuS+ on grids of features. Our choice."""

    name = "grid_plus"
    label = "NeuS+ grid"
    Network = GridNetwork
    Settings = GridPlusMapping

    def make_network(self, settings: GridNetwork, generator: Generator) -> FeatureGrid:
        """The grids, and the small network that reads them."""
        return FeatureGrid(settings, self.bounds, generator)
