"""NeuS: colour and signed distance on iMAP's network (Wang et al. 2021)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, MappingConfig
from nbtrack.data.pixels import Rays
from nbtrack.fields.base import (
    LUMA,
    Batch,
    LearnedField,
    Linearization,
    measured_mean,
    register_field,
)
from nbtrack.fields.engine import FrozenMlp
from nbtrack.fields.mlp import FourierMlp
from nbtrack.fields.rendering import Rendering, composite, weights_from_sdf


@register_field
class NeuSField(LearnedField):
    """f: position -> (colour, signed distance in m, positive in free space). Paper, Sec. II-A.

    One parameter more than iMAP: `variance`, with s = exp(10 variance) in 1/m, the inverse
    standard deviation of the s-density; the factor lets it move at the network's learning rate
    (NeuS, published code). SiLU replaces ReLU: trackers and the eikonal term need a distance
    whose gradient is continuous.
    """

    name = "neus"
    label = "NeuS"

    def __init__(
        self, config: FieldConfig, bounds: SceneBounds, generator: torch.Generator
    ) -> None:
        super().__init__(bounds)
        self.mlp = FourierMlp(config, bounds, torch.nn.functional.silu, generator)
        self.variance = torch.nn.Parameter(torch.tensor(0.3))
        self._start_as_empty_room(generator)

    @property
    def inverse_deviation(self) -> Float[Tensor, ""]:
        """s (1/m)."""
        return torch.exp(10 * self.variance)

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and signed distance (m)."""
        raw_color, raw_sdf = self.mlp(points_world)
        return torch.sigmoid(raw_color), raw_sdf * self.mlp.metres_per_unit

    def sdf_gradient(
        self, points_world: Float[Tensor, "n 3"], create_graph: bool = False
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distance (m) and its spatial gradient (no unit, length 1 for a true distance)."""
        points = points_world.detach().requires_grad_()
        with torch.enable_grad():
            sdf = self(points)[1]
            (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=create_graph)
        return sdf, gradient

    @torch.no_grad()
    def linearize(self, points_world: Float[Tensor, "n 3"]) -> Linearization:
        """Value and intensity with their gradients; by the engine, if the field is frozen."""
        if not isinstance(self.mlp, FrozenMlp):
            return super().linearize(points_world)
        raw, gradients = self.mlp.linearize(points_world, self._slopes)
        return Linearization(
            raw[:, 3] * self.mlp.metres_per_unit, gradients[0],
            torch.sigmoid(raw[:, :3]) @ LUMA.to(raw), gradients[1],
        )  # fmt: skip

    def _slopes(self, raw: Float[Tensor, "n 4"]) -> Float[Tensor, "2 n 4"]:
        """Derivatives of distance (m) and intensity with respect to the network's outputs."""
        color = torch.sigmoid(raw[:, :3])
        slopes = raw.new_zeros(2, len(raw), 4)
        slopes[0, :, 3] = self.mlp.metres_per_unit
        slopes[1, :, :3] = LUMA.to(raw) * color * (1 - color)
        return slopes

    def composite(
        self,
        colors: Float[Tensor, "rays samples 3"],
        values: Float[Tensor, "rays samples"],
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
    ) -> Rendering:
        """Volume rendering of the sections between samples.

        A section's depth and colour are the means of its two ends: its mid-point, where the
        weight applies (our choice; NeuS evaluates the network there once more).
        """
        weights = weights_from_sdf(values, self.inverse_deviation)
        middle_colors = (colors[:, 1:] + colors[:, :-1]) / 2
        return composite(weights, middle_colors, (depths[:, 1:] + depths[:, :-1]) / 2)

    def mapping_losses(
        self, batch: Batch, config: MappingConfig, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Colour L1, depth L1 and the eikonal term (NeuS, Eq. 15, with RGB-D's depth added)."""
        return {
            **rendered_losses(self.render(batch.rays, batch.depths), batch.rays, config),
            "eikonal": config.lambda_eikonal * self._eikonal(batch, config, generator),
        }

    def _eikonal(
        self, batch: Batch, config: MappingConfig, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Mean (|grad f| - 1)^2 over a share of the ray samples, drawn anew every time.

        The second derivatives cost as much as the rest of the step, and neighbouring samples say
        the same: a quarter of them kept the quality in trials.
        """
        points = batch.rays.points(batch.depths).flatten(0, 1)
        n_points = max(1, round(config.eikonal_share * len(points)))
        chosen = torch.randint(len(points), (n_points,), generator=generator, device=points.device)
        _, gradient = self.sdf_gradient(points[chosen], create_graph=True)
        return (gradient.norm(dim=-1) - 1).square().mean()

    @property
    def surface_level(self) -> float:
        """The zero level set."""
        return 0.0

    def diagnostics(self) -> dict[str, float]:
        """The s-density's standard deviation 1/s, in metres."""
        return {"deviation_m": float(1 / self.inverse_deviation.detach())}

    @torch.no_grad()
    def _start_as_empty_room(self, generator: torch.Generator) -> None:
        """Set the distance output to that of the bare bounding box seen from inside.

        NeuS starts from a sphere seen from outside, by weights that presume the raw coordinates
        among the inputs; iMAP's embedding has sines alone. The last layer is linear, so the start
        is a least-squares problem with one answer (our choice).
        """
        low = torch.tensor(self.bounds.minimum)
        high = torch.tensor(self.bounds.maximum)
        points = low + (high - low) * torch.rand(8192, 3, generator=generator)
        target = torch.minimum(points - low, high - points).amin(dim=-1)
        features = self.mlp.features(points)
        design = torch.cat([features, torch.ones_like(features[:, :1])], dim=-1).double()
        # A little ridge keeps the weights small where features repeat each other.
        normal = design.T @ design
        normal.diagonal().add_(1e-3 * normal.diagonal().mean())
        moments = design.T @ (target / self.mlp.metres_per_unit).double()
        solution = torch.linalg.solve(normal, moments).float()
        self.mlp.head.weight[3] = solution[:-1]
        self.mlp.head.bias[3] = solution[-1]


def rendered_losses(
    rendering: Rendering, rays: Rays, config: MappingConfig
) -> dict[str, Float[Tensor, ""]]:
    """Weighted L1 errors of rendered depth (m) and colour, over the rays with a measured depth."""
    measured = (rays.depth > 0).float()
    color_error = (rendering.color - rays.color).abs().mean(dim=-1)
    depth_error = (rendering.depth - rays.depth).abs()
    return {
        "depth": config.lambda_depth * measured_mean(depth_error, measured),
        "color": config.lambda_color * measured_mean(color_error, measured),
    }
