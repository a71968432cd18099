"""Laws of rotations and rigid transforms, over batch shapes and near the angles that go wrong."""

import math

import pytest
import torch
from torch import Tensor

from nbtrack.core.geometry import (
    make_transform,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
    transform_points,
)

AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -2, 3], [-1, 1e-9, 0]]


@pytest.fixture(params=[(), (1,), (7,), (2, 3), (0,)], ids=str)
def shape(request) -> tuple[int, ...]:
    return request.param


def random_quaternions(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    q_wxyz = normalize_quaternion(torch.randn(*shape, 4, generator=generator).double())
    return torch.where(q_wxyz[..., :1] < 0, -q_wxyz, q_wxyz)


def axis_angle(axis: list[float], angle: float) -> Tensor:
    unit = torch.nn.functional.normalize(torch.tensor(axis).double(), dim=0)
    return torch.cat([torch.tensor([math.cos(angle / 2)]).double(), math.sin(angle / 2) * unit])


def test_by_hand() -> None:
    """Catches swapped order (xyzw), a transposed matrix, a half angle, points multiplied from the
    wrong side.

    A quarter turn about z takes x to y and (1, 2, 3) to (-2, 1, 3); q = (cos 45°, 0, 0, sin 45°).
    A third of a turn about (1, 1, 1) takes x to y to z to x; q = (1, 1, 1, 1) / 2.
    """
    quarter = quaternion_to_matrix(torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]))
    T = make_transform(quarter, torch.tensor([10.0, 0.0, 0.0]))
    found = transform_points(T, torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(found, torch.tensor([8.0, 1.0, 3.0]))
    cyclic = quaternion_to_matrix(torch.full((4,), 0.5))
    expected = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(cyclic, expected)


def test_quaternions_and_matrices(shape: tuple[int, ...]) -> None:
    """Catches a wrong sign in one entry (R Rᵀ = 1, det R = 1), one of the four formulas that is
    wrong, a sign that is not made unique, and a length that changes the rotation."""
    q_wxyz = random_quaternions(shape)
    rotation = quaternion_to_matrix(q_wxyz)
    assert rotation.shape == (*shape, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand_as(rotation))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(shape).double())
    torch.testing.assert_close(matrix_to_quaternion(rotation), q_wxyz, rtol=0, atol=1e-14)
    torch.testing.assert_close(quaternion_to_matrix(-3 * q_wxyz), rotation)
    torch.testing.assert_close(normalize_quaternion(3 * q_wxyz), q_wxyz)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", [0, 1e-9, 1e-4, 1.0, math.pi - 1e-6, math.pi])
def test_round_trip_at_special_angles(axis: list[float], angle: float) -> None:
    """Catches a division by w near half turns, and by the sine near no turn."""
    rotation = quaternion_to_matrix(axis_angle(axis, angle))
    again = quaternion_to_matrix(matrix_to_quaternion(rotation))
    torch.testing.assert_close(again, rotation, rtol=0, atol=1e-14)
    single = quaternion_to_matrix(matrix_to_quaternion(rotation.float()))
    torch.testing.assert_close(single.double(), rotation, rtol=0, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-7, math.pi])
def test_gradients_match_finite_differences(angle: float) -> None:
    """Catches gradients that are wrong or not finite at no turn and at a half turn: of a moved
    point, and of the quaternion of a matrix with its clamped roots and the branch not taken."""
    q_wxyz = axis_angle([1, -2, 3], angle).requires_grad_()
    points = torch.tensor([[0.3, -0.2, 1.5], [1.0, 0.4, 2.0]]).double()
    translation = torch.tensor([0.1, 0.2, 0.3]).double().requires_grad_()

    def moved(q_wxyz: Tensor, translation: Tensor) -> Tensor:
        return transform_points(make_transform(quaternion_to_matrix(q_wxyz), translation), points)

    def outer(rotation: Tensor) -> Tensor:
        # At a half turn the sign of q flips between two neighbors: the product has no sign.
        return torch.outer(matrix_to_quaternion(rotation), matrix_to_quaternion(rotation))

    assert torch.autograd.gradcheck(moved, (q_wxyz, translation), eps=1e-6, atol=1e-7)
    rotation = quaternion_to_matrix(q_wxyz.detach()).requires_grad_()
    assert torch.autograd.gradcheck(outer, (rotation,), eps=1e-6, atol=1e-6)
