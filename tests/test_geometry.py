"""Laws of rotations and rigid transforms, over batch shapes and near the angles that go wrong."""

import math

import pytest
import torch
from torch import Tensor

from nbtrack.core.geometry import (
    invert_transform,
    make_transform,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
    rotation_angle,
    transform_points,
)

SHAPES = [(), (1,), (7,), (2, 3), (0,)]


@pytest.fixture(params=SHAPES, ids=str)
def shape(request: pytest.FixtureRequest) -> tuple[int, ...]:
    return request.param


def random_quaternions(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    q_wxyz = torch.randn(*shape, 4, generator=generator, dtype=torch.float64)
    q_wxyz = normalize_quaternion(q_wxyz)
    return torch.where(q_wxyz[..., :1] < 0, -q_wxyz, q_wxyz)


def random_transforms(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed + 100)
    translation = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return make_transform(quaternion_to_matrix(random_quaternions(shape, seed)), translation)


def axis_angle(axis: list[float], angle: float) -> Tensor:
    unit = torch.tensor(axis, dtype=torch.float64)
    unit = unit / unit.norm()
    return torch.cat([torch.tensor([math.cos(angle / 2)]).double(), math.sin(angle / 2) * unit])


def test_known_rotations() -> None:
    """Catches swapped order (xyzw), a transposed matrix, and a half angle: worked by hand.

    A quarter turn about z takes x to y; q = (cos 45°, 0, 0, sin 45°).
    """
    quarter = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    x_axis = torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(quaternion_to_matrix(quarter) @ x_axis, torch.tensor([0.0, 1.0, 0]))
    # A third of a turn about (1, 1, 1) takes x to y to z to x; q = (1, 1, 1, 1) / 2.
    cyclic = quaternion_to_matrix(torch.full((4,), 0.5))
    expected = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(cyclic, expected)


def test_matrices_are_rotations(shape: tuple[int, ...]) -> None:
    """Catches a wrong sign in one entry: R Rᵀ = 1 and det R = 1."""
    rotation = quaternion_to_matrix(random_quaternions(shape))
    assert rotation.shape == (*shape, 3, 3)
    identity = torch.eye(3).double().expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(shape).double())


def test_quaternion_round_trip(shape: tuple[int, ...]) -> None:
    """Catches a formula of the four that is wrong, and a sign that is not made unique."""
    q_wxyz = random_quaternions(shape)
    found = matrix_to_quaternion(quaternion_to_matrix(q_wxyz))
    torch.testing.assert_close(found, q_wxyz, rtol=0, atol=1e-14)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -2, 3], [-1, 1e-9, 0]])
@pytest.mark.parametrize("angle", [0, 1e-9, 1e-4, 1.0, math.pi - 1e-6, math.pi])
def test_round_trip_at_special_angles(axis: list[float], angle: float) -> None:
    """Catches a division by w near half turns, and by the sine near no turn."""
    rotation = quaternion_to_matrix(axis_angle(axis, angle))
    again = quaternion_to_matrix(matrix_to_quaternion(rotation))
    torch.testing.assert_close(again, rotation, rtol=0, atol=1e-14)
    single = quaternion_to_matrix(matrix_to_quaternion(rotation.float()))
    torch.testing.assert_close(single.double(), rotation, rtol=0, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 0.02, 1.0, math.pi - 1e-4, math.pi])
def test_rotation_angle(angle: float) -> None:
    """Catches the arc cosine of the trace, which rounds angles below 1e-8 to zero."""
    rotation = quaternion_to_matrix(axis_angle([1, -2, 3], angle))
    assert rotation_angle(rotation).item() == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_rotation_angle_does_not_see_the_frame(shape: tuple[int, ...]) -> None:
    """Catches an angle that depends on the axis: conjugation leaves it as it is."""
    rotation = quaternion_to_matrix(random_quaternions(shape, 1))
    frame = quaternion_to_matrix(random_quaternions(shape, 2))
    angle = rotation_angle(rotation)
    torch.testing.assert_close(rotation_angle(frame @ rotation @ frame.mT), angle)
    torch.testing.assert_close(rotation_angle(rotation.mT), angle)


def test_inverse(shape: tuple[int, ...]) -> None:
    """Catches a translation that is only negated: T T⁻¹ = T⁻¹ T = 1, and (T⁻¹)⁻¹ = T."""
    T = random_transforms(shape)
    identity = torch.eye(4).double().expand_as(T)
    torch.testing.assert_close(T @ invert_transform(T), identity)
    torch.testing.assert_close(invert_transform(T) @ T, identity)
    torch.testing.assert_close(invert_transform(invert_transform(T)), T)


def test_inverse_of_a_product() -> None:
    """Catches inverses composed in the wrong order: (A B)⁻¹ = B⁻¹ A⁻¹."""
    a, b = random_transforms((5,), 1), random_transforms((5,), 2)
    torch.testing.assert_close(invert_transform(a @ b), invert_transform(b) @ invert_transform(a))


def test_quaternion_product_is_matrix_product() -> None:
    """Catches a map that is no homomorphism: q and -q agree, and products may be grouped freely."""
    a, b, c = (quaternion_to_matrix(random_quaternions((5,), seed)) for seed in range(3))
    torch.testing.assert_close((a @ b) @ c, a @ (b @ c))
    q_wxyz = random_quaternions((5,))
    torch.testing.assert_close(quaternion_to_matrix(-q_wxyz), quaternion_to_matrix(q_wxyz))
    torch.testing.assert_close(matrix_to_quaternion(a @ b).norm(dim=-1), torch.ones(5).double())


def test_transform_points(shape: tuple[int, ...]) -> None:
    """Catches points multiplied from the wrong side, and two steps that differ from their product.

    By hand: a quarter turn about z takes (1, 2, 3) to (-2, 1, 3), the translation adds (10, 0, 0).
    """
    quarter = quaternion_to_matrix(axis_angle([0, 0, 1], math.pi / 2))
    T = make_transform(quarter, torch.tensor([10.0, 0.0, 0.0]).double())
    found = transform_points(T, torch.tensor([1.0, 2.0, 3.0]).double())
    torch.testing.assert_close(found, torch.tensor([8.0, 1.0, 3.0]).double())
    a, b = random_transforms((), 1), random_transforms((), 2)
    points = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(0)).double()
    in_two = transform_points(a, transform_points(b, points))
    torch.testing.assert_close(in_two, transform_points(a @ b, points))
    back = transform_points(invert_transform(a), transform_points(a, points))
    torch.testing.assert_close(back, points)


def test_normalization() -> None:
    """Catches a changed direction, and a quaternion whose length grows over 1000 steps of Adam."""
    q_wxyz = random_quaternions((6,))
    torch.testing.assert_close(normalize_quaternion(3.0 * q_wxyz), q_wxyz)
    torch.testing.assert_close(normalize_quaternion(q_wxyz), q_wxyz)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, math.pi - 1e-7, math.pi])
def test_gradients_match_finite_differences(angle: float) -> None:
    """Catches gradients that are wrong or not finite at no turn and at a half turn."""
    q_wxyz = axis_angle([1, -2, 3], angle).requires_grad_()
    points = torch.tensor([[0.3, -0.2, 1.5], [1.0, 0.4, 2.0]]).double()
    translation = torch.tensor([0.1, 0.2, 0.3]).double().requires_grad_()

    def moved(q_wxyz: Tensor, translation: Tensor) -> Tensor:
        rotation = quaternion_to_matrix(normalize_quaternion(q_wxyz))
        return transform_points(make_transform(rotation, translation), points)

    assert torch.autograd.gradcheck(moved, (q_wxyz, translation), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, 3.0, math.pi])
def test_gradients_of_the_quaternion_of_a_matrix(angle: float) -> None:
    """Catches NaN gradients from the clamped square roots or the branch that is not taken."""
    rotation = quaternion_to_matrix(axis_angle([3, 1, -2], angle)).requires_grad_()
    # At a half turn the sign of q flips between two neighbors: the product has no sign.
    outer = lambda m: torch.outer(matrix_to_quaternion(m), matrix_to_quaternion(m))  # noqa: E731
    assert torch.autograd.gradcheck(outer, (rotation,), eps=1e-6, atol=1e-6)
