"""Occupancy: colour and the probability that a place is taken (as in UNISURF and NICE-SLAM)."""

import torch

from nbtrack.core.arrays import Colors, Points, RayColors, RaySamples, Values
from nbtrack.data.pixels import Rays
from nbtrack.fields.imap import IMapField
from nbtrack.fields.rendering import Rendering, composite


class OccupancyField(IMapField):
    """f: position -> (colour, occupancy in [0, 1]), as iMAP but for what a ray makes of it.

    Network, samples and losses are iMAP's (our choice: the two maps differ in one equation alone).
    """

    name = "occupancy"
    label = "Occupancy"
    surface_level = 0.5  # (UNISURF)

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour and occupancy, both in [0, 1]."""
        raw_color, raw_occupancy = self.mlp(points_world)
        return torch.sigmoid(raw_color), torch.sigmoid(raw_occupancy)

    def composite(
        self, colors: RayColors, values: RaySamples, rays: Rays, depths: RaySamples
    ) -> Rendering:
        """Volume rendering from occupancy."""
        return composite(weights_from_occupancy(values), colors, depths)


def weights_from_occupancy(occupancy: RaySamples) -> RaySamples:
    """Probabilities w_i = o_i prod_{j<i} (1 - o_j) that a ray ends at its i-th sample.

    Unlike a density's they do not know how far samples lie apart: of two samples in a half-taken
    place the ray passes a quarter, however near they are.
    Source: Oechsle et al. 2021 (UNISURF), Sec. 3; Zhu et al. 2022 (NICE-SLAM), Sec. 3.2.
    """
    passed = torch.cat([torch.ones_like(occupancy[:, :1]), 1 - occupancy[:, :-1]], dim=-1)
    return occupancy * passed.cumprod(dim=-1)
