"""NeuS: colour and signed distance on iMAP's network (Wang et al. 2021)."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from nbtrack.core.arrays import Colors, Points, RaySamples, Scalar, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.fields import base
from nbtrack.fields.base import Draw, LearnedField, Losses, rendered_losses
from nbtrack.fields.mlp import FourierMlp, NetworkSettings
from nbtrack.fields.rendering import Weights, stratified_samples, weights_from_sdf
from nbtrack.machinery.settings import limited


@dataclass(frozen=True)
class NeusMapping(base.MappingSettings):
    """Settings of mapping with NeuS, whose samples are guided by the measured depth."""

    lambda_color: float = 2.0  # beside depth errors in metres, which are not divided by a std
    surface_band: float = 0.15  # m, half width of the region around the measured depth
    lambda_depth: float = 1.0  # per metre
    lambda_eikonal: float = 0.5  # five times that of NeuS: rooms are mostly empty
    # Share of the samples at which the eikonal loss is computed: neighbours have similar gradients.
    eikonal_share: float = limited(0.25, 0.0, 1.0)


class NeuSField(LearnedField):
    """f: position -> (colour, signed distance in m, positive in free space). Paper, Sec. II-A.

    It has one parameter more than iMAP, `variance`. s = exp(10 variance), in 1/m, is the inverse
    standard deviation of the s-density (NeuS, published code). The activation is SiLU, whose
    gradients are continuous.
    """

    name = "neus"
    label = "NeuS"
    surface_level = 0.0
    Settings = NeusMapping

    def __init__(self, network: NetworkSettings, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__(bounds)
        self.mlp = self.make_network(network, generator)
        # The initial value of NeuS's published code: s = 20 / m.
        self.variance = nn.Parameter(torch.tensor(0.3, dtype=torch.float32))
        self._start_as_empty_room(generator)

    def make_network(self, settings: NetworkSettings, generator: Generator) -> nn.Module:
        """The network of raw colours and values: a linear `head` on its `features`."""
        return FourierMlp(settings, self.bounds, nn.functional.silu, generator)

    @property
    def inverse_std(self) -> Scalar:
        """The inverse standard deviation s (1/m) of the s-density."""
        return torch.exp(10 * self.variance)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour in [0, 1] and signed distance (m)."""
        raw_color, raw_sdf = self.mlp(points_world)
        return torch.sigmoid(raw_color), raw_sdf * self.mlp.metres_per_unit

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Probabilities that rays end in the sections between their samples."""
        return weights_from_sdf(values, self.inverse_std)

    def mapping_losses(self, draw: Draw, settings: NeusMapping, generator: Generator) -> Losses:
        """L1 losses of colour and depth, and the eikonal loss (NeuS's, with a depth loss added)."""
        rays = draw(settings.n_rays)
        depths = guided_depths(rays, self.bounds, settings, generator)
        rendered = self.render(rays, depths)
        losses = rendered_losses(rendered, rays, settings.lambda_color, settings.lambda_depth)
        return losses | {"eikonal": self._eikonal(rays.points(depths), settings, generator)}

    def _eikonal(self, points_world: Tensor, settings: NeusMapping, generator: Generator) -> Scalar:
        """The eikonal loss: lambda_eikonal times the mean of (|grad f| - 1)^2.

        It is computed at a random share of the samples of rays (rays x samples x 3, m, world).
        """
        flat = points_world.flatten(0, 1)
        n_points = max(1, round(settings.eikonal_share * len(flat)))
        chosen = torch.randint(len(flat), (n_points,), generator=generator, device=flat.device)
        points = flat[chosen].requires_grad_()
        _, sdf = self(points)
        (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=True)
        return settings.lambda_eikonal * (gradient.norm(dim=1) - 1).square().mean()

    def diagnostics(self) -> dict[str, float]:
        """The standard deviation 1/s (m) of the s-density, as `std_m`."""
        return {"std_m": float(1 / self.inverse_std.detach())}

    @torch.no_grad()
    def _start_as_empty_room(self, generator: Generator) -> None:
        """Set the last layer so that the initial distance is that of the empty bounding box.

        NeuS starts with the distance from a sphere, by weights that need raw coordinates among the
        inputs. Here the last layer, which is linear, is fitted by least squares at random points in
        the box to the distance from its nearest face (our choice).
        """
        low, high = torch.tensor([self.bounds.minimum, self.bounds.maximum], dtype=torch.float32)
        drawn = torch.rand(8192, 3, generator=generator, dtype=torch.float32)
        points = low + (high - low) * drawn  # m, world frame, uniform in the box
        target = torch.minimum(points - low, high - points).amin(dim=1)  # m, to the nearest face
        features = self.mlp.features(points)
        design = torch.cat([features, torch.ones_like(features[:, :1])], dim=1).double()
        # A small ridge keeps weights small where features are nearly linearly dependent.
        normal_matrix = design.T @ design
        normal_matrix.diagonal().add_(1e-3 * normal_matrix.diagonal().mean())
        moments = design.T @ (target / self.mlp.metres_per_unit).double()
        solution = torch.linalg.solve(normal_matrix, moments).float()
        # The head's outputs 0 to 2 are the colour, output 3 is the distance.
        self.mlp.head.weight[3] = solution[:-1]
        self.mlp.head.bias[3] = solution[-1]


def guided_depths(
    rays: Rays, bounds: SceneBounds, settings: NeusMapping, generator: Generator
) -> RaySamples:
    """Ascending z-depths (m) of samples, which the measured depth guides.

    `n_stratified` samples lie between the camera and just behind the measured surface, and
    `n_surface` more around it. None lies farther behind, since what is there is unknown. On rays
    without a measured depth the end of the scene takes the place of the surface. Our choice;
    NICE-SLAM and its followers do the same.
    """
    far_bound = base.rays_end(rays, bounds)
    is_measured = rays.depth > 0
    far = torch.where(is_measured, rays.depth + settings.surface_band, far_bound)
    coarse = stratified_samples(base.NEAR, far, settings.n_stratified, generator)
    # Values from -1 to 1, in half widths of the band around the surface.
    offsets = stratified_samples(-1.0, torch.ones_like(far), settings.n_surface, generator)
    center = torch.where(is_measured, rays.depth, far_bound)
    around = (center[:, None] + settings.surface_band * offsets).clamp_min(base.NEAR)
    return torch.cat([coarse, around], dim=1).sort().values
