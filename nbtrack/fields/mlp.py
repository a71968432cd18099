"""The network that both fields share: iMAP's multilayer perceptron."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig


class FourierMlp(nn.Module):
    """Four hidden layers on 93 learnable sines; position in, colour logits and one value out.

    The embedding is sin(B x) with B learnable, drawn from a Gaussian, sine only; it enters once
    more beside the input of the third layer. At full size (256 wide) it has 246,555 parameters.

    Source: Sucar et al. 2021 (iMAP); paper, implementation details ("the same network
    architecture as iMAP for both methods"). iMAP scales coordinates by 1/10; here the scene's own
    size normalises them, while the frequencies are drawn per metre, so that detail has one size in
    rooms of any size (our choice).
    """

    def __init__(
        self,
        config: FieldConfig,
        bounds: SceneBounds,
        activation: Callable[[Tensor], Tensor],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        width, n_frequencies = config.width, config.n_frequencies
        self.activation = activation
        self.register_buffer("center", torch.tensor(bounds.center, dtype=torch.float32))
        self.metres_per_unit = bounds.metres_per_unit
        frequencies = torch.randn(3, n_frequencies, generator=generator)
        sigma = config.embedding_sigma * self.metres_per_unit
        self.frequencies = nn.Parameter(sigma * frequencies)
        self.layer_1 = _linear(n_frequencies, width, generator)
        self.layer_2 = _linear(width, width, generator)
        self.layer_3 = _linear(width + n_frequencies, width, generator)
        self.layer_4 = _linear(width, width, generator)
        self.head = _linear(width, 4, generator)

    def features(self, points_world: Float[Tensor, "n 3"]) -> Float[Tensor, "n width"]:
        """Activations of the last hidden layer at points (m, world frame)."""
        normalized = (points_world - self.center) / self.metres_per_unit
        embedding = torch.sin(normalized @ self.frequencies)
        hidden = self.activation(self.layer_1(embedding))
        hidden = self.activation(self.layer_2(hidden))
        hidden = self.activation(self.layer_3(torch.cat([hidden, embedding], dim=-1)))
        return self.activation(self.layer_4(hidden))

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Raw colour and the raw fourth output, before a field gives them a meaning."""
        raw = self.head(self.features(points_world))
        return raw[:, :3], raw[:, 3]


def _linear(n_in: int, n_out: int, generator: torch.Generator) -> nn.Linear:
    """Kaiming-uniform weights for a rectifier and zero bias, drawn from a generator of our own."""
    layer = nn.Linear(n_in, n_out)
    bound = math.sqrt(6.0 / n_in)
    with torch.no_grad():
        layer.weight.copy_((2 * torch.rand(n_out, n_in, generator=generator) - 1) * bound)
        layer.bias.zero_()
    return layer
