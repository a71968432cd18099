"""Residuals of points in a field, their derivatives, robust costs and normal equations."""

import math

import pytest
import torch
from box_room import Formula
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.geometry import make_transform, rotation_vector_to_matrix
from nbtrack.fields import Field, NetworkSettings, make_field
from nbtrack.fields.grid import BakedField
from nbtrack.tracking.registration import (
    Residuals,
    certainty,
    moved,
    normal_equations,
    residuals_at,
    robust_cost,
    scales_of,
)

BOX = SceneBounds((-1.0, -1.2, -0.8), (1.0, 1.2, 0.8))
WIDEST, ORIGIN = torch.full((2,), math.inf), torch.eye(4)
NO_NORMALS = torch.zeros(0, 3)
LEAST = torch.tensor([0.02, 0.05])


def wall(slope: float = 1.0) -> Formula:
    """The plane z = 0.5 seen from below, as a distance that grows `slope` times too fast."""
    gray = torch.tensor([[0.2] * 3, [0.0] * 3, [0.0] * 3])
    return Formula(lambda p: slope * (0.5 - p[:, 2]), BOX, lambda p: 0.5 + p @ gray)


def pose() -> Tensor:
    rotation = rotation_vector_to_matrix(torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64))
    return make_transform(rotation, torch.tensor([0.2, -0.1, 0.1], dtype=torch.float64))


def observation(n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points (m) and their intensities, without normals."""
    drawn = torch.rand(n, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return 0.6 * (2 * drawn[:, :3] - 1), drawn[:, 3], NO_NORMALS


@pytest.mark.parametrize("kind", ["network", "grid"])
def test_jacobians_of_both_residuals_against_finite_differences(kind: str) -> None:
    """Catches a wrong arm, order or sign of the twist, a gradient of another function, and a
    grid whose gradient is not that of its own interpolant."""
    field: Field = make_field("neus", NetworkSettings(width=32), BOX, seed=3).double()
    if kind == "grid":
        field = BakedField(field.float(), 0.1).double()
    seen, T, step = observation(200), pose(), 1e-7

    def asked(T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        at = field.linearize(seen[0] @ T[:3, :3].T + T[:3, 3])
        return at.value, at.intensity, at.value_gradient.norm(dim=-1)

    residuals, slope = residuals_at(field, seen, T), asked(T)[2]
    usable = residuals.reliability > 0
    assert usable.sum() > 50
    for axis, twist in enumerate(step * torch.eye(6, dtype=torch.float64)):
        after, before = asked(moved(T, twist)), asked(moved(T, -twist))
        # f / |grad f| with the length held fixed: what the Jacobian is defined as.
        distance = (after[0] - before[0]) / (2 * step) / slope
        intensity = (after[1] - before[1]) / (2 * step)
        off = (residuals.jacobian[..., axis] - torch.stack([distance, intensity]))[:, usable].abs()
        # A point of the grid may sit on a border between cells, where the gradient jumps.
        assert off.quantile(0.99, dim=1).max() < 1e-5


def test_a_field_that_grows_too_fast_is_corrected() -> None:
    """Catches distances taken as they are: at slope 1.3 a step would be 30 % too long."""
    seen = torch.tensor([[0.0, 0.0, 0.2]]), torch.tensor([0.5]), NO_NORMALS
    residuals = residuals_at(wall(1.3), seen, ORIGIN)
    assert residuals.value[0].item() == pytest.approx(0.3)
    assert residuals.jacobian[0, 0].tolist() == pytest.approx([0, 0, 0, 0, 0, -1])
    assert residuals.reliability.item() == pytest.approx((1 + 0.6**2) ** -2)


def test_points_count_by_how_far_their_normals_agree() -> None:
    """Catches points that pull towards a surface that faces elsewhere, normals that do not turn
    with the camera, and unknown ones that count: cosines of 1, 1/2, -1, and none."""
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.75**0.5, 0.0, -0.5], [0.0, 0.0, 1.0], [0, 0, 0]])
    seen = torch.tensor([[0.0, 0.0, 0.2]]).expand(4, 3), torch.full((4,), 0.5)
    residuals = residuals_at(wall(), (*seen, normals), ORIGIN)
    assert residuals.reliability.tolist() == pytest.approx([1, 0.25, 0, 0])
    upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    residuals = residuals_at(wall(), (*seen, normals), upside_down)
    assert residuals.reliability.tolist() == pytest.approx([0, 0, 1, 0])


def test_points_out_of_bounds_count_the_most_and_pull_nowhere() -> None:
    """Catches a pose that gets cheaper by carrying points out of the map."""
    seen = torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, 5.0]]), torch.full((2,), 0.5), NO_NORMALS
    residuals, scales = residuals_at(wall(), seen, ORIGIN), torch.tensor([0.1, 1.0])
    assert residuals.reliability.tolist() == [1.0, 0.0]
    # First point: one scale off, cost 1/2; second: the worst, 1; intensities: 0 and the worst, 1.
    assert robust_cost(residuals, scales, 1.0).item() == pytest.approx((0.5 + 2) / 2)
    alone = residuals_at(wall(), (seen[0][:1], seen[1][:1], NO_NORMALS), ORIGIN)
    both, one = (normal_equations(r, scales, 1.0)[0] for r in (residuals, alone))
    torch.testing.assert_close(both, one)


def test_normal_equations_by_hand() -> None:
    """Catches a missing scale, weight or square: one point one scale off has weight 1/4."""
    value, jacobian = torch.tensor([[0.1], [0.0]]), torch.zeros(2, 1, 6)
    jacobian[0, 0, 5] = 2.0
    residuals = Residuals(value, jacobian, torch.ones(1))
    matrix, vector = normal_equations(residuals, torch.tensor([0.1, 1.0]), 1.0)
    assert matrix.dtype == torch.float64
    assert matrix[5, 5].item() == pytest.approx(0.25 * 4 / 0.01)
    assert vector[5].item() == pytest.approx(0.25 * 2 * 0.1 / 0.01)
    assert matrix.abs().sum() == matrix[5, 5]


def test_scales_follow_the_residuals_down_only() -> None:
    """Catches scales that widen again, which would let outliers back in, or shrink to nothing."""
    values = torch.tensor([[0.01, -0.04, 0.5], [0.0, 0.0, 0.0]])
    residuals = Residuals(values, torch.zeros(2, 3, 6), torch.ones(3))
    assert scales_of(residuals, WIDEST, LEAST).tolist() == pytest.approx([0.12, 0.05])
    assert scales_of(residuals, torch.full((2,), 0.05), LEAST)[0].item() == pytest.approx(0.05)


def test_moved_turns_about_the_camera_and_is_finite_at_zero() -> None:
    """Catches a rotation about the world's origin, and 0/0 in the exponential map."""
    T = pose()
    torch.testing.assert_close(moved(T, torch.zeros(6).double()), T)
    twist = torch.tensor([0.0, 0.0, math.pi / 2, 0.1, 0.0, 0.0], dtype=torch.float64)
    turned = moved(T, twist)
    torch.testing.assert_close(turned[:3, 3], T[:3, 3] + twist[3:])
    torch.testing.assert_close(turned[:3, 0], torch.stack([-T[1, 0], T[0, 0], T[2, 0]]))


def test_a_single_plane_leaves_three_directions_open() -> None:
    """Catches a covariance or condition that hides a slide along the only wall in view."""
    residuals = residuals_at(wall(), tuple(part.float() for part in observation(300)), ORIGIN)
    matrix, _ = normal_equations(residuals, scales_of(residuals, WIDEST, LEAST), 0.0)
    parts = residuals.value, residuals.reliability, matrix
    found = certainty(*(part.numpy() for part in parts), (0.05, 0.25))
    assert found["condition_number"] > 1e6
    # Along the wall the position is as uncertain as the pull to the start allows.
    assert found["position_deviation_m"] == pytest.approx(0.5 / (3 * 0.6745), rel=0.01)
