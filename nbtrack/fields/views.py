"""Whole images of a field, for pictures and for scoring held-out frames."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.pixels import Rays
from nbtrack.fields import LearnedField
from nbtrack.fields.sampling import two_pass_depths

_RAYS_AT_ONCE = 4096
# Samples a ray for pictures: twice those of mapping, and in fixed places, so that an image shows
# the field and not the luck of the draw.
_N_STRATIFIED, _N_IMPORTANCE = 48, 24


@dataclass(frozen=True)
class View:
    """What a camera sees of a field."""

    color: Float[np.ndarray, "height width 3"]  # in [0, 1]
    depth: Float[np.ndarray, "height width"]  # z-depth, m


def render_view(
    field: LearnedField, intrinsics: Intrinsics, T_world_camera: Float[np.ndarray, "4 4"]
) -> View:
    """Colour and z-depth image (m) of a field from a camera pose. Nothing in it is random."""
    device = next(field.parameters()).device
    pose = torch.from_numpy(T_world_camera).float().to(device)
    rows, columns = torch.meshgrid(
        torch.arange(intrinsics.height, device=device),
        torch.arange(intrinsics.width, device=device),
        indexing="ij",
    )
    directions_world = pixel_directions(intrinsics, columns, rows).flatten(0, 1) @ pose[:3, :3].T
    colors, depths = [], []
    for directions in directions_world.split(_RAYS_AT_ONCE):
        origins = pose[:3, 3].expand_as(directions)
        color, depth = render_rays(field, origins, directions)
        colors.append(color.cpu())
        depths.append(depth.cpu())
    shape = (intrinsics.height, intrinsics.width)
    return View(torch.cat(colors).view(*shape, 3).numpy(), torch.cat(depths).view(shape).numpy())


@torch.no_grad()
def render_rays(
    field: LearnedField,
    origins_world: Float[Tensor, "rays 3"],
    directions_world: Float[Tensor, "rays 3"],
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Colour and z-depth (m) of rays, by two passes with fixed samples."""
    unknown = origins_world.new_zeros(len(origins_world))
    rays = Rays(origins_world, directions_world, torch.zeros_like(origins_world), unknown)
    depths = two_pass_depths(field, rays, _N_STRATIFIED, _N_IMPORTANCE)
    rendering = field.render(rays, depths)
    return rendering.color.clamp(0, 1), rendering.depth
