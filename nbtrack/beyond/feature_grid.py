"""NeuS+ on grids of features in place of the large network: mapped in a fraction of the time."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from nbtrack.beyond.grid import trilinear
from nbtrack.beyond.neus_plus import NeuSPlusField, NeusPlusMapping
from nbtrack.core.arrays import Colors, Points, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields.mlp import empty_linear
from nbtrack.machinery.settings import limited

_SMALL = 0.01  # standard deviation of features before the first iteration


@dataclass(frozen=True)
class GridNetwork:
    """Features at the vertices of some grids, and the small network that reads them."""

    finest: float = limited(0.12, 0.04, 10.0)  # m, edge of the finest cells
    levels: int = limited(3, 1, 16)  # grids, each twice as coarse as the one before
    features: int = limited(4, 1, 16)  # a vertex
    hidden: int = limited(32, 1, 4096)  # units of the one hidden layer


@dataclass(frozen=True)
class GridPlusMapping(NeusPlusMapping):
    """Mapping of NeuS+ on grids. All chosen in the rooms for tuning (docs/tried.md)."""

    iterations: int = 300
    n_rays: int = limited(96, 1, 65536)
    n_stratified: int = limited(8, 2, 1024)
    n_surface: int = limited(8, 0, 1024)
    n_surface_points: int = limited(1024, 1, 65536)
    learning_rate: float = 0.01
    lambda_eikonal: float = limited(0.0, 0.0, 0.0)  # not tried in grids


class FeatureGrid(nn.Module):
    """Colour logits and one value at points, of features that are interpolated in some grids.

    Source: the dense levels of Instant-NGP (Müller et al. 2022), without its hash table: a room has
    few vertices.
    """

    def __init__(self, settings: GridNetwork, bounds: SceneBounds, generator: Generator) -> None:
        super().__init__()
        self.metres_per_unit = bounds.metres_per_unit
        self.register_buffer(
            "low", torch.tensor(bounds.minimum, dtype=torch.float32), persistent=False
        )
        extent = self.low.new_tensor(bounds.maximum) - self.low
        self.voxels = [settings.finest * 2**level for level in range(settings.levels)]
        shapes = [((extent / voxel).ceil().long() + 1).tolist() for voxel in self.voxels]
        drawn = {"generator": generator, "dtype": torch.float32}
        volumes = [torch.randn(settings.features, *shape, **drawn) for shape in shapes]
        self.volumes = nn.ParameterList(_SMALL * volume for volume in volumes)
        self.layer = empty_linear(settings.levels * settings.features + 3, settings.hidden)
        self.head = empty_linear(settings.hidden, 4)  # colour and value
        for part in (self.layer, self.head):
            nn.init.normal_(part.weight, std=part.in_features**-0.5, generator=generator)
            nn.init.normal_(part.bias, std=0.5, generator=generator)

    def features(self, points_world: Points) -> Float[Tensor, "n hidden"]:
        """Activations of the hidden layer at points (m, world frame)."""
        levels = zip(self.volumes, self.voxels, strict=True)
        inputs = [trilinear(volume, self.low, voxel, points_world).T for volume, voxel in levels]
        inputs.append((points_world - self.low) / self.metres_per_unit - 1)  # about [-1, 1]
        return nn.functional.silu(self.layer(torch.cat(inputs, dim=-1)))

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Raw colour and the raw fourth output, before a field gives them a meaning."""
        color, value = self.head(self.features(points_world)).split([3, 1], dim=1)
        return color, value.squeeze(1)


class GridPlusField(NeuSPlusField):
    """NeuS+ on grids of features. Our choice."""

    name = "grid_plus"
    label = "NeuS+ grid"
    Network = GridNetwork
    Settings = GridPlusMapping

    def make_network(self, settings: GridNetwork, generator: Generator) -> FeatureGrid:
        """The grids, and the small network that reads them."""
        return FeatureGrid(settings, self.bounds, generator)
