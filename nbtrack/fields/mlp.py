"""The network that all fields share: iMAP's multilayer perceptron."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from nbtrack.core.arrays import Colors, Points, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.machinery.settings import limited

_LAYER_SIZE = 2**18  # numbers in a layer's output that a core's cache can hold: 1 MB


@dataclass(frozen=True)
class NetworkSettings:
    """Sizes of the network that all fields share."""

    width: int = limited(256, 1, 4096)  # units of each hidden layer (iMAP)
    n_frequencies: int = limited(93, 1, 4096)  # learnable sines of the embedding (iMAP)
    # Standard deviation (rad/m) from which the sines' initial frequencies are drawn. iMAP has the
    # same 2.5: it uses 25 on coordinates scaled by 1/10.
    embedding_sigma: float = 2.5


class FourierMlp(nn.Module):
    """Maps positions to colour logits and one value: learnable sines, then four hidden layers.

    The embedding is sin(B x), where the learnable B is drawn from a Gaussian. It is concatenated
    once more to the input of the third layer. With the default settings the network has 246,555
    parameters. Source: Sucar et al. 2021 (iMAP); paper, implementation details.

    iMAP scales coordinates by 1/10. Here they are divided by the unit of the scene, while
    frequencies are drawn per metre, so that details have the same size in rooms of any size (our
    choice).
    """

    def __init__(
        self, settings: NetworkSettings, bounds: SceneBounds, act: Callable, generator: Generator
    ) -> None:
        """Draw the weights with `generator`; `act` is the activation of all hidden layers."""
        super().__init__()
        width, n_frequencies = settings.width, settings.n_frequencies
        self.activation = act
        self.register_buffer("center", torch.tensor(bounds.center, dtype=torch.float32))
        self.metres_per_unit = bounds.metres_per_unit
        sigma = settings.embedding_sigma * self.metres_per_unit  # rad per unit of the map
        drawn = torch.randn(3, n_frequencies, generator=generator, dtype=torch.float32)
        self.frequencies = nn.Parameter(sigma * drawn)
        self.layer_1 = _linear(n_frequencies, width, generator)
        self.layer_2 = _linear(width, width, generator)
        self.layer_3 = _linear(width + n_frequencies, width, generator)
        self.layer_4 = _linear(width, width, generator)
        self.head = _linear(width, 4, generator)  # colour and value

    def features(self, points_world: Points) -> Float[Tensor, "n width"]:
        """Activations of the last hidden layer at points (m, world frame)."""
        normalized = (points_world - self.center) / self.metres_per_unit
        embedding = torch.sin(normalized @ self.frequencies)
        hidden = self.activation(self.layer_1(embedding))
        hidden = self.activation(self.layer_2(hidden))
        hidden = self.activation(self.layer_3(torch.cat([hidden, embedding], dim=1)))
        return self.activation(self.layer_4(hidden))

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Colour logits and raw values at points (m, world frame); fields give them a meaning."""
        # On the CPU a finished network takes the points in parts, whose layers fit the cache: value
        # and gradient of 16,384 points cost 273 ms instead of 369 (256 wide, one busy core).
        is_whole = self.head.weight.requires_grad or points_world.is_cuda
        n_at_once = max(1, len(points_world) if is_whole else _LAYER_SIZE // self.head.in_features)
        parts = [self.head(self.features(part)) for part in points_world.split(n_at_once)]
        raw = torch.cat(parts) if len(parts) > 1 else parts[0]
        color, value = raw.split([3, 1], dim=1)
        return color, value.squeeze(1)


def _linear(n_in: int, n_out: int, generator: Generator) -> nn.Linear:
    """A layer with zero bias and random weights: Kaiming-uniform, as for a rectifier."""
    layer = empty_linear(n_in, n_out)
    with torch.no_grad():
        drawn = torch.rand(n_out, n_in, generator=generator, dtype=torch.float32)
        layer.weight.copy_((2 * drawn - 1) * math.sqrt(6.0 / n_in))
        layer.bias.zero_()
    return layer


def empty_linear(n_in: int, n_out: int) -> nn.Linear:
    """A layer with uninitialised weights: PyTorch would draw them from its global generator."""
    return nn.utils.skip_init(nn.Linear, n_in, n_out, dtype=torch.float32)
