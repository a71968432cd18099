"""iMAP: colour and volume density (Sucar et al. 2021)."""

import torch
from torch import Generator

from nbtrack.core.arrays import Colors, Points, RayColors, RaySamples, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.fields.base import Draw, LearnedField, Losses, MappingSettings, rendered_losses
from nbtrack.fields.mlp import FourierMlp, NetworkSettings
from nbtrack.fields.rendering import Rendering, composite, weights_from_density

DENSITY_PER_UNIT = 10.0  # 1/m of one unit of network output (vMAP's re-implementation of iMAP)
# Minimum standard deviation (m) that a depth error is divided by: a perfectly sharp ray would
# otherwise outweigh all others (our choice; depth noise is of this size).
MIN_STD = 0.02


class IMapField(LearnedField):
    """f: position -> (colour, density in 1/m). Paper, Sec. II-A."""

    name = "imap"
    label = "iMAP"
    is_distance = False
    # Density (1/m): it has no surface, but light is halved over ln 2 / 20 = 3.5 cm (our choice).
    surface_level = 20.0

    def __init__(self, network: NetworkSettings, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__(bounds)
        self.mlp = FourierMlp(network, bounds, torch.nn.functional.relu, generator)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and density (1/m, positive)."""
        raw_color, raw_density = self.mlp(points_world)
        # Softplus, not a rectifier: a density that starts below zero could never recover.
        density = DENSITY_PER_UNIT * torch.nn.functional.softplus(raw_density)
        return torch.sigmoid(raw_color), density

    def composite(
        self, colors: RayColors, values: RaySamples, rays: Rays, depths: RaySamples
    ) -> Rendering:
        """Volume rendering from density. Source: iMAP, Sec. 3.2."""
        weights = weights_from_density(values, depths, rays.directions_world.norm(dim=-1))
        return composite(weights, colors, depths)

    def mapping_losses(self, draw: Draw, settings: MappingSettings, generator: Generator) -> Losses:
        """iMAP's geometric and photometric losses."""
        rays = draw(settings.n_rays)
        # Not guided by measured depths: tracking has no such help, and would see a thinner map.
        n_samples = settings.n_stratified, settings.n_surface
        rendering = self.render(rays, self.hierarchical_depths(rays, *n_samples, generator))
        return rendering_losses(rendering, rays, settings.lambda_color)


def rendering_losses(rendering: Rendering, rays: Rays, lambda_color: float) -> Losses:
    """Depth error over the rendered standard deviation, and colour L1, for mapping and tracking.

    L = mean(|D - D_rendered| / sqrt(variance)) + lambda_color mean|I - I_rendered|.

    The std is detached, as in NICE-SLAM: its gradient would reward blurred surfaces.
    Source: iMAP, Sec. 3.3.
    """
    std = rendering.depth_variance.detach().sqrt().clamp_min(MIN_STD)
    return rendered_losses(rendering, rays, lambda_color, std=std)
