"""NeuS+: NeuS whose signed distance is also taught directly, from the measured depths."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Generator

from nbtrack.core.arrays import Frames, Points, RaySamples, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Draw, Losses, measured_mean, rendered_losses
from nbtrack.fields.neus import NeuSField, NeusMapping, guided_depths
from nbtrack.fields.points import cells_of, measured_points

_LEAST_VOXEL = 0.05  # m; finer cells hold too few points to tell a surface from noise
_MOST_CELLS_A_SIDE = 256  # so that a large scene takes no more than some 60 MB
_LEAST_POINTS = 3  # measured points that make a cell part of a surface: single ones are noise
_POINTS_PER_FRAME = 10_000  # about, on a regular grid of its pixels


@dataclass(frozen=True)
class NeusPlusMapping(NeusMapping):
    """Mapping of NeuS+: half the rays, and measured points besides."""

    iterations: int = 10_000
    n_rays: int = 512
    lambda_color: float = 6.0
    eikonal_share: float = 0.125
    lambda_sdf: float = 10.0  # per metre
    n_surface_points: int = 4096  # measured points an iteration, besides the rays
    lambda_rendering: float = 1.0  # factor of rendered depth and colour; 0: none
    behind_band: float = 0.1  # distances are taught so far behind surfaces, m


class NeuSPlusField(NeuSField):
    """NeuS with signed-distance targets (m) besides: the paper's future work (Sec. IV)."""

    name = "neus_plus"
    label = "NeuS+"
    Settings = NeusPlusMapping
    supervision = "rendering+sdf"

    def prepare(self, sequence: RgbdSequence, frames: Frames) -> None:
        """Collect the surface that the frames saw: distances in free space are measured from it."""
        self.observed = ObservedDistance(sequence, frames, self.bounds, self.device)

    def mapping_losses(self, draw: Draw, settings: NeusPlusMapping, generator: Generator) -> Losses:
        """The terms of NeuS, and L1 errors of the signed distance and of the surface's colour."""
        rays = draw(settings.n_rays, tangent_planes=True)
        depths = guided_depths(rays, self.bounds, settings, generator)
        surface = draw(settings.n_surface_points)
        colors, sdf = self.along(rays, depths)
        nearest = self.observed(rays.points(depths).flatten(0, 1)).view_as(depths)
        target, known = distance_targets(rays, depths, nearest, self.observed.voxel, settings)
        lambdas = settings.lambda_color, settings.lambda_depth
        lambdas = (settings.lambda_rendering * weight for weight in lambdas)
        rendering = self.composite(colors, sdf, rays, depths)
        # At measured points the distance is zero, and the colour is that of the pixel.
        surface_color, surface_sdf = self(surface.points(surface.depth[:, None])[:, 0])
        measured = (surface.depth > 0).float()
        color_error = (surface_color - surface.color).abs().mean(dim=-1)
        return {
            **rendered_losses(rendering, rays, *lambdas),
            "sdf": settings.lambda_sdf * measured_mean((sdf - target).abs(), known),
            "surface": settings.lambda_sdf * measured_mean(surface_sdf.abs(), measured),
            "surface_color": settings.lambda_color * measured_mean(color_error, measured),
            "eikonal": self._eikonal(rays.points(depths), settings, generator),
        }


def distance_targets(
    rays: Rays, depths: RaySamples, nearest: RaySamples, voxel: float, settings: NeusPlusMapping
) -> tuple[RaySamples, RaySamples]:
    """Signed distances (m) to aim at, and a mask of 0 and 1: where one is known.

    A measured pixel gives the distance from its tangent plane, (D - d) times the ray's length
    times the cosine of incidence: exact where the surface is flat, with noise that averages out.
    In front of the surface it only holds where no other surface is nearer; there, and where the
    plane is not known, the distance `nearest` from any observed surface (m, known to a `voxel`)
    takes its place. Just behind the surface the plane is continued; farther nothing is known.

    Source: distances along the ray as iSDF (Ortiz et al. 2022), nearest points as its "pc" bounds,
    but over all frames rather than one batch; the choice between them is ours.
    """
    behind = (rays.depth[:, None] - depths).neg()
    plane = -behind * rays.plane_distance_per_depth[:, None]
    has_depth, has_plane = rays.depth[:, None] > 0, rays.plane_distance_per_depth[:, None] > 0
    is_plane_nearest = has_plane & ((plane.abs() - nearest).abs() < 1.5 * voxel)
    in_front, just_behind = behind < 0, (behind >= 0) & (plane > -settings.behind_band)
    target = torch.where(is_plane_nearest, plane, nearest)
    is_free = in_front & (is_plane_nearest | (-behind > settings.surface_band))
    known = has_depth & (is_free | (just_behind & is_plane_nearest))
    return target, known.float()


class ObservedDistance:
    """Unsigned distance from the observed surface, on a grid over the scene's bounds.

    Cells that hold measured points are the surface, from which a Euclidean distance transform
    measures. It is true to about a cell: for free space, not for the surface itself.
    """

    def __init__(
        self, sequence: RgbdSequence, frames: Frames, bounds: SceneBounds, device: torch.device
    ) -> None:
        self.voxel = max(_LEAST_VOXEL, 2 * bounds.metres_per_unit / _MOST_CELLS_A_SIDE)
        low = np.array(bounds.minimum)
        shape = np.ceil((np.array(bounds.maximum) - low) / self.voxel).astype(int) + 1
        counts = np.zeros(shape.prod(), dtype=np.int64)
        n_pixels = sequence.intrinsics.width * sequence.intrinsics.height
        stride = max(1, round((n_pixels / _POINTS_PER_FRAME) ** 0.5))
        for index in frames.tolist():
            cells, _ = cells_of(measured_points(sequence[index], stride)[0], low, shape, self.voxel)
            counts += np.bincount(cells, minlength=len(counts))
        # A short recording must not lose its surfaces to the demand for several points.
        is_surface = counts >= min(_LEAST_POINTS, counts.max())
        distance = distance_transform_edt(~is_surface.reshape(shape), sampling=self.voxel)
        self.distance = torch.from_numpy(distance.astype(np.float32)).to(device)
        self.low = torch.tensor(low, dtype=torch.float32, device=device)

    def __call__(self, points_world: Points) -> Values:
        """Distance (m) at points (m, world frame); outside the grid that of its border."""
        shape = torch.tensor(self.distance.shape, device=points_world.device)
        position = (points_world - self.low) / self.voxel - 0.5
        position = position.clamp_min(0).minimum((shape - 1).float() - 1e-3)
        # grid_sample takes x, y, z of a volume indexed z, y, x, from -1 to 1.
        normalized = (2 * position / (shape - 1) - 1).flip(-1)
        sampled = torch.nn.functional.grid_sample(
            self.distance[None, None], normalized[None, None, None], align_corners=True
        )
        return sampled.flatten()
