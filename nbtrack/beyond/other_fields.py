"""Fields that differ from iMAP or NeuS in the rendering weights alone: occupancy and VolSDF."""

import torch

from nbtrack.core.arrays import Colors, Points, RaySamples, Scalar, Values
from nbtrack.data.pixels import Rays
from nbtrack.fields import IMapField, NeuSField
from nbtrack.fields.rendering import Weights, weights_from_density


class OccupancyField(IMapField):
    """f: position -> (colour, occupancy in [0, 1]), rendered with weights from occupancies.

    Occupancy is the probability that a place is occupied (as in UNISURF and NICE-SLAM). Network,
    samples and losses are iMAP's, so that the two maps differ in one equation alone (our choice).
    """

    name = "occupancy"
    label = "Occupancy"
    value_label = "occupancy"
    surface_level = 0.5  # (UNISURF)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour and occupancy, both in [0, 1]."""
        raw_color, raw_occupancy = self.mlp(points_world)
        return torch.sigmoid(raw_color), torch.sigmoid(raw_occupancy)

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Rendering weights of samples, from their occupancies."""
        return weights_from_occupancy(values)


class VolSdfField(NeuSField):
    """f: position -> (colour, signed distance in m), rendered with weights from a density.

    The density is computed from the signed distance. Network, initialisation, samples, losses and
    the one learnable scale are those of NeuS, so that the two maps differ in one equation alone
    (our choice; VolSDF itself places its samples by a bound on the error of the integral). The
    scale is here beta = exp(-10 variance) in m. Source: Yariv et al. 2021.
    """

    name = "volsdf"
    label = "VolSDF"

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Rendering weights of samples, from the densities of their signed distances."""
        density = density_from_sdf(values, self.inverse_std)
        return weights_from_density(density, depths, rays.directions_world.norm(dim=1))


def density_from_sdf(sdf: RaySamples, inverse_scale: Scalar) -> RaySamples:
    """density = Psi(-d) / beta (1/m), with Psi the cumulative Laplace distribution of scale beta.

    `sdf` is the signed distance d (m, positive in free space), and `inverse_scale` is 1 / beta
    (1/m). The density is 1 / (2 beta) on the surface, approaches 1 / beta inside, and is
    exp(-d / beta) / (2 beta) outside.
    Source: Yariv et al. 2021 (VolSDF), Eq. 2 and 3, with their alpha = 1 / beta.
    """
    tail = torch.exp(-inverse_scale * sdf.abs()) / 2
    return inverse_scale * torch.where(sdf < 0, 1 - tail, tail)


def weights_from_occupancy(occupancy: RaySamples) -> RaySamples:
    """Probabilities w_i = o_i prod_{j<i} (1 - o_j) that a ray ends at its i-th sample.

    Unlike weights from a density they do not depend on the distances between samples. For example a
    quarter of a ray passes two samples of occupancy 1/2, however near they are.
    Source: Oechsle et al. 2021 (UNISURF), Sec. 3; Zhu et al. 2022 (NICE-SLAM), Sec. 3.2.
    """
    passed = torch.cat([torch.ones_like(occupancy[:, :1]), 1 - occupancy[:, :-1]], dim=1)
    return occupancy * passed.cumprod(dim=1)
