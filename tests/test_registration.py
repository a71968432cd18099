"""Residuals of points in a field, their derivatives, robust costs and normal equations."""

import math

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig
from nbtrack.core.geometry import make_transform, rotation_vector_to_matrix
from nbtrack.fields import Field, make_field
from nbtrack.fields.grid import bake_field
from nbtrack.tracking.registration import (
    LEAST_SCALES,
    Observation,
    Residuals,
    Scales,
    moved,
    normal_equations,
    residuals_at,
    robust_cost,
    scales_of,
    uncertainty,
)

BOX = SceneBounds((-1.0, -1.2, -0.8), (1.0, 1.2, 0.8))


class Wall(Field):
    """The plane z = 0.5 seen from below, as a distance that grows `slope` times too fast."""

    name, label, surface_level = "wall", "wall", 0.0

    def __init__(self, slope: float) -> None:
        super().__init__(BOX)
        self.slope = slope

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        gray = 0.5 + 0.2 * points_world[:, :1]
        return gray.expand(-1, 3), self.slope * (0.5 - points_world[:, 2])


def pose() -> Float[Tensor, "4 4"]:
    rotation = rotation_vector_to_matrix(torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64))
    return make_transform(rotation, torch.tensor([0.2, -0.1, 0.1], dtype=torch.float64))


def observation(n: int, dtype: torch.dtype = torch.float64) -> Observation:
    generator = torch.Generator().manual_seed(0)
    points = 0.6 * (2 * torch.rand(n, 3, generator=generator, dtype=dtype) - 1)
    return Observation(points, torch.rand(n, generator=generator, dtype=dtype))


def raw_residuals(field: Field, seen: Observation, T: Float[Tensor, "4 4"]) -> tuple:
    """Distance times slope, slope, and intensity of a field at the points."""
    at = field.linearize(seen.points_camera @ T[:3, :3].T + T[:3, 3])
    return at.value, at.value_gradient.norm(dim=-1), at.intensity


@pytest.mark.parametrize("kind", ["network", "grid"])
def test_jacobians_of_both_residuals_against_finite_differences(kind: str) -> None:
    """Catches a wrong arm, order or sign of the twist, a gradient of another function, and a
    grid whose gradient is not that of its own interpolant."""
    field: Field = make_field("neus", FieldConfig(width=32), BOX, seed=3).double()
    if kind == "grid":
        field = bake_field(field.float(), 0.1).double()
    seen, T, step = observation(200), pose(), 1e-7
    residuals = residuals_at(field, seen, T)
    _, slope, _ = raw_residuals(field, seen, T)
    usable = residuals.reliability > 0
    assert usable.sum() > 50
    for axis in range(6):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[axis] = step
        after, before = (raw_residuals(field, seen, moved(T, sign * twist)) for sign in (1, -1))
        # f / |grad f| with the length held fixed: what the Jacobian is defined as.
        distance = (after[0] - before[0]) / (2 * step) / slope
        intensity = (after[2] - before[2]) / (2 * step)
        for found, wanted in (
            (residuals.distance_jacobian, distance), (residuals.intensity_jacobian, intensity)
        ):  # fmt: skip
            difference = (found[:, axis] - wanted)[usable].abs()
            # A point of the grid may sit on a border between cells, where the gradient jumps.
            assert difference.quantile(0.99) < 1e-5


def test_a_field_that_grows_too_fast_is_corrected() -> None:
    """Catches distances taken as they are: at slope 1.3 a step would be 30 % too long."""
    T = torch.eye(4)
    seen = Observation(torch.tensor([[0.0, 0.0, 0.2]]), torch.tensor([0.5]))
    residuals = residuals_at(Wall(1.3), seen, T)
    assert residuals.distance.item() == pytest.approx(0.3)
    expected = [0.0, 0.0, 0.0, 0.0, 0.0, -1.0]
    torch.testing.assert_close(residuals.distance_jacobian[0], torch.tensor(expected))
    assert residuals.reliability.item() == pytest.approx((1 + 0.6**2) ** -2)


def test_points_out_of_bounds_count_the_most_and_pull_nowhere() -> None:
    """Catches a pose that gets cheaper by carrying points out of the map."""
    seen = Observation(torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, 5.0]]), torch.full((2,), 0.5))
    residuals = residuals_at(Wall(1.0), seen, torch.eye(4))
    assert residuals.reliability.tolist() == [1.0, 0.0]
    scales = Scales(torch.tensor(0.1), torch.tensor(1.0))
    # First point: one scale off, cost 1/2; second: the worst, 1; intensities: 0 and the worst, 1.
    assert robust_cost(residuals, scales, 1.0).item() == pytest.approx((0.5 + 2) / 2)
    alone = residuals_at(
        Wall(1.0), Observation(seen.points_camera[:1], seen.intensity[:1]), torch.eye(4)
    )
    both, one = (normal_equations(r, scales, 1.0)[0] for r in (residuals, alone))
    torch.testing.assert_close(both, one)


def test_normal_equations_by_hand() -> None:
    """Catches a missing scale, weight or square: one point one scale off has weight 1/4."""
    ones = torch.ones(1)
    rows = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 2.0]])
    residuals = Residuals(0.1 * ones, rows, 0 * ones, 0 * rows, ones)
    scales = Scales(torch.tensor(0.1), torch.tensor(1.0))
    matrix, vector = normal_equations(residuals, scales, 1.0)
    assert matrix.dtype == torch.float64
    assert matrix[5, 5].item() == pytest.approx(0.25 * 4 / 0.01)
    assert vector[5].item() == pytest.approx(0.25 * 2 * 0.1 / 0.01)
    assert matrix.abs().sum() == matrix[5, 5]


def test_scales_follow_the_residuals_down_only() -> None:
    """Catches scales that widen again, which would let outliers back in, or shrink to nothing."""
    rows = torch.zeros(3, 6)
    residuals = Residuals(
        torch.tensor([0.01, -0.04, 0.5]), rows, torch.zeros(3), rows, torch.ones(3)
    )
    scales = scales_of(residuals)
    assert scales.distance.item() == pytest.approx(0.12)
    assert scales.intensity == LEAST_SCALES.intensity
    narrower = Scales(torch.tensor(0.05), torch.tensor(1.0))
    assert scales_of(residuals, narrower).distance.item() == pytest.approx(0.05)


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
    field, seen = Wall(1.0), observation(300, torch.float32)
    residuals = residuals_at(field, seen, torch.eye(4))
    certainty = uncertainty(residuals, scales_of(residuals), 0.0, 0.1)
    assert certainty.condition_number > 1e6
    # Along the wall the position is as uncertain as the pull to the start allows.
    assert certainty.position_deviation == pytest.approx(0.1 / (3 * 0.6745), rel=0.01)
    assert certainty.weakest_twist[5].abs() < 1e-3
