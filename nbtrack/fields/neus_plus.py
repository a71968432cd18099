"""NeuS+: NeuS whose signed distance is also taught directly, from the measured depths."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.config import MappingConfig
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import Batch, measured_mean, register_field
from nbtrack.fields.neus import NeuSField, rendered_losses
from nbtrack.fields.observed_distance import ObservedDistance


@register_field
class NeuSPlusField(NeuSField):
    """NeuS with metric signed-distance targets beside the rendering loss.

    The paper names direct supervision of the signed distance as future work (Sec. IV). Network and
    parameters are those of NeuS; only the losses differ.
    """

    name = "neus_plus"
    label = "NeuS+"
    supervision = "rendering+sdf"
    is_taught_distances = True

    def prepare(self, sequence: RgbdSequence, frames: Int[np.ndarray, "frames"]) -> None:
        """Collect the surface that the frames saw: distances in free space are measured from it."""
        self.observed = ObservedDistance(sequence, frames, self.bounds, self.mlp.center.device)

    def mapping_losses(
        self, batch: Batch, config: MappingConfig, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms of NeuS, and L1 errors of the signed distance and of the surface's colour."""
        rays, depths = batch.rays, batch.depths
        colors, sdf = self.along(rays, depths)
        nearest = self.observed(rays.points(depths).flatten(0, 1)).view_as(depths)
        target, known = distance_targets(rays, depths, nearest, self.observed.voxel, config)
        sdf_error = ((sdf - target).abs() * known).sum() / known.sum().clamp_min(1)
        rendered = rendered_losses(self.composite(colors, sdf, rays, depths), rays, config)
        return {
            **{name: config.lambda_rendering * loss for name, loss in rendered.items()},
            "sdf": config.lambda_sdf * sdf_error,
            **self._surface_losses(batch.surface, config),
            "eikonal": config.lambda_eikonal * self._eikonal(batch, config, generator),
        }

    def _surface_losses(self, surface: Rays, config: MappingConfig) -> dict[str, Float[Tensor, ""]]:
        """At measured points the distance is zero, and the colour is that of the pixel."""
        color, sdf = self(surface.points(surface.depth[:, None])[:, 0])
        measured = (surface.depth > 0).float()
        color_error = (color - surface.color).abs().mean(dim=-1)
        return {
            "surface": config.lambda_sdf * measured_mean(sdf.abs(), measured),
            "surface_color": config.lambda_color * measured_mean(color_error, measured),
        }


def distance_targets(
    rays: Rays,
    depths: Float[Tensor, "rays samples"],
    nearest: Float[Tensor, "rays samples"],
    voxel: float,
    config: MappingConfig,
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples"]]:
    """Signed distances (m) to aim at, and a mask of 0 and 1: where one is known.

    A measured pixel gives the distance from its tangent plane, (D - d) times the ray's length
    times the cosine of incidence: exact where the surface is flat, and its noise averages out over
    frames, which that of the nearest measured point does not. In front of the surface it only
    holds where no other surface is nearer; there, and where the plane is not known, the distance
    from the nearest observed surface takes its place. Just behind the surface the plane is
    continued; farther behind nothing is known.

    Args:
        nearest: distance (m) of the samples from the nearest surface that any frame observed.
        voxel: how coarsely (m) that is known.

    Source: distances along the ray as iSDF (Ortiz et al. 2022), nearest points as its "pc" bounds,
    but over all frames rather than one batch; the choice between them is ours.
    """
    behind = (rays.depth[:, None] - depths).neg()
    plane = -behind * rays.plane_distance_per_depth[:, None]
    has_depth, has_plane = rays.depth[:, None] > 0, rays.plane_distance_per_depth[:, None] > 0
    is_plane_nearest = has_plane & ((plane.abs() - nearest).abs() < 1.5 * voxel)
    in_front, just_behind = behind < 0, (behind >= 0) & (plane > -config.behind_band)
    target = torch.where(is_plane_nearest, plane, nearest)
    is_free = in_front & (is_plane_nearest | (-behind > config.surface_band))
    known = has_depth & (is_free | (just_behind & is_plane_nearest))
    return target, known.float()
