"""The learned fields: the network, NeuS's start, exact gradients, and losses that stay finite."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.data.pixels import Rays
from nbtrack.fields import NetworkSettings, NeusMapping, make_field
from nbtrack.fields.base import MIN_STD, measured_mean, rendered_losses
from nbtrack.fields.rendering import Rendering

ROOM = SceneBounds((-1.0, -1.2, 0.5), (3.0, 1.3, 3.7))  # 4 x 2.5 x 3.2 m
SMALL = NetworkSettings(width=64)
SETTINGS = NeusMapping(n_stratified=8, n_surface=4)
ALL = pytest.mark.parametrize("name", ["imap", "neus", "volsdf", "occupancy"])


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def points_inside(bounds: SceneBounds, n: int, margin: float = 0.0) -> Tensor:
    low, high = torch.tensor(bounds.minimum) + margin, torch.tensor(bounds.maximum) - margin
    return low + (high - low) * torch.rand(n, 3, generator=seeded(1))


def random_rays(n_rays: int, depth: float) -> Rays:
    generator = seeded(2)
    directions = torch.randn(n_rays, 3, generator=generator)
    directions = directions / directions.abs().amax(dim=-1, keepdim=True)
    origins = torch.tensor([1.0, 0.0, 2.0]).expand(n_rays, 3)
    colors = torch.rand(n_rays, 3, generator=generator)
    return Rays(origins, directions, colors, torch.full((n_rays,), depth))


@ALL
def test_the_start(name: str) -> None:
    """Catches weights drawn from the global generator, a layer too many or a lost bias: the paper's
    network, and one more for a distance."""
    first = make_field(name, SMALL, ROOM, seed=4).state_dict()
    torch.manual_seed(99)
    again = make_field(name, SMALL, ROOM, seed=4).state_dict()
    other = make_field(name, SMALL, ROOM, seed=5).state_dict()
    assert all(torch.equal(value, again[key]) for key, value in first.items())
    assert not torch.equal(first["mlp.head.weight"], other["mlp.head.weight"])
    n_layers = (93 + 1) * 256, (256 + 1) * 256, (256 + 93 + 1) * 256, (256 + 1) * 256
    field = make_field(name, NetworkSettings(), ROOM, seed=0)
    n_parameters = sum(p.numel() for p in field.parameters() if p.requires_grad)
    assert n_parameters == 3 * 93 + sum(n_layers) + (256 + 1) * 4 + field.is_distance


@ALL
def test_scene_of_twice_the_size(name: str) -> None:
    """Catches coordinates in metres inside the network, and answers out of range: the same weights,
    in a scene twice as large and elsewhere, give the same colours, and twice the distances."""
    shift = torch.tensor([5.0, -3.0, 1.0])
    corners = (2 * torch.tensor([ROOM.minimum, ROOM.maximum]) + shift).tolist()
    small = make_field(name, SMALL, ROOM, seed=0)
    large = make_field(name, SMALL, SceneBounds(*map(tuple, corners)), seed=0)
    large.load_state_dict(small.state_dict() | {"mlp.center": large.mlp.center})
    points = points_inside(ROOM, 100)
    color, value = small(points)
    large_color, large_value = large(2 * points + shift)
    factor = 2 if small.is_distance else 1
    torch.testing.assert_close(large_color, color, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(large_value, factor * value, rtol=1e-3, atol=5e-3)
    assert 0 <= color.min() <= color.max() <= 1
    assert small.is_distance or value.min() >= 0
    assert name != "occupancy" or value.max() <= 1


@pytest.mark.parametrize("seed", [0, 1])
def test_neus_starts_as_an_empty_room(seed: int) -> None:
    """Catches a start flat or inside out, with walls at once, or at a distance from some walls.

    At 3 rad per half room, low enough for the network to hold the box's smooth distance.
    """
    network = NetworkSettings(embedding_sigma=3.0 / ROOM.metres_per_unit)
    field, points = make_field("neus", network, ROOM, seed), points_inside(ROOM, 2000)
    low, high = torch.tensor(ROOM.minimum), torch.tensor(ROOM.maximum)
    sdf, distance = field(points)[1], torch.minimum(points - low, high - points).amin(dim=1)
    excess = sdf - distance
    assert (sdf > 0).float().mean() > 0.9
    assert (excess - excess.median()).abs().mean() < 0.15
    assert torch.corrcoef(torch.stack([sdf, distance]))[0, 1] > 0.75


@ALL
def test_losses_are_finite_and_fall(name: str) -> None:
    """Catches 0/0 in a batch without a single measurement, a term that trains nothing, a sign, an
    eikonal term without second derivatives or a detached head: forty steps on the same rays must
    fit them better."""
    field, totals = make_field(name, SMALL, ROOM, seed=0), []
    optimizer = torch.optim.Adam(field.parameters(), lr=2e-3)
    for depth in (0.0, *[0.8] * 40):
        rays = random_rays(50, depth)
        terms = field.mapping_losses(lambda n_rays, rays=rays: rays, SETTINGS, seeded(3))
        assert all(0 <= term < torch.inf and term.requires_grad for term in terms.values())
        assert depth or terms["depth"] == terms["color"] == 0
        optimizer.zero_grad()
        totals.append(sum(terms.values()))
        totals[-1].backward()
        gradients = [parameter.grad for parameter in field.parameters()]
        assert all(torch.isfinite(g).all() for g in gradients if g is not None)
        optimizer.step()
    assert all(gradient is not None for gradient in gradients)
    assert totals[-1] < 0.8 * totals[1]


def test_rendered_losses_by_hand() -> None:
    """Catches the variance for the deviation, a sum over channels, and rays that do not count.
    Ray 1: |1.5 - 1| / sqrt(0.25) = 1; ray 2: the deviation 0 is raised to the least allowed,
    |2 - 1.9| / 0.02 = 5; ray 3 has no depth. Colors: mean 0.2 and 0.4, then five times; twice in
    NeuS, with depth errors 0.5 and 0.1 m.
    """
    rendering = Rendering(
        color=torch.tensor([[0.3, 0.5, 0.7], [0.4, 0.4, 0.4], [1.0, 1.0, 1.0]]),
        depth=torch.tensor([1.5, 2.0, 3.0]),
        depth_variance=torch.tensor([0.25, 0.0, 1.0], requires_grad=True),
        weights=torch.ones(3, 1),
        depths=torch.ones(3, 1),
    )
    color = torch.tensor([[0.1, 0.3, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    rays = replace(random_rays(3, 1.0), depth=torch.tensor([1.0, 1.9, 0.0]), color=color)
    terms = rendered_losses(rendering, rays, 5.0, 1.0, over_std=True)
    assert MIN_STD == 0.02
    assert terms["depth"].item() == pytest.approx((1 + 5) / 2, rel=1e-4)
    assert terms["color"].item() == pytest.approx(5 * (0.2 + 0.4) / 2, rel=1e-4)
    of_neus = rendered_losses(rendering, rays, 2.0, 1.0)
    assert list(map(float, of_neus.values())) == pytest.approx([0.3, 0.6], rel=1e-4)
    assert not terms["depth"].requires_grad  # the deviation is a weight, not something to enlarge
    assert measured_mean(torch.ones(3), torch.zeros(3)).item() == 0
