"""Volume rendering against values worked by hand, and laws that hold for any ray."""

import math

import pytest
import torch
from torch import Tensor

from nbtrack.fields.rendering import (
    composite,
    importance_depths,
    stratified_depths,
    weights_from_density,
    weights_from_sdf,
)

LN2 = math.log(2.0)
LN3 = math.log(3.0)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def ascending_depths(n_rays: int, n_samples: int, generator: torch.Generator) -> Tensor:
    return (0.1 + torch.rand(n_rays, n_samples, generator=generator)).cumsum(dim=-1)


def test_density_weights_by_hand() -> None:
    """Catches sections that are shifted by one, and transmittance that includes the sample itself.

    Sections are 1, 2 and, repeated, 2 m; times density ln 2: ln 2, 2 ln 2, 0.
    """
    density = torch.tensor([[LN2, LN2, 0.0]])
    depths = torch.tensor([[1.0, 2.0, 4.0]])
    # opacities 1/2, 3/4, 0; light in front 1, 1/2, 1/8
    expected = torch.tensor([[1 / 2, 3 / 8, 0.0]])
    found = weights_from_density(density, depths, torch.tensor([1.0]))
    torch.testing.assert_close(found, expected)
    # twice as long a ray: opacities 3/4, 15/16, 0; light in front 1, 1/4, 1/64
    expected = torch.tensor([[3 / 4, 15 / 64, 0.0]])
    found = weights_from_density(density, depths, torch.tensor([2.0]))
    torch.testing.assert_close(found, expected)


def test_last_sample_stops_light() -> None:
    """Catches a last section of no length, which would let light through a wall at the end."""
    # Section lengths 1, 1; the wall of 3 ln 2 leaves 1/8.
    found = weights_from_density(
        torch.tensor([[0.0, 3 * LN2]]), torch.tensor([[1.0, 2.0]]), torch.tensor([1.0])
    )
    torch.testing.assert_close(found, torch.tensor([[0.0, 7 / 8]]))


def test_sdf_weights_by_hand() -> None:
    """Catches a quotient by the wrong neighbor, and opacity for rays that leave a surface.

    With s = 1 the values ln 3, 0, -ln 3 have Phi = 3/4, 1/2, 1/4. Light starts with Phi = 3/4.
    """
    one = torch.tensor(1.0)
    # alphas (3/4 - 1/2) / (3/4) = 1/3 and (1/2 - 1/4) / (1/2) = 1/2; light in front 3/4, 1/2
    found = weights_from_sdf(torch.tensor([[LN3, 0.0, -LN3]]), one)
    torch.testing.assert_close(found, torch.tensor([[1 / 4, 1 / 4]]))
    # on the way out nothing is seen
    found = weights_from_sdf(torch.tensor([[-LN3, 0.0, LN3]]), one)
    torch.testing.assert_close(found, torch.zeros(1, 2))
    # s = 2 with half the distances is the same
    found = weights_from_sdf(torch.tensor([[LN3, 0.0, -LN3]]) / 2, 2 * one)
    torch.testing.assert_close(found, torch.tensor([[1 / 4, 1 / 4]]))


def test_ray_that_starts_inside_is_dark() -> None:
    """Catches a camera that sees out of a solid: only what is in front of free space counts."""
    weights = weights_from_sdf(torch.tensor([[-0.2, 0.2, -0.2]]), torch.tensor(200.0))
    assert weights.sum().item() < 1e-6


def test_second_surface_is_hidden() -> None:
    """Catches a missing transmittance: behind a wall that is solid for s, nothing has weight."""
    sdf = torch.tensor([[0.2, -0.2, 0.2, -0.2]])
    weights = weights_from_sdf(sdf, torch.tensor(200.0))
    torch.testing.assert_close(weights, torch.tensor([[1.0, 0.0, 0.0]]))


def test_composite_by_hand() -> None:
    """Catches a variance about the wrong mean, and weights that are normalized in secret.

    Depth 1/2 * 1 + 1/4 * 3 = 5/4; variance 1/2 * (1/4)^2 + 1/4 * (7/4)^2 = 51/64.
    """
    rendering = composite(
        torch.tensor([[0.5, 0.25]]),
        torch.tensor([[[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]]]),
        torch.tensor([[1.0, 3.0]]),
    )
    torch.testing.assert_close(rendering.depth, torch.tensor([5 / 4]))
    torch.testing.assert_close(rendering.depth_variance, torch.tensor([51 / 64]))
    torch.testing.assert_close(rendering.color, torch.tensor([[0.5, 0.25, 0.15]]))
    torch.testing.assert_close(rendering.opacity, torch.tensor([0.75]))


def test_weights_are_a_probability(generator: torch.Generator) -> None:
    """Catches negative weights and light made from nothing, for any field."""
    depths = ascending_depths(100, 30, generator)
    density = 50 * torch.rand(100, 30, generator=generator) ** 4
    sdf = torch.randn(100, 30, generator=generator)
    for weights in (
        weights_from_density(density, depths, 1 + torch.rand(100, generator=generator)),
        weights_from_sdf(sdf, torch.tensor(20.0)),
    ):
        assert weights.min() >= 0
        assert weights.sum(dim=-1).max() <= 1 + 1e-5


def test_weights_sum_to_what_is_absorbed(generator: torch.Generator) -> None:
    """Catches lost light: sums telescope to 1 - exp(-optical depth), and to Phi_1 - Phi_n."""
    depths = ascending_depths(50, 20, generator).double()
    density = torch.rand(50, 20, generator=generator).double()
    lengths = 1 + torch.rand(50, generator=generator).double()
    sections = depths.diff(dim=-1)
    sections = torch.cat([sections, sections[:, -1:]], dim=-1) * lengths[:, None]
    total = weights_from_density(density, depths, lengths).sum(dim=-1)
    torch.testing.assert_close(total, 1 - torch.exp(-(density * sections).sum(dim=-1)))
    # NeuS: only for a ray that sinks all the way.
    sdf = -depths / 10
    phi = torch.sigmoid(3.0 * sdf)
    total = weights_from_sdf(sdf, torch.tensor(3.0).double()).sum(dim=-1)
    torch.testing.assert_close(total, phi[:, 0] - phi[:, -1])


def test_density_sees_metres_along_the_ray(generator: torch.Generator) -> None:
    """Catches a forgotten ray length: z-depths d on a ray of length L are metres d L."""
    depths = ascending_depths(20, 10, generator)
    density = torch.rand(20, 10, generator=generator)
    lengths = 1 + torch.rand(20, generator=generator)
    torch.testing.assert_close(
        weights_from_density(density, depths, lengths),
        weights_from_density(density, depths * lengths[:, None], torch.ones(20)),
    )


def test_density_weights_do_not_depend_on_the_sampling() -> None:
    """Catches weights per sample instead of per length: a finer ray through fog stops alike."""

    def expected_depth(n_samples: int) -> Tensor:
        depths = torch.linspace(0, 8, n_samples).double()[None]
        density = torch.full_like(depths, 2.0)
        weights = weights_from_density(density, depths, torch.tensor([1.0]).double())
        return (weights * depths).sum()

    # In fog of density 2/m light goes 1/2 m on average.
    assert expected_depth(4001).item() == pytest.approx(0.5, abs=2e-3)
    assert expected_depth(2001).item() == pytest.approx(0.5, abs=4e-3)


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("deviation", [0.01, 0.05])
def test_sdf_weights_are_unbiased(cosine: float, deviation: float) -> None:
    """Catches NeuS's reason to be: seen at any angle, a plane's rendered depth is the plane.

    Along a ray the distance falls by `cosine` a metre, so the weights are a logistic density
    about the plane, of scale deviation / cosine.
    """
    reach = 18 * deviation / cosine
    depths = torch.linspace(2.0 - reach, 2.0 + reach, 400).double()[None]
    sdf = cosine * (2.0 - depths)
    weights = weights_from_sdf(sdf, torch.tensor(1 / deviation).double())
    middles = (depths[:, 1:] + depths[:, :-1]) / 2
    rendering = composite(weights, torch.ones(1, 399, 3).double(), middles)
    assert rendering.opacity.item() == pytest.approx(1, abs=1e-6)
    assert rendering.depth.item() == pytest.approx(2.0, abs=1e-5)
    # A logistic density's variance is (pi scale)^2 / 3.
    variance = (math.pi * deviation / cosine) ** 2 / 3
    assert rendering.depth_variance.item() == pytest.approx(variance, rel=1e-2)


def test_sdf_weights_peak_at_the_zero_crossing(generator: torch.Generator) -> None:
    """Catches weights that peak before the surface, as those of naive densities do."""
    depths = ascending_depths(200, 40, generator)
    surface = depths[:, 5] + torch.rand(200, generator=generator) * (depths[:, -2] - depths[:, 5])
    sdf = surface[:, None] - depths
    peak = weights_from_sdf(sdf, torch.tensor(30.0)).argmax(dim=-1)
    crossing = (sdf > 0).sum(dim=-1) - 1
    assert torch.equal(peak, crossing)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_extreme_values_stay_finite(scale: float, generator: torch.Generator) -> None:
    """Catches 0/0 deep inside objects and overflow in walls, in values and in gradients."""
    depths = ascending_depths(20, 12, generator)
    sdf = (scale * torch.randn(20, 12, generator=generator)).requires_grad_()
    inverse_deviation = torch.tensor(1000.0, requires_grad=True)
    density = (scale * 1e3 * torch.rand(20, 12, generator=generator)).requires_grad_()
    weights = weights_from_sdf(sdf, inverse_deviation)
    middles = (depths[:, 1:] + depths[:, :-1]) / 2
    walls = weights_from_density(density, depths, torch.ones(20))
    ((weights * middles).sum() + (walls * depths).sum()).backward()
    for tensor in (weights, walls, sdf.grad, inverse_deviation.grad, density.grad):
        assert torch.isfinite(tensor).all()


def test_gradients_match_finite_differences(generator: torch.Generator) -> None:
    """Catches a detached or clamped path between a field and what is rendered of it."""
    depths = ascending_depths(3, 6, generator).double()
    sdf = (2.0 - depths).requires_grad_()
    density = torch.rand(3, 6, generator=generator).double().requires_grad_()
    steepness = torch.tensor(3.0).double().requires_grad_()
    lengths = torch.tensor([1.0, 1.1, 1.2]).double()
    assert torch.autograd.gradcheck(weights_from_sdf, (sdf, steepness))
    assert torch.autograd.gradcheck(
        lambda values: weights_from_density(values, depths, lengths), (density,)
    )


def test_stratified_depths_by_hand() -> None:
    """Catches parts that are counted from zero instead of `near`: halves of [1, 3] and [1, 9]."""
    found = stratified_depths(1.0, torch.tensor([3.0, 9.0]), 2)
    torch.testing.assert_close(found, torch.tensor([[1.5, 2.5], [3.0, 7.0]]))


def test_stratified_depths_one_in_each_part(generator: torch.Generator) -> None:
    """Catches independent draws, and the same offset for all rays or parts."""
    far = 1 + 4 * torch.rand(50, generator=generator)
    depths = stratified_depths(0.5, far, 16, generator)
    parts = (depths - 0.5) / (far[:, None] - 0.5) * 16
    offsets = parts - torch.arange(16)
    assert offsets.min() > -1e-5
    assert offsets.max() < 1 + 1e-5
    assert offsets.mean().item() == pytest.approx(0.5, abs=0.05)
    assert offsets.std().item() == pytest.approx(1 / math.sqrt(12), abs=0.03)


def test_importance_depths_by_hand() -> None:
    """Catches cells that are off by one: all weight of sample 2 is between 1.5 and 2.5."""
    depths = torch.tensor([[1.0, 2.0, 3.0]])
    found = importance_depths(depths, torch.tensor([[0.0, 1.0, 0.0]]), 4)
    # levels 1/8, 3/8, 5/8, 7/8 of the cell
    expected = torch.tensor([[1.625, 1.875, 2.125, 2.375]])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)
    # Half the weight in the first cell [1, 1.5], half in the last [2.5, 3].
    found = importance_depths(depths, torch.tensor([[1.0, 0.0, 1.0]]), 4)
    expected = torch.tensor([[1.125, 1.375, 2.625, 2.875]])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)


def test_importance_depths_follow_the_weights(generator: torch.Generator) -> None:
    """Catches inverse sampling that is biased: counts in cells go with the weights."""
    depths = torch.linspace(1, 5, 9)[None]
    weights = torch.tensor([[0.0, 0.1, 0.0, 0.2, 0.4, 0.0, 0.3, 0.0, 0.0]])
    found = importance_depths(depths, weights, 20_000, generator)
    borders = torch.cat([depths[:, :1], (depths[:, 1:] + depths[:, :-1]) / 2, depths[:, -1:]], -1)
    counts = torch.histogram(found[0], borders[0]).hist / 20_000
    torch.testing.assert_close(counts, weights[0], rtol=0, atol=2e-3)


def test_importance_depths_of_empty_rays_are_even(generator: torch.Generator) -> None:
    """Catches 0/0 for a ray without weight, and samples outside the first pass."""
    depths = torch.linspace(1, 5, 9).expand(4, 9)
    found = importance_depths(depths, torch.zeros(4, 9), 32, generator)
    assert torch.isfinite(found).all()
    assert found.min() >= 1
    assert found.max() <= 5
    # The end cells are half as long and get the same share.
    inner = ((found > 1.25) & (found < 4.75)).float().mean().item()
    assert inner == pytest.approx(7 / 9, abs=0.03)
