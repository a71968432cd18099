"""Both fields: the network's size, NeuS's start, exact gradients, and losses that stay finite."""

import itertools
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, MappingConfig
from nbtrack.core.errors import ConfigError
from nbtrack.data.pixels import Rays
from nbtrack.fields import FIELDS, LearnedField, field_class, make_field
from nbtrack.fields.base import Batch, measured_mean
from nbtrack.fields.imap import LEAST_DEVIATION, rendering_losses
from nbtrack.fields.rendering import Rendering
from nbtrack.fields.sampling import guided_depths

ROOM = SceneBounds((-1.0, -1.2, 0.5), (3.0, 1.3, 3.7))  # 4 x 2.5 x 3.2 m
SMALL = FieldConfig(width=64)
CONFIG = MappingConfig(n_stratified=8, n_surface=4)
BOTH = pytest.mark.parametrize("name", ["imap", "neus"])


def points_inside(bounds: SceneBounds, n: int, margin: float = 0.0) -> Tensor:
    low, high = torch.tensor(bounds.minimum) + margin, torch.tensor(bounds.maximum) - margin
    return low + (high - low) * torch.rand(n, 3, generator=torch.Generator().manual_seed(1))


def distance_to_walls(bounds: SceneBounds, points: Tensor) -> Tensor:
    low, high = torch.tensor(bounds.minimum), torch.tensor(bounds.maximum)
    return torch.minimum(points - low, high - points).amin(dim=-1)


def random_rays(n_rays: int, depth: float) -> Rays:
    generator = torch.Generator().manual_seed(2)
    directions = torch.randn(n_rays, 3, generator=generator)
    directions = directions / directions.abs().amax(dim=-1, keepdim=True)
    origins = torch.tensor([1.0, 0.0, 2.0]).expand(n_rays, 3)
    colors = torch.rand(n_rays, 3, generator=generator)
    return Rays(origins, directions, colors, torch.full((n_rays,), depth))


def losses(field: LearnedField, rays: Rays) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    depths = guided_depths(rays, ROOM, CONFIG, generator)
    return field.mapping_losses(Batch(rays, depths), CONFIG, generator)


@pytest.mark.parametrize(("name", "expected"), [("imap", 246_555), ("neus", 246_556)])
def test_number_of_parameters(name: str, expected: int) -> None:
    """Catches a layer too many or a lost bias: the paper's network, and NeuS's one more.

    Frequencies 3 * 93; layers (93 + 1) * 256, (256 + 1) * 256, (256 + 93 + 1) * 256,
    (256 + 1) * 256; head (256 + 1) * 4: together 246,555.
    """
    field = make_field(name, FieldConfig(), ROOM, seed=0)
    assert sum(p.numel() for p in field.parameters() if p.requires_grad) == expected


@BOTH
def test_seed_decides_the_start(name: str) -> None:
    """Catches weights drawn from the global generator."""
    first = make_field(name, SMALL, ROOM, seed=4).state_dict()
    torch.manual_seed(99)
    again = make_field(name, SMALL, ROOM, seed=4).state_dict()
    other = make_field(name, SMALL, ROOM, seed=5).state_dict()
    for key, value in first.items():
        assert torch.equal(value, again[key])
    assert not torch.equal(first["mlp.head.weight"], other["mlp.head.weight"])


@BOTH
def test_ranges(name: str) -> None:
    """Catches colors outside [0, 1] and negative densities."""
    color, value = make_field(name, SMALL, ROOM, seed=0)(points_inside(ROOM, 500))
    assert color.shape == (500, 3)
    assert value.shape == (500,)
    assert 0 <= color.min() <= color.max() <= 1
    if name == "imap":
        assert value.min() >= 0


@BOTH
def test_scene_of_twice_the_size(name: str) -> None:
    """Catches coordinates in metres inside the network: the same weights, in a scene twice as
    large and elsewhere, give the same colors, twice the distances and the same densities."""
    shift = torch.tensor([5.0, -3.0, 1.0])
    large_room = SceneBounds(
        tuple((2 * torch.tensor(ROOM.minimum) + shift).tolist()),
        tuple((2 * torch.tensor(ROOM.maximum) + shift).tolist()),
    )
    small = make_field(name, SMALL, ROOM, seed=0)
    large = make_field(name, SMALL, large_room, seed=0)
    weights = small.state_dict() | {"mlp.center": large.mlp.center}
    large.load_state_dict(weights)
    points = points_inside(ROOM, 100)
    color, value = small(points)
    large_color, large_value = large(2 * points + shift)
    torch.testing.assert_close(large_color, color, rtol=1e-3, atol=1e-3)
    factor = 2 if name == "neus" else 1
    torch.testing.assert_close(large_value, factor * value, rtol=1e-3, atol=5e-3)


@pytest.mark.parametrize("sigma", [3.0, 12.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_neus_starts_in_free_space(sigma: float, seed: int) -> None:
    """Catches a start inside out: cameras would see walls at once.

    The distance may be larger than the box's by a constant, so that the walls start outside.
    """
    field = make_field("neus", replace(SMALL, embedding_sigma=sigma), ROOM, seed)
    points = points_inside(ROOM, 2000, margin=0.1)
    sdf = field(points)[1]
    assert (sdf > 0).float().mean() > 0.95
    assert -0.15 < (sdf - distance_to_walls(ROOM, points)).median() < 0.7


@pytest.mark.parametrize("seed", [0, 1])
def test_neus_starts_as_an_empty_room(seed: int) -> None:
    """Catches a flat start, or gradients out of the room: distance rises inward from all walls.

    Checked with 3 rad per half room, low enough for the network to hold the box's smooth distance.
    """
    field = make_field("neus", FieldConfig(embedding_sigma=3.0 / ROOM.metres_per_unit), ROOM, seed)
    points = points_inside(ROOM, 2000)
    sdf, distance = field(points)[1], distance_to_walls(ROOM, points)
    excess = sdf - distance
    assert (excess - excess.median()).abs().mean() < 0.15
    assert torch.corrcoef(torch.stack([sdf, distance]))[0, 1] > 0.75
    half = torch.tensor([2.0, 1.25, 1.6])
    generator = torch.Generator().manual_seed(0)
    for axis, side in itertools.product(range(3), (-1, 1)):
        offsets = 0.3 * half * (2 * torch.rand(300, 3, generator=generator) - 1)
        offsets[:, axis] = side * (half[axis] - 0.2)
        _, gradient = field.sdf_gradient(torch.tensor(ROOM.center).float() + offsets)
        assert (-side * gradient[:, axis]).mean() > 0.3


def test_sdf_gradient_matches_finite_differences() -> None:
    """Catches a gradient per normalized unit instead of per metre."""
    field = make_field("neus", SMALL, ROOM, seed=0).double()
    points = points_inside(ROOM, 20).double()
    sdf, gradient = field.sdf_gradient(points)
    torch.testing.assert_close(sdf, field(points)[1])
    step = 1e-5 * torch.eye(3).double()
    expected = torch.stack(
        [(field(points + s)[1] - field(points - s)[1]) / 2e-5 for s in step], dim=-1
    )
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-6)


def test_sdf_gradient_without_and_with_a_graph() -> None:
    """Catches an eikonal term without second derivatives, and trackers that fail in no_grad."""
    field = make_field("neus", SMALL, ROOM, seed=0)
    with torch.no_grad():
        assert not field.sdf_gradient(points_inside(ROOM, 5))[1].requires_grad
    gradient = field.sdf_gradient(points_inside(ROOM, 5), create_graph=True)[1]
    gradient.square().sum().backward()
    assert field.mlp.layer_1.weight.grad.abs().max() > 0


@BOTH
@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_losses_and_their_gradients_are_finite(name: str, depth: float) -> None:
    """Catches 0/0 in a batch without a single measurement, and a term that trains nothing."""
    field = make_field(name, SMALL, ROOM, seed=0)
    terms = losses(field, random_rays(30, depth))
    assert set(terms) >= {"depth", "color"}
    for term in terms.values():
        assert torch.isfinite(term)
        assert term >= 0
    if depth == 0:
        assert terms["depth"] == terms["color"] == 0
    torch.stack(list(terms.values())).sum().backward()
    for parameter in field.parameters():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all()
    if depth > 0:
        assert all(parameter.grad is not None for parameter in field.parameters())


@BOTH
def test_rays_without_depth_do_not_count(name: str) -> None:
    """Catches a mean over all rays, or missing depths taken for surfaces at the camera."""
    field = make_field(name, SMALL, ROOM, seed=0)
    rays = random_rays(30, 1.0)
    depths = guided_depths(rays, ROOM, CONFIG, torch.Generator().manual_seed(0))
    measured = torch.arange(30) < 10

    def terms(chosen: Tensor, depth: Tensor) -> dict[str, Tensor]:
        some = Rays(
            rays.origins_world[chosen], rays.directions_world[chosen], rays.color[chosen],
            depth[chosen],
        )  # fmt: skip
        batch = Batch(some, depths[chosen])
        return field.mapping_losses(batch, CONFIG, torch.Generator().manual_seed(0))

    mixed = terms(torch.ones(30, dtype=torch.bool), torch.where(measured, rays.depth, 0.0))
    alone = terms(measured, rays.depth)
    for key in ("depth", "color"):
        torch.testing.assert_close(mixed[key], alone[key])


@BOTH
def test_few_steps_lower_the_losses(name: str) -> None:
    """Catches a sign or a detached head: eighty steps on one batch must fit it better."""
    field = make_field(name, SMALL, ROOM, seed=0)
    optimizer = torch.optim.Adam(field.parameters(), lr=2e-3)
    rays = random_rays(60, 0.8)
    totals = []
    for _ in range(80):
        total = torch.stack(list(losses(field, rays).values())).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < 0.8 * totals[0]


@BOTH
def test_rendered_sizes(name: str) -> None:
    """Catches samples and sections mixed up, and a pose that gets no gradient."""
    field = make_field(name, SMALL, ROOM, seed=0)
    rays = random_rays(7, 1.0)
    origins = rays.origins_world.clone().requires_grad_()
    depths = torch.linspace(0.1, 1.2, 9).expand(7, 9)
    rendering = field.render(replace(rays, origins_world=origins), depths)
    assert rendering.weights.shape == (7, 9 if name == "imap" else 8)
    assert rendering.color.shape == (7, 3)
    assert rendering.opacity.max() <= 1 + 1e-5
    rendering.depth.sum().backward()
    assert origins.grad.abs().max() > 0


def test_imap_losses_by_hand() -> None:
    """Catches the variance for the deviation, a sum over channels, and rays that do not count.

    Ray 1: |1.5 - 1| / sqrt(0.25) = 1; ray 2: the deviation 0 is raised to the least allowed,
    |2 - 1.9| / 0.02 = 5; ray 3 has no depth. Colors: mean 0.2 and 0.4, then five times.
    """
    rendering = Rendering(
        color=torch.tensor([[0.3, 0.5, 0.7], [0.4, 0.4, 0.4], [1.0, 1.0, 1.0]]),
        depth=torch.tensor([1.5, 2.0, 3.0]),
        depth_variance=torch.tensor([0.25, 0.0, 1.0], requires_grad=True),
        opacity=torch.ones(3),
        weights=torch.ones(3, 1),
    )
    color = torch.tensor([[0.1, 0.3, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    depth = torch.tensor([1.0, 1.9, 0.0])
    rays = replace(random_rays(3, 1.0), depth=depth, color=color)
    terms = rendering_losses(rendering, rays, 5.0)
    assert LEAST_DEVIATION == 0.02
    assert terms["depth"].item() == pytest.approx((1 + 5) / 2, rel=1e-4)
    assert terms["color"].item() == pytest.approx(5 * (0.2 + 0.4) / 2, rel=1e-4)
    assert not terms["depth"].requires_grad  # the deviation is a weight, not something to enlarge


def test_measured_mean() -> None:
    """Catches a mean over all rays and 0/0 where nothing is measured."""
    error = torch.tensor([1.0, 2.0, 9.0])
    assert measured_mean(error, torch.tensor([1.0, 1.0, 0.0])).item() == 1.5
    assert measured_mean(error, torch.zeros(3)).item() == 0


def test_ray_points_by_hand() -> None:
    """Catches depths taken for lengths: the direction is not normalized."""
    rays = random_rays(1, 1.0)
    rays = replace(
        rays, origins_world=torch.tensor([[1.0, 2.0, 3.0]]),
        directions_world=torch.tensor([[0.0, 2.0, 1.0]]),
    )  # fmt: skip
    found = rays.points(torch.tensor([[0.0, 2.0]]))
    torch.testing.assert_close(found, torch.tensor([[[1.0, 2.0, 3.0], [1.0, 6.0, 5.0]]]))


def test_registry() -> None:
    """Catches a field that is not found by its name, and a name that is silently replaced."""
    assert {"imap", "neus"} <= set(FIELDS)
    for name, registered in FIELDS.items():
        assert registered.name == name
        assert field_class(name) is registered
        assert isinstance(registered.label, str)
    with pytest.raises(ConfigError, match="unknown field 'nues': did you mean 'neus'"):
        field_class("nues")
