"""VolSDF: a signed distance, rendered through a density (Yariv et al. 2021)."""

import torch

from nbtrack.core.arrays import RayColors, RaySamples, Scalar
from nbtrack.data.pixels import Rays
from nbtrack.fields.neus import NeuSField
from nbtrack.fields.rendering import Rendering, composite, weights_from_density


class VolSdfField(NeuSField):
    """f: position -> (colour, signed distance in m), as NeuS but for what a ray makes of it.

    Network, start, samples and losses are NeuS's, and so is the one learnable scale, here
    beta = exp(-10 variance) in m: the two maps differ in one equation alone (our choice; VolSDF
    places its samples by a bound on the error of the integral).
    """

    name = "volsdf"
    label = "VolSDF"

    def composite(
        self, colors: RayColors, values: RaySamples, rays: Rays, depths: RaySamples
    ) -> Rendering:
        """Volume rendering from the density that belongs to the signed distance."""
        density = density_from_sdf(values, self.inverse_std)
        weights = weights_from_density(density, depths, rays.directions_world.norm(dim=-1))
        return composite(weights, colors, depths)


def density_from_sdf(sdf: RaySamples, inverse_scale: Scalar) -> RaySamples:
    """density = Psi(-d) / beta, with Psi the cumulative function of Laplace's distribution.

    Of the signed distance d (m, positive in free space) and 1 / beta (1/m): half of 1 / beta on the
    surface, all of it inside, and exp(-d / beta) / (2 beta) outside.
    Source: Yariv et al. 2021 (VolSDF), Eq. 2 and 3, with their alpha = 1 / beta.
    """
    tail = torch.exp(-inverse_scale * sdf.abs()) / 2
    return inverse_scale * torch.where(sdf < 0, 1 - tail, tail)
