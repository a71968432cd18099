"""Where along rays to look: guided by the measured depth, or in two passes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import MappingConfig
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.fields.base import Batch, LearnedField
from nbtrack.fields.rendering import Rendering, importance_depths, stratified_depths

NEAR = 0.05  # m, z-depth before which nothing is looked for: closer than any depth camera measures


def draw_batch(
    field: LearnedField,
    sampler: PixelSampler,
    config: MappingConfig,
    generator: torch.Generator,
    frames: Int[Tensor, "frames"],
) -> Batch:
    """Rays for one iteration of mapping, with samples by the field's own wish: guided or not."""
    rays = sampler.draw(config.n_rays, generator, frames, field.is_taught_distances)
    if field.depth_guided:
        depths = guided_depths(rays, field.bounds, config, generator)
    else:
        depths = two_pass_depths(field, rays, config.n_stratified, config.n_surface, generator)
    if not field.is_taught_distances:
        return Batch(rays, depths)
    return Batch(rays, depths, sampler.draw(config.n_surface_points, generator, frames))


def guided_depths(
    rays: Rays, bounds: SceneBounds, config: MappingConfig, generator: torch.Generator
) -> Float[Tensor, "rays samples"]:
    """Stratified z-depths (m) up to just behind the measured surface, and more around it.

    Nothing is known of what lies behind a surface, so no samples are spent there. Rays without a
    depth are sampled to the end of the scene. Our choice; NICE-SLAM and its followers do alike.
    """
    exit_depth = rays_end(rays, bounds)
    measured = rays.depth > 0
    behind_surface = rays.depth + config.surface_band
    far = torch.where(measured, behind_surface, exit_depth)
    spread = stratified_depths(NEAR, far, config.n_stratified, generator)
    around = stratified_depths(-1.0, torch.ones_like(far), config.n_surface, generator)
    center = torch.where(measured, rays.depth, exit_depth)
    around = (center[:, None] + config.surface_band * around).clamp_min(NEAR)
    return torch.cat([spread, around], dim=-1).sort(dim=-1).values


@torch.no_grad()
def two_pass_depths(
    field: LearnedField,
    rays: Rays,
    n_stratified: int,
    n_importance: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "rays samples"]:
    """Ascending sample depths (m) that need no measurement: iMAP's two passes.

    The first pass renders `n_stratified` samples between the camera and the end of the scene; the
    second adds `n_importance` where that found something. Without a generator nothing is random.
    Source: iMAP, Sec. 3.2 (32 and 12 samples).
    """
    spread = stratified_depths(NEAR, rays_end(rays, field.bounds), n_stratified, generator)
    weights = _of_samples(field.render(rays, spread).weights, spread)
    extra = importance_depths(spread, weights, n_importance, generator)
    return torch.cat([spread, extra], dim=-1).sort(dim=-1).values


def render_in_two_passes(
    field: LearnedField,
    rays: Rays,
    n_stratified: int,
    n_importance: int,
    generator: torch.Generator | None = None,
) -> Rendering:
    """What `two_pass_depths` and rendering there give, with every sample asked for once.

    The second pass of the plain formulation asks again for the samples of the first; their answers
    are the same, and a third of the work.
    """
    with torch.no_grad():  # where samples lie is given: a pose does not move them along
        spread = stratified_depths(NEAR, rays_end(rays, field.bounds), n_stratified, generator)
    colors, values = field.along(rays, spread)
    with torch.no_grad():
        weights = _of_samples(field.composite(colors, values, rays, spread).weights, spread)
        extra = importance_depths(spread, weights, n_importance, generator)
    more_colors, more_values = field.along(rays, extra)
    depths, order = torch.cat([spread, extra], dim=-1).sort(dim=-1)
    colors = torch.cat([colors, more_colors], dim=1)
    colors = colors.gather(1, order[..., None].expand_as(colors))
    values = torch.cat([values, more_values], dim=-1).gather(-1, order)
    return field.composite(colors, values, rays, depths)


def _of_samples(
    weights: Float[Tensor, "rays sections"], depths: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Weights of samples; NeuS weighs the sections between them, of which both ends get a share."""
    if weights.shape[1] == depths.shape[1]:
        return weights
    pad = torch.nn.functional.pad
    return pad(weights, (0, 1)) + pad(weights, (1, 0))


def rays_end(rays: Rays, bounds: SceneBounds) -> Float[Tensor, "rays"]:
    """Z-depth (m) at which rays leave the scene, at least a little in front of the camera."""
    exit_depth = bounds.exit_depth(rays.origins_world, rays.directions_world)
    return exit_depth.clamp_min(2 * NEAR)
