"""The baked field: exact where trilinear interpolation is, bounded elsewhere."""

import pytest
import torch
from box_room import Formula
from test_fields import points_inside

from nbtrack.beyond import grid
from nbtrack.beyond.grid import BakedField
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields import FIELDS
from nbtrack.machinery.errors import ConfigError

BOX = SceneBounds((-0.5, -0.25, 0.25), (0.55, 0.5, 1.0))  # x is no multiple of VOXEL
VOXEL = 0.125  # exact in binary, as all corners' coordinates are
SLOPE = torch.tensor([0.3, -0.7, 0.2])
MIX = torch.tensor([[0.2, 0.0, 0.1], [0.0, 0.3, 0.1], [-0.1, 0.1, 0.2]])


def formula(value) -> Formula:
    """With a colour that differs per channel and axis, in [0, 1] in BOX."""
    return Formula(value, BOX, lambda points: 0.4 + points @ MIX)


def linear(points):
    return points @ SLOPE + 0.1


def with_gradient(field: Formula | BakedField, points):
    """The value at points, and its gradient."""
    points = points.clone().requires_grad_()
    value = field(points)[1]
    return value.detach(), torch.autograd.grad(value.sum(), points)[0]


@pytest.mark.parametrize("value", [linear, lambda points: points.prod(dim=-1)])
def test_trilinear_functions_are_reproduced(value) -> None:
    """Catches swapped axes or channels, a shifted origin, gradients per cell, not per metre,
    interpolation that smooths, a wrong corner, or a mixed term dropped: a linear function and x y z
    are trilinear, so that they and their gradients are exact everywhere."""
    source, points = formula(value), points_inside(BOX, 500)
    baked = BakedField(source, VOXEL)
    torch.testing.assert_close(baked(points)[0], source(points)[0])
    answers = zip(with_gradient(baked, points), with_gradient(source, points), strict=True)
    for found, exact in answers:
        torch.testing.assert_close(found, exact, atol=5e-6, rtol=0)


def test_outside_is_clamped_to_the_border() -> None:
    """Catches extrapolation, wrapped indices, a slope along an axis that is clamped, and an index
    error where a pose diverged (it shows in its loss, as with networks) or no pixel has a depth.

    The grid reaches one cell beyond BOX: x from -0.625 to 0.625 + 0.125 (its vertices overshoot
    0.55), z from 0.125 to 1.125.
    """
    baked = BakedField(formula(linear), VOXEL)
    far = torch.tensor([[-50.0, 0.1, 0.5], [50.0, 0.1, 0.5], [0.1, 0.1, 50.0], [9.0, 9.0, 9.0]])
    low, high = torch.tensor([-0.625, -0.375, 0.125]), torch.tensor([0.75, 0.625, 1.125])
    border, (value, gradient) = far.clamp(low, high), with_gradient(baked, far)
    torch.testing.assert_close(value, linear(border))
    torch.testing.assert_close(baked(far)[0], formula(linear)(border)[0])
    torch.testing.assert_close(gradient, SLOPE * (far == border), atol=5e-6, rtol=0)
    asked = torch.tensor([[0.1, torch.nan, 0.5], [0.1, 0.1, 0.5]])
    assert baked(asked)[1].isnan().tolist() == [True, False]
    assert baked(asked[:0])[0].shape == (0, 3)


def test_what_is_taken_from_the_source() -> None:
    """Catches a bake that forgets its field's bounds, label or level, that trains, that the command
    line offers as a map, or that takes more than 20 bytes a vertex (and 1 % for the rest)."""
    source = formula(linear)
    source.surface_level = 0.25
    baked = BakedField(source, 1)  # a whole number is a length as well
    assert (baked.name, baked.label, baked.surface_level) == ("baked", "Formula baked", 0.25)
    assert (baked.bounds, baked.n_vertices) == (BOX, (5, 4, 4))
    assert list(baked.parameters()) == []
    assert "baked" not in FIELDS
    room = BakedField(Formula(linear, SceneBounds((-4.0, -2.5, 0.0), (4.0, 2.5, 3.0))), 0.1)
    n_bytes = sum(buffer.nbytes for buffer in room.buffers())
    assert 83 * 53 * 33 * 20 <= n_bytes < 1.01 * 84 * 54 * 34 * 20


@pytest.mark.parametrize("voxel", [0, 0.0, -0.04, float("nan"), float("inf"), 0.002, 1e-300])
def test_voxels_that_are_refused(voxel: float) -> None:
    """Catches a division by zero, memory taken before it is counted, and advice that is no help."""
    never = formula(lambda points: pytest.fail("sampled before the size was checked"))
    says = r"^voxel is .* m, of a .* m: .* may take .*; set "
    with pytest.raises(ConfigError, match=says) as error:
        BakedField(never, voxel)
    advice = float(str(error.value).split("; set voxel=")[1].split(" or")[0])
    n_x, n_y, n_z = grid.checked_size(never.bounds, advice)
    assert n_x * n_y * n_z < 25e6  # or it takes many minutes
