"""The baked field: exact where trilinear interpolation is, bounded elsewhere."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.errors import ConfigError
from nbtrack.fields import FIELDS, Field
from nbtrack.fields import grid as baking
from nbtrack.fields.base import LUMA
from nbtrack.fields.grid import BakedField, bake_field

BOX = SceneBounds((-0.5, -0.25, 0.25), (0.55, 0.5, 1.0))  # x is no multiple of VOXEL
VOXEL = 0.125  # exact in binary, as all corners' coordinates are
SLOPE = torch.tensor([0.3, -0.7, 0.2])


class Formula(Field):
    """A value by formula, and a colour that differs per channel and axis, in [0, 1] in BOX."""

    name = "formula"
    label = "Formula"
    surface_level = 0.25

    def __init__(self, value: Callable[[Tensor], Tensor], bounds: SceneBounds = BOX) -> None:
        super().__init__(bounds)
        self.value = value

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        mix = torch.tensor([[0.2, 0.0, 0.1], [0.0, 0.3, 0.1], [-0.1, 0.1, 0.2]])
        return 0.4 + points_world @ mix, self.value(points_world)


def linear(points: Tensor) -> Tensor:
    return points @ SLOPE.to(points) + 0.1


def product(points: Tensor) -> Tensor:
    return points.prod(dim=-1)


def wavy(points: Tensor) -> Tensor:
    return torch.sin(7 * points).sum(dim=-1) + product(points)


def sphere(points: Tensor) -> Tensor:
    return 2.0 - (points - torch.tensor([0.0, 0.1, 2.5])).norm(dim=-1)


def points_inside(n: int, beyond: float = 0.0) -> Tensor:
    """Random points in BOX, stretched by `beyond` metres at either end."""
    low, high = torch.tensor(BOX.minimum) - beyond, torch.tensor(BOX.maximum) + beyond
    return low + (high - low) * torch.rand(n, 3, generator=torch.Generator().manual_seed(1))


def autograd_gradients(field: Field, points: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of value and intensity through `forward`."""
    points = points.clone().requires_grad_()
    color, value = field(points)
    intensity = color @ LUMA.to(color)
    (of_value,) = torch.autograd.grad(value.sum(), points, retain_graph=True)
    (of_intensity,) = torch.autograd.grad(intensity.sum(), points)
    return of_value, of_intensity


def test_linear_field_is_reproduced() -> None:
    """Catches swapped axes or channels, a shifted origin and gradients per cell, not per metre:
    interpolation of a linear function is exact everywhere, and its gradient constant."""
    source = Formula(linear)
    points = points_inside(500)
    baked, exact = bake_field(source, VOXEL), source.linearize(points)
    color, value = baked(points)
    found = baked.linearize(points)
    torch.testing.assert_close(color, source(points)[0])
    torch.testing.assert_close(value, linear(points))
    for name in ("value", "value_gradient", "intensity", "intensity_gradient"):
        wanted = getattr(exact, name)
        torch.testing.assert_close(getattr(found, name), wanted, atol=5e-6, rtol=0)


def test_product_in_the_middle_of_a_cell() -> None:
    """Catches a wrong corner, or a mixed term dropped: x y z is trilinear, so it is exact both
    at vertices and between, and so are its derivatives yz, xz and xy.

    By hand: (1/4, 1/8, 1/2) is a vertex, with value 1/64. (3/16, 3/16, 9/16) is the middle of a
    cell, with value 81/4096 and derivatives 27/256, 27/256 and 9/256.
    """
    baked = bake_field(Formula(product), VOXEL)
    vertex, middle = [0.25, 0.125, 0.5], [3 / 16, 3 / 16, 9 / 16]
    found = baked.linearize(torch.tensor([vertex, middle]))
    torch.testing.assert_close(found.value, torch.tensor([1 / 64, 81 / 4096]))
    expected = torch.tensor([27 / 256, 27 / 256, 9 / 256])
    torch.testing.assert_close(found.value_gradient[1], expected)


def test_vertices_keep_their_samples() -> None:
    """Catches interpolation that smooths: at vertices the field's own value is returned."""
    source = Formula(wavy)
    low = torch.tensor(BOX.minimum)
    points = low + VOXEL * torch.randint(0, 6, (50, 3)).float()
    color, value = bake_field(source, VOXEL)(points)
    torch.testing.assert_close(color, source(points)[0])
    torch.testing.assert_close(value, wavy(points))


def test_gradient_against_finite_differences() -> None:
    """Catches the gradient of something else than the interpolant, as of the field itself.

    Along an axis the interpolant of a cell is linear, so central differences are exact up to
    rounding: double precision, steps of a hundredth of a cell, no point nearer to a border.
    """
    baked = bake_field(Formula(wavy), VOXEL).double()
    cells = torch.randint(0, 6, (200, 3), generator=torch.Generator().manual_seed(2))
    within = torch.rand(200, 3, generator=torch.Generator().manual_seed(3)).double()
    points = torch.tensor(BOX.minimum).double() + VOXEL * (cells + 0.05 + 0.9 * within)
    found = baked.linearize(points)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = VOXEL / 100
        after, before = baked.linearize(points + step), baked.linearize(points - step)
        for name in ("value", "intensity"):
            slope = (getattr(after, name) - getattr(before, name)) / (VOXEL / 50)
            gradient = getattr(found, f"{name}_gradient")[:, axis]
            torch.testing.assert_close(slope, gradient, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("beyond", [0.0, 1.0])
def test_forward_and_linearize_agree(beyond: float) -> None:
    """Catches two interpolants: trackers by autograd and by `linearize` must see the same map,
    inside and, where each axis is clamped, outside."""
    baked = bake_field(Formula(wavy), VOXEL)
    points = points_inside(500, beyond)
    color, value = baked(points)
    found = baked.linearize(points)
    torch.testing.assert_close(value, found.value)
    torch.testing.assert_close(color @ LUMA, found.intensity)
    of_value, of_intensity = autograd_gradients(baked, points)
    torch.testing.assert_close(of_value, found.value_gradient, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(of_intensity, found.intensity_gradient, rtol=1e-4, atol=1e-4)


def test_linearize_leaves_no_graph() -> None:
    """Catches a graph that second-order trackers would drag from step to step."""
    found = bake_field(Formula(linear), VOXEL).linearize(points_inside(3).requires_grad_())
    assert not found.value.requires_grad
    assert not found.intensity_gradient.requires_grad


def test_outside_is_clamped_to_the_border() -> None:
    """Catches extrapolation, wrapped indices, and a slope along an axis that is clamped.

    The grid reaches one cell beyond BOX: x from -0.625 to 0.625 + 0.125 (its vertices overshoot
    0.55), z from 0.125 to 1.125.
    """
    baked = bake_field(Formula(linear), VOXEL)
    far = torch.tensor([[-50.0, 0.1, 0.5], [50.0, 0.1, 0.5], [0.1, 0.1, 50.0], [9.0, 9.0, 9.0]])
    border = torch.tensor(
        [[-0.625, 0.1, 0.5], [0.75, 0.1, 0.5], [0.1, 0.1, 1.125], [0.75, 0.625, 1.125]]
    )
    found = baked.linearize(far)
    torch.testing.assert_close(found.value, linear(border))
    torch.testing.assert_close(baked(far)[0], Formula(linear)(border)[0])
    is_inside = far == border
    torch.testing.assert_close(found.value_gradient, SLOPE * is_inside, atol=5e-6, rtol=0)


def test_points_that_are_no_numbers() -> None:
    """Catches an index error: a pose that diverged shows in its loss, as with networks."""
    baked = bake_field(Formula(linear), VOXEL)
    points = torch.tensor([[float("nan"), 0.1, 0.5], [0.1, 0.1, 0.5]])
    found = baked.linearize(points)
    assert found.value.isnan().tolist() == [True, False]
    assert baked(points)[1].isnan().tolist() == [True, False]


def test_no_points() -> None:
    """Catches a view that cannot infer its shape when every pixel lacks a depth."""
    baked = bake_field(Formula(linear), VOXEL)
    assert baked.linearize(torch.zeros(0, 3)).value_gradient.shape == (0, 3)
    assert baked(torch.zeros(0, 3))[0].shape == (0, 3)


def test_baked_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a part lost or repeated where the vertices are sampled some at a time."""
    whole = bake_field(Formula(wavy), VOXEL)
    monkeypatch.setattr(baking, "_POINTS_AT_ONCE", 37)
    parts = bake_field(Formula(wavy), VOXEL)
    assert torch.equal(whole.cells, parts.cells)
    assert torch.equal(whole.color, parts.color)


@pytest.mark.parametrize("voxel", [0.1, 0.05])
def test_error_of_a_distance_field(voxel: float) -> None:
    """Catches half a voxel of shift, which no error of second order could hide.

    Per axis linear interpolation errs by at most voxel^2 / 8 times the second derivative; those
    of a distance to a centre sum to 2 / distance. In BOX it is at least 1.5 m.
    """
    points = points_inside(2000)
    found = bake_field(Formula(sphere), voxel).linearize(points)
    error = (found.value - sphere(points)).abs().max()
    assert error < 1.1 * voxel**2 / 8 * 2 / 1.4
    # A slope errs by half a cell times the second derivatives, each at most 1 / distance.
    exact = Formula(sphere).linearize(points).value_gradient
    assert (found.value_gradient - exact).abs().max() < 1.5 * voxel / 1.4


def test_what_is_taken_from_the_source() -> None:
    """Catches a bake that forgets its field's bounds, label or level, that trains, or that the
    command line offers as a map."""
    baked = bake_field(Formula(linear), VOXEL)
    assert isinstance(baked, BakedField)
    assert (baked.name, baked.label, baked.surface_level) == ("baked", "Formula baked", 0.25)
    assert baked.bounds == BOX
    assert list(baked.parameters()) == []
    assert not any(buffer.requires_grad for buffer in baked.buffers())
    assert "baked" not in FIELDS


def test_memory_of_a_room() -> None:
    """Catches a layout too large for a laptop: 8 x 5 x 3 m at 4 cm has (200 + 3) (125 + 3)
    (75 + 3) vertices or, by rounding, one more along an axis, of 76 bytes: 154 MB of 200."""
    room = SceneBounds((-4.0, -2.5, 0.0), (4.0, 2.5, 3.0))
    baked = bake_field(Formula(linear, room), 0.04)
    assert 203 * 128 * 78 * 76 <= baked.n_bytes < 160e6


def test_whole_number_as_voxel() -> None:
    """Catches an annotation or division that refuses 1 for 1.0."""
    assert bake_field(Formula(linear), 1).n_vertices == (5, 4, 4)


@pytest.mark.parametrize("voxel", [0, 0.0, -0.04, float("nan"), float("inf")])
def test_voxel_that_is_no_length(voxel: float) -> None:
    """Catches a division by zero, or an endless grid, where a line should say what to do."""
    with pytest.raises(ConfigError, match=r"voxel is .* m: .* positive length; set") as error:
        bake_field(Formula(linear), voxel)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("voxel", [0.002, 1e-300])
def test_grid_that_is_too_large(voxel: float) -> None:
    """Catches memory taken before it is counted, and advice that does not help."""

    def never(points: Tensor) -> Tensor:
        raise AssertionError("sampled before the size was checked")

    with pytest.raises(ConfigError, match=r"allowed is 1 GB; set .* m or more") as error:
        bake_field(Formula(never), voxel)
    message = str(error.value)
    assert "\n" not in message
    advice = float(message.split("; set ")[1].split(" m")[0])
    baking._checked_size(Formula(never), advice)  # must not raise
