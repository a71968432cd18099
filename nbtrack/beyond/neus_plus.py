"""NeuS+: NeuS whose signed distance is also supervised directly by the measured depths.

`NeuSPlusField` has the large network of NeuS. `GridPlusField` has a small one that reads features
in grids, and is mapped in a fraction of the time.
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

_MIN_VOXEL = 0.05  # m; smallest voxel of the grid of observed distances
_MAX_CELLS_A_SIDE = 128  # of that grid: larger scenes have larger voxels
_POINTS_PER_FRAME = 10_000  # about, on a regular grid of its pixels
# m. The tangent plane is the surface nearest to a sample if the distance from it differs by less
# than this from the distance to the nearest point. It is a little more than half of the edge
# (`_MIN_VOXEL` / 2) of the cells in which points are fused.
_PLANE_TOLERANCE = 0.015
Flags = Bool[Tensor, "rays samples"]


@dataclass(frozen=True)
class NeusPlusMapping(NeusMapping):
    """Settings of mapping with NeuS+: half as many rays as NeuS, and also measured points.

    All are our choice.
    """

    iterations: int = 10_000
    n_rays: int = limited(512, 1, 65536)
    lambda_color: float = 6.0
    eikonal_share: float = limited(0.125, 0.0, 1.0)
    lambda_sdf: float = 10.0  # 1/m; weight of the errors of the signed distance
    n_surface_points: int = limited(4096, 1, 65536)  # measured points in each iteration
    lambda_rendering: float = 1.0  # factor of both rendering losses; 0: no rendering losses


class NeuSPlusField(NeuSField):
    """NeuS whose signed distances have targets (m), too: the paper's future work (Sec. IV)."""

    name = "neus_plus"
    label = "NeuS+"
    Settings = NeusPlusMapping

    def prepare(self, sequence: RgbdSequence, frames: Frames) -> None:
        """Compute distances from the surface that the frames saw, for the losses in free space."""
        self.observed = ObservedDistance(sequence, frames, self.bounds, self.device)

    def mapping_losses(self, draw: Draw, settings: NeusPlusMapping, generator: Generator) -> Losses:
        """The losses of NeuS, and L1 errors of the signed distance and of the surface's colour."""
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
        is_measured = (surface.depth > 0).float()
        color_error = (surface_color - surface.color).abs().mean(dim=1)
        losses = {
            **rendered_losses(rendering, rays, lambda_color, lambda_depth),
            "sdf": settings.lambda_sdf * measured_mean((sdf - target).abs(), known),
            "surface": settings.lambda_sdf * measured_mean(surface_sdf.abs(), is_measured),
            "surface_color": settings.lambda_color * measured_mean(color_error, is_measured),
        }
        if settings.lambda_eikonal:
            losses["eikonal"] = self._eikonal(rays.points(depths), settings, generator)
        return losses


def distance_targets(
    rays: Rays, depths: RaySamples, nearest: RaySamples, is_free: Flags, settings: NeusPlusMapping
) -> tuple[RaySamples, RaySamples]:
    """Target signed distances (m) of samples, and a mask: 1 if the target is known, else 0.

    `nearest` is the distance (m) of samples from the nearest observed point, and `is_free` says
    whether a camera saw through them. There are two sources of a target:

    - The distance from the tangent plane of the ray's pixel: (D - d) times the length of the ray's
      direction times the cosine of incidence, for the measured depth D and the sample's depth d. It
      is exact if the surface is flat, and its noise averages out. It is used in front of the ray's
      surface, and up to 10 cm behind it, if it agrees with `nearest` to `_PLANE_TOLERANCE`. Behind
      the surface it is not used if a camera saw through the sample, since thin things end there.
    - The distance `nearest`. It is used elsewhere in front of the ray's surface, if this surface is
      more than `surface_band` (m of z-depth) away. Within a voxel of another surface it may be up
      to half a voxel too large, since it is interpolated.

    Farther behind the surface nothing is known.

    Source: iSDF (Ortiz et al. 2022) has distances along the ray, and nearest points as its "pc"
    bounds, but of one batch and not of all frames. The choice between the two is ours.
    """
    # m of z-depth from a sample to the ray's surface; negative behind the surface.
    to_surface = rays.depth[:, None] - depths
    # Distance from the plane for each metre of z-depth; 0 if the normal is unknown.
    per_depth = (rays.normals_world * rays.directions_world).sum(dim=1).abs()[:, None]
    to_plane = to_surface * per_depth
    is_plane_nearest = (per_depth > 0) & ((to_plane.abs() - nearest).abs() < _PLANE_TOLERANCE)
    target = torch.where(is_plane_nearest, to_plane, nearest)
    in_front = (to_surface > 0) & (is_plane_nearest | (to_surface > settings.surface_band))
    just_behind = (to_surface <= 0) & (to_plane > -0.1)  # m
    known = in_front | (just_behind & is_plane_nearest & ~is_free)
    return target, (known & (rays.depth[:, None] > 0)).float()


class ObservedDistance:
    """A grid of unsigned distances from the observed surface, and of free space.

    The grid covers the scene's bounds. Its vertices have the distance from the nearest fused point
    (a mean of measured points), by a Euclidean distance transform. Interpolated distances are right
    to millimetres, except within a `voxel` of a surface. There `distance_targets` uses tangent
    planes. A vertex is free if a camera saw through it.
    """

    def __init__(
        self, sequence: RgbdSequence, frames: Frames, bounds: SceneBounds, device: torch.device
    ) -> None:
        low, high = np.array(bounds.minimum), np.array(bounds.maximum)
        self.voxel = max(_MIN_VOXEL, (high - low).max() / _MAX_CELLS_A_SIDE)
        # Points are fused in fine cells of half the voxel. The grid's vertices are the centres of
        # every second fine cell.
        fine = self.voxel / 2
        shape = np.ceil((high - low) / fine).astype(int) + 1
        n_pixels = sequence.intrinsics.width * sequence.intrinsics.height
        stride = max(1, round((n_pixels / _POINTS_PER_FRAME) ** 0.5))
        # One or two measured points in a cell are noise.
        cloud = fuse_points(sequence, frames, bounds, fine, stride, min_count=3)
        points = cloud.points.double().numpy()
        point_in = np.full(shape, -1)  # the index of each cell's point; -1 if it has none
        cells, inside = cells_of(points, low, shape, fine)
        point_in.flat[cells] = np.flatnonzero(inside)
        # For each cell the indices, along x, y and z, of the nearest cell with a point.
        place = distance_transform_edt(point_in < 0, return_distances=False, return_indices=True)
        x, y, z = place[:, ::2, ::2, ::2]
        nearest = points[point_in[x, y, z]]
        # Positions (m, world frame) of the grid's vertices; the last axis holds x, y and z.
        vertices = np.stack(np.indices(shape)[:, ::2, ::2, ::2], -1) * fine + low + fine / 2
        distance = torch.from_numpy(np.linalg.norm(vertices - nearest, axis=-1)).float()
        vertices_world = torch.from_numpy(vertices.reshape(-1, 3)).float()
        # A camera saw through a vertex if it measured a surface at least 5 cm behind it.
        is_free = min_depth_behind(vertices_world, sequence, frames) < -0.05
        self.values = torch.stack([distance, is_free.view(distance.shape).float()]).to(device)
        self.low = vertices_world[0].to(device)

    def __call__(self, points_world: Float[Tensor, "rays samples 3"]) -> tuple[RaySamples, Flags]:
        """Distances (m) of points (m) from the observed surface, and whether a camera saw through.

        Points outside of the grid get the values of its border.
        """
        values = trilinear(self.values, self.low, self.voxel, points_world.flatten(0, 1))
        distance, free = values.view(2, *points_world.shape[:2])
        return distance, free > 0.5


@dataclass(frozen=True)
class GridNetwork:
    """Sizes of the grids of features, and of the small network that reads them."""

    finest: float = limited(0.12, 0.04, 10.0)  # m; cell size of the finest grid
    levels: int = limited(3, 1, 16)  # number of grids, each twice as coarse as the one before
    features: int = limited(4, 1, 16)  # numbers at each vertex
    hidden: int = limited(32, 1, 4096)  # units of the one hidden layer


@dataclass(frozen=True)
class GridPlusMapping(NeusPlusMapping):
    """Settings of mapping with NeuS+ on grids, chosen in the rooms for tuning (docs/tried.md)."""

    iterations: int = 300
    n_rays: int = limited(96, 1, 65536)
    n_stratified: int = limited(8, 2, 1024)
    n_surface: int = limited(8, 0, 1024)
    n_surface_points: int = limited(1024, 1, 65536)
    learning_rate: float = 0.01
    lambda_eikonal: float = limited(0.0, 0.0, 0.0)  # not tried in grids


class FeatureGrid(nn.Module):
    """Colour logits and one value at points, from features that are interpolated in several grids.

    Source: the dense levels of Instant-NGP (Müller et al. 2022). Its hash table is left out, since
    a room has few vertices.
    """

    def __init__(self, settings: GridNetwork, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__()
        self.metres_per_unit = bounds.metres_per_unit
        low, high = torch.tensor([bounds.minimum, bounds.maximum], dtype=torch.float32)
        self.register_buffer("low", low, persistent=False)
        extent = high - low
        self.voxels = [settings.finest * 2**level for level in range(settings.levels)]
        shapes = [((extent / voxel).ceil().long() + 1).tolist() for voxel in self.voxels]
        # All standard deviations of initial weights are our choice. Features begin small.
        options = {"generator": generator, "dtype": torch.float32}
        volumes = [torch.randn(settings.features, *shape, **options) for shape in shapes]
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
        # The point itself, about in [-1, 1]: a unit is about half of the bounds' longest side.
        inputs.append((points_world - self.low) / self.metres_per_unit - 1)
        return nn.functional.silu(self.layer(torch.cat(inputs, dim=1)))

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour logits and the value at points (m), before a field applies its activations."""
        color, value = self.head(self.features(points_world)).split([3, 1], dim=1)
        return color, value.squeeze(1)


class GridPlusField(NeuSPlusField):
    """NeuS+ on grids of features. Our choice."""

    name = "grid_plus"
    label = "NeuS+ grid"
    Network = GridNetwork
    Settings = GridPlusMapping

    def make_network(self, settings: GridNetwork, generator: Generator) -> FeatureGrid:
        """The feature grids and their small network, which replace the large network of NeuS."""
        return FeatureGrid(settings, self.bounds, generator)
