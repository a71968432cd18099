"""Other fields on iMAP's network: occupancy, and VolSDF's density of a signed distance."""

import torch

from nbtrack.core.arrays import Colors, Points, RaySamples, Values
from nbtrack.data.pixels import Rays
from nbtrack.fields import IMapField, NeuSField, rendering
from nbtrack.fields.rendering import Weights


class OccupancyField(IMapField):
    """f: position -> (colour, occupancy in [0, 1]), as iMAP but for what a ray makes of it.

    Occupancy is the probability that a place is taken (as in UNISURF and NICE-SLAM). Network,
    samples and losses are iMAP's (our choice: the two maps differ in one equation alone).
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
        """Weights of samples, from their occupancies."""
        return rendering.weights_from_occupancy(values)


class VolSdfField(NeuSField):
    """f: position -> (colour, signed distance in m), as NeuS but for what a ray makes of it.

    A signed distance, rendered through a density. Network, start, samples and losses are NeuS's,
    and so is the one learnable scale, here beta = exp(-10 variance) in m: the two maps differ in
    one equation alone (our choice; VolSDF places its samples by a bound on the error of the
    integral). Source: Yariv et al. 2021.
    """

    name = "volsdf"
    label = "VolSDF"

    def weights(self, values: RaySamples, rays: Rays, depths: RaySamples) -> Weights:
        """Weights of samples, from the density that belongs to the signed distance."""
        density = rendering.density_from_sdf(values, self.inverse_std)
        lengths = rays.directions_world.norm(dim=-1)
        return rendering.weights_from_density(density, depths, lengths)
