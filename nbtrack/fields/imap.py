"""iMAP: colour and volume density (Sucar et al. 2021)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, MappingConfig
from nbtrack.data.pixels import Rays
from nbtrack.fields.base import Batch, LearnedField, measured_mean, register_field
from nbtrack.fields.mlp import FourierMlp
from nbtrack.fields.rendering import Rendering, composite, weights_from_density

# Density (1/m) of one unit of network output: surfaces need hundreds per metre, networks like
# outputs near one. Source of the factor: vMAP's re-implementation of iMAP.
DENSITY_PER_UNIT = 10.0
# Least standard deviation (m) that a depth error is divided by: a perfectly sharp ray would
# otherwise outweigh all others (our choice; depth noise is of this size).
LEAST_DEVIATION = 0.02


@register_field
class IMapField(LearnedField):
    """f: position -> (colour, density in 1/m). Paper, Sec. II-A."""

    name = "imap"
    label = "iMAP"
    depth_guided = False

    def __init__(
        self, config: FieldConfig, bounds: SceneBounds, generator: torch.Generator
    ) -> None:
        super().__init__(bounds)
        self.mlp = FourierMlp(config, bounds, torch.nn.functional.relu, generator)

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and density (1/m, positive)."""
        raw_color, raw_density = self.mlp(points_world)
        # Softplus, not a rectifier: a density that starts below zero could never recover.
        density = DENSITY_PER_UNIT * torch.nn.functional.softplus(raw_density)
        return torch.sigmoid(raw_color), density

    def composite(
        self,
        colors: Float[Tensor, "rays samples 3"],
        values: Float[Tensor, "rays samples"],
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
    ) -> Rendering:
        """Volume rendering from density. Source: iMAP, Sec. 3.2."""
        weights = weights_from_density(values, depths, rays.directions_world.norm(dim=-1))
        return composite(weights, colors, depths)

    def mapping_losses(
        self, batch: Batch, config: MappingConfig, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """iMAP's geometric and photometric losses, the latter five times."""
        rendering = self.render(batch.rays, batch.depths)
        return rendering_losses(rendering, batch.rays, config.lambda_color)

    @property
    def surface_level(self) -> float:
        """Density (1/m) whose isosurface is meshed.

        A density has no surface; light is halved over ln 2 / 20 = 3.5 cm at this one (our choice).
        """
        return 20.0


def rendering_losses(
    rendering: Rendering, rays: Rays, lambda_color: float
) -> dict[str, Float[Tensor, ""]]:
    """Depth error over the rendered standard deviation, and colour L1, for mapping and tracking.

    L = mean(|D - D_rendered| / sqrt(variance)) + lambda_color mean|I - I_rendered|.

    The deviation is a constant weight here: its gradient would reward blurred surfaces. Rays
    without a depth measurement take part in neither term, since what they see is often out of
    range as well. Source: iMAP, Sec. 3.3; detaching follows NICE-SLAM's re-implementation.
    """
    measured = (rays.depth > 0).float()
    deviation = rendering.depth_variance.detach().sqrt().clamp_min(LEAST_DEVIATION)
    depth_error = (rendering.depth - rays.depth).abs() / deviation
    color_error = (rendering.color - rays.color).abs().mean(dim=-1)
    return {
        "depth": measured_mean(depth_error, measured),
        "color": lambda_color * measured_mean(color_error, measured),
    }
