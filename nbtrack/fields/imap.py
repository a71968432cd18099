"""iMAP: colour and volume density (Sucar et al. 2021)."""

import torch
from torch import Generator

from nbtrack.core.arrays import Colors, Points, RaySamples, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.fields.base import Draw, LearnedField, Losses, MappingSettings, rendered_losses
from nbtrack.fields.mlp import FourierMlp, NetworkSettings
from nbtrack.fields.rendering import Weights, weights_from_density

DENSITY_PER_UNIT = 10.0  # density (1/m) for one unit of network output, as in vMAP's iMAP


class IMapField(LearnedField):
    """f: position -> (colour, density in 1/m). Paper, Sec. II-A."""

    name = "imap"
    label = "iMAP"
    is_distance = False
    value_label = "density (1/m)"
    # 1/m. A density has no exact surface. Where it has this value everywhere, half of the light is
    # absorbed within ln 2 / 20 = 3.5 cm (our choice).
    surface_level = 20.0

    def __init__(self, network: NetworkSettings, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__(bounds)
        self.mlp = FourierMlp(network, bounds, torch.nn.functional.relu, generator)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and density (1/m, positive)."""
        raw_color, raw_density = self.mlp(points_world)
        # Softplus instead of a rectifier, whose gradient is 0 where the raw density is negative.
        density = DENSITY_PER_UNIT * torch.nn.functional.softplus(raw_density)
        return torch.sigmoid(raw_color), density

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Probabilities that rays end at their samples. Source: iMAP, Sec. 3.2."""
        return weights_from_density(values, depths, rays.directions_world.norm(dim=1))

    def mapping_losses(self, draw: Draw, settings: MappingSettings, generator: Generator) -> Losses:
        """iMAP's losses of rendered depth and colour."""
        rays = draw(settings.n_rays)
        # Samples are not guided by the measured depth, since those of tracking cannot be: at a
        # wrong pose the map's surface lies elsewhere (docs/choices.md).
        n_first, n_second = settings.n_stratified, settings.n_surface
        rendered = self.render_hierarchically(rays, n_first, n_second, generator)
        return rendered_losses(rendered, rays, settings.lambda_color, lambda_depth=1, over_std=True)
