"""NeuS: colour and signed distance on iMAP's network (Wang et al. 2021)."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from nbtrack.core.arrays import Colors, Points, RaySamples, Scalar, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.fields import base, rendering
from nbtrack.fields.base import Draw, LearnedField, Losses, rendered_losses
from nbtrack.fields.mlp import FourierMlp, NetworkSettings
from nbtrack.fields.rendering import Weights
from nbtrack.machinery.settings import limited


@dataclass(frozen=True)
class NeusMapping(base.MappingSettings):
    """Mapping of NeuS: of a distance, which the measured depth guides."""

    lambda_color: float = 2.0  # beside depth errors in metres
    surface_band: float = 0.15  # half width of the region around the measured depth, m
    lambda_depth: float = 1.0  # per metre
    lambda_eikonal: float = 0.5  # five times the method's own: rooms are mostly empty
    # Share of the samples that the eikonal term looks at: on neighbouring samples it is alike.
    eikonal_share: float = limited(0.25, 0.0, 1.0)


class NeuSField(LearnedField):
    """f: position -> (colour, signed distance in m, positive in free space). Paper, Sec. II-A.

    One parameter more than iMAP: `variance`, with s = exp(10 variance) in 1/m, the inverse
    standard deviation of the s-density (NeuS, published code). SiLU gives continuous gradients.
    """

    name = "neus"
    label = "NeuS"
    surface_level = 0.0
    Settings = NeusMapping

    def __init__(self, network: NetworkSettings, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__(bounds)
        self.mlp = self.make_network(network, generator)
        # As NeuS's code starts: s = 20 / m.
        self.variance = nn.Parameter(torch.tensor(0.3, dtype=torch.float32))
        self._start_as_empty_room(generator)

    def make_network(self, settings: NetworkSettings, generator: Generator) -> nn.Module:
        """What answers points with raw colours and values; its `head` reads its `features`."""
        return FourierMlp(settings, self.bounds, nn.functional.silu, generator)

    @property
    def inverse_std(self) -> Scalar:
        """s (1/m)."""
        return torch.exp(10 * self.variance)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and signed distance (m)."""
        raw_color, raw_sdf = self.mlp(points_world)
        return torch.sigmoid(raw_color), raw_sdf * self.mlp.metres_per_unit

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Weights of the sections between samples."""
        return rendering.weights_from_sdf(values, self.inverse_std)

    def mapping_losses(self, draw: Draw, settings: NeusMapping, generator: Generator) -> Losses:
        """Colour L1, depth L1 and the eikonal term (NeuS, Eq. 15, with RGB-D's depth added)."""
        rays = draw(settings.n_rays)
        depths = guided_depths(rays, self.bounds, settings, generator)
        rendered = self.render(rays, depths)
        losses = rendered_losses(rendered, rays, settings.lambda_color, settings.lambda_depth)
        return losses | {"eikonal": self._eikonal(rays.points(depths), settings, generator)}

    def _eikonal(self, points_world: Tensor, settings: NeusMapping, generator: Generator) -> Scalar:
        """Weighted mean (|grad f| - 1)^2 over a share of the ray samples, drawn anew every time."""
        flat = points_world.flatten(0, 1)
        n_points = max(1, round(settings.eikonal_share * len(flat)))
        chosen = torch.randint(len(flat), (n_points,), generator=generator, device=flat.device)
        points = flat[chosen].requires_grad_()
        _, sdf = self(points)
        (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=True)
        return settings.lambda_eikonal * (gradient.norm(dim=1) - 1).square().mean()

    def diagnostics(self) -> dict[str, float]:
        """The s-density's standard deviation 1/s, in metres."""
        return {"std_m": float(1 / self.inverse_std.detach())}

    @torch.no_grad()
    def _start_as_empty_room(self, generator: Generator) -> None:
        """Set the distance output to that of the bare bounding box seen from inside.

        NeuS starts from a sphere, by weights that presume raw coordinates among the inputs. The
        last layer is linear: the start is a least-squares problem with one answer (our choice).
        """
        single = {"dtype": torch.float32}
        low, high = (torch.tensor(c, **single) for c in (self.bounds.minimum, self.bounds.maximum))
        # m, in the box
        points = low + (high - low) * torch.rand(8192, 3, generator=generator, **single)
        target = torch.minimum(points - low, high - points).amin(dim=1)  # m, to the nearest face
        features = self.mlp.features(points)
        design = torch.cat([features, torch.ones_like(features[:, :1])], dim=1).double()
        # A little ridge keeps the weights small where features repeat each other.
        normal_matrix = design.T @ design
        normal_matrix.diagonal().add_(1e-3 * normal_matrix.diagonal().mean())
        moments = design.T @ (target / self.mlp.metres_per_unit).double()
        solution = torch.linalg.solve(normal_matrix, moments).float()
        # Of the head's outputs the first three are the colour, the last is the distance.
        self.mlp.head.weight[3] = solution[:-1]
        self.mlp.head.bias[3] = solution[-1]


def guided_depths(
    rays: Rays, bounds: SceneBounds, settings: NeusMapping, generator: Generator
) -> RaySamples:
    """Stratified z-depths (m) up to just behind the measured surface, and more around it.

    Nothing is known of what lies behind a surface, so no samples are spent there. Rays without a
    depth are sampled to the end of the scene. Our choice; NICE-SLAM and its followers do alike.
    """
    far_bound = base.rays_end(rays, bounds)
    measured = rays.depth > 0
    far = torch.where(measured, rays.depth + settings.surface_band, far_bound)
    coarse = rendering.stratified_depths(base.NEAR, far, settings.n_stratified, generator)
    # From -1 to 1, in half widths of the band around the surface.
    offsets = rendering.stratified_depths(-1.0, torch.ones_like(far), settings.n_surface, generator)
    center = torch.where(measured, rays.depth, far_bound)
    around = (center[:, None] + settings.surface_band * offsets).clamp_min(base.NEAR)
    return torch.cat([coarse, around], dim=1).sort(dim=1).values
