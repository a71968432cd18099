"""Volume rendering against values worked by hand, and laws that hold for any ray."""

import math

import pytest
import torch
from torch import Tensor

from nbtrack.beyond.other_fields import density_from_sdf, weights_from_occupancy
from nbtrack.fields.rendering import (
    composite,
    importance_depths,
    stratified_samples,
    weights_from_density,
    weights_from_sdf,
)

LN2 = math.log(2.0)


def ascending_depths(n_rays: int, n_samples: int, generator: torch.Generator) -> Tensor:
    return (0.1 + torch.rand(n_rays, n_samples, generator=generator)).cumsum(dim=-1)


def middles(depths: Tensor) -> Tensor:
    return (depths[:, 1:] + depths[:, :-1]) / 2


def ends(opacities: Tensor, light: Tensor) -> Tensor:
    """Where the light ends that comes to the first part of each ray: part after part."""
    found = []
    for opacity in opacities.T:
        found.append(light * opacity)
        light = light * (1 - opacity)
    return torch.stack(found, dim=1)


def random_rays(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Depths, values of both signs and lengths of rays, in double precision."""
    depths, lengths = ascending_depths(40, 6, generator), 1 + torch.rand(40, generator=generator)
    values = torch.randn(40, 6, generator=generator)
    return depths.double(), values.double(), lengths.double()


def test_weights_are_products(generator: torch.Generator) -> None:
    """Catches sections that are shifted by one, transmittance that includes the part itself, a
    forgotten ray length, a last section of no length, which would let light through a wall; a
    quotient by the wrong neighbour, opacity for rays that leave a surface, a camera that sees out
    of a solid; and gradients that are detached, clamped or lost behind what is taken."""
    depths, values, lengths = random_rays(generator)
    steps = torch.cat([depths[:, 1:] - depths[:, :-1], depths[:, -1:] - depths[:, -2:-1]], dim=1)
    whole = torch.ones(40).double()
    expected = ends(1 - torch.exp(-values.abs() * steps * lengths[:, None]), whole)
    torch.testing.assert_close(weights_from_density(values.abs(), depths, lengths), expected)
    passes = 1 / (1 + torch.exp(-3 * values))
    opacities = (1 - passes[:, 1:] / passes[:, :-1]).clamp(0)
    found = weights_from_sdf(values, torch.tensor(3.0).double())
    torch.testing.assert_close(found, ends(opacities, passes[:, 0]))
    taken = values.abs().clamp(0.0, 1.0)  # of some all
    torch.testing.assert_close(weights_from_occupancy(taken), ends(taken, whole))
    sdf = values[:3].requires_grad_(), torch.tensor(3.0).double().requires_grad_()
    density = (1 + values[:3].abs()).detach().requires_grad_()
    assert torch.autograd.gradcheck(weights_from_sdf, sdf)
    assert torch.autograd.gradcheck(weights_from_density, (density, depths[:3], lengths[:3]))
    assert torch.autograd.gradcheck(weights_from_occupancy, taken.detach()[:9].requires_grad_())


def test_density_of_a_distance_by_hand() -> None:
    """Catches a sign, a factor and a scale: with 1/beta = 2 the tail e^(-2 |d|) / 2 is 1/2, 1/4 and
    1/4 at d = 0, ln 2 / 2 and -ln 2 / 2, and times 2, from inside 1 less it; and gradients that are
    lost, or no numbers, far from the surface."""
    sdf = torch.tensor([[0.0, LN2 / 2, -LN2 / 2, 1e4, -1e4]], requires_grad=True)
    found = density_from_sdf(sdf, torch.tensor(2.0))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.5, 1.5, 0.0, 2.0]]))
    found.sum().backward()
    torch.testing.assert_close(sdf.grad[0, 1:], torch.tensor([-1.0, -1.0, 0.0, 0.0]))


def test_composite_by_hand() -> None:
    """Catches a variance about the wrong mean, and weights that are normalized in secret.

    Depth 1/2 * 1 + 1/4 * 3 = 5/4; variance 1/2 * (1/4)^2 + 1/4 * (7/4)^2 = 51/64.
    """
    colors = torch.tensor([[[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]]])
    rendering = composite(torch.tensor([[0.5, 0.25]]), colors, torch.tensor([[1.0, 3.0]]))
    torch.testing.assert_close(rendering.depth, torch.tensor([5 / 4]))
    torch.testing.assert_close(rendering.depth_variance, torch.tensor([51 / 64]))
    torch.testing.assert_close(rendering.color, torch.tensor([[0.5, 0.25, 0.15]]))


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("deviation", [0.01, 0.05])
def test_sdf_weights_are_unbiased(cosine: float, deviation: float) -> None:
    """Catches NeuS's reason to be: seen at any angle, a plane's rendered depth is the plane.

    Along a ray the distance falls by `cosine` a metre, so the weights are a logistic density
    about the plane, of scale deviation / cosine and variance (pi scale)^2 / 3.
    """
    reach = 18 * deviation / cosine
    depths = torch.linspace(2.0 - reach, 2.0 + reach, 400).double()[None]
    weights = weights_from_sdf(cosine * (2.0 - depths), torch.tensor(1 / deviation).double())
    rendering = composite(weights, torch.ones(1, 399, 3).double(), middles(depths))
    assert rendering.weights.sum().item() == pytest.approx(1, abs=1e-6)
    assert rendering.depth.item() == pytest.approx(2.0, abs=1e-5)
    variance = (math.pi * deviation / cosine) ** 2 / 3
    assert rendering.depth_variance.item() == pytest.approx(variance, rel=1e-2)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_extreme_values_stay_finite(scale: float, generator: torch.Generator) -> None:
    """Catches 0/0 deep inside objects and overflow in walls, in values and in gradients; negative
    weights, and light made from nothing."""
    depths = ascending_depths(20, 12, generator)
    sdf = (scale * torch.randn(20, 12, generator=generator)).requires_grad_()
    steepness = torch.tensor(1000.0, requires_grad=True)
    density = (scale * 1e3 * torch.rand(20, 12, generator=generator)).requires_grad_()
    weights = weights_from_sdf(sdf, steepness)
    walls = weights_from_density(density, depths, torch.ones(20))
    for absorbed in (weights, walls):
        assert absorbed.min() >= 0
        assert absorbed.sum(dim=-1).max() <= 1 + 1e-5
    ((weights * middles(depths)).sum() + (walls * depths).sum()).backward()
    for tensor in (weights, walls, sdf.grad, steepness.grad, density.grad):
        assert torch.isfinite(tensor).all()


def test_stratified_samples(generator: torch.Generator) -> None:
    """Catches parts counted from zero instead of `near` (halves of [1, 3] and [1, 9]), independent
    draws, and the same offset for all rays or parts."""
    found = stratified_samples(1.0, torch.tensor([3.0, 9.0]), 2)
    torch.testing.assert_close(found, torch.tensor([[1.5, 2.5], [3.0, 7.0]]))
    far = 1 + 4 * torch.rand(50, generator=generator)
    parts = (stratified_samples(0.5, far, 16, generator) - 0.5) / (far[:, None] - 0.5) * 16
    offsets = parts - torch.arange(16)
    assert -1e-5 < offsets.min() < offsets.max() < 1 + 1e-5
    assert offsets.mean().item() == pytest.approx(0.5, abs=0.05)
    assert offsets.std().item() == pytest.approx(1 / math.sqrt(12), abs=0.03)


CELLS = [
    ([0.0, 1.0, 0.0], [1.625, 1.875, 2.125, 2.375]),  # levels 1/8, 3/8, 5/8, 7/8 of [1.5, 2.5]
    ([1.0, 0.0, 1.0], [1.125, 1.375, 2.625, 2.875]),  # half in [1, 1.5], half in [2.5, 3]
    # Nothing seen: a third of the samples in each cell, though the end cells are half as long.
    ([0.0, 0.0, 0.0], [1.1875, 1.625, 2.375, 2.8125]),
]


@pytest.mark.parametrize(("weights", "expected"), CELLS)
def test_importance_depths_by_hand(weights, expected) -> None:
    """Catches cells that are off by one, and 0/0 for a ray without weight."""
    found = importance_depths(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([weights]), 4)
    torch.testing.assert_close(found, torch.tensor([expected]), rtol=0, atol=1e-3)
