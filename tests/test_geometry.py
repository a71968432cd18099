"""Laws of rotations and rigid transforms, over batch shapes and near the angles that go wrong.

And the pinhole camera; the box of what it saw of a known room, and where rays leave it.
"""

import math

import numpy as np
import pytest
import torch
from box_room import sequence_of
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, backproject, pixel_directions, project
from nbtrack.core.geometry import (
    make_transform,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
    transform_points,
)
from nbtrack.data.sequence import observed_bounds
from nbtrack.machinery.errors import DataError


@pytest.fixture(params=[(), (1,), (50,), (3, 4), (0,)], ids=str)
def shape(request) -> tuple[int, ...]:
    return request.param


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
    cyclic = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(quaternion_to_matrix(torch.full((4,), 0.5)), cyclic)


def test_quaternions_and_matrices(shape: tuple[int, ...], generator: torch.Generator) -> None:
    """Catches a wrong sign in one entry (R Rᵀ = 1, det R = 1), one of the four formulas that is
    wrong, a sign that is not made unique, and a length that changes the rotation."""
    q_wxyz = normalize_quaternion(torch.randn(*shape, 4, generator=generator).double())
    q_wxyz = torch.where(q_wxyz[..., :1] < 0, -q_wxyz, q_wxyz)
    rotation = quaternion_to_matrix(q_wxyz)
    assert rotation.shape == (*shape, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand_as(rotation))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(shape).double())
    torch.testing.assert_close(matrix_to_quaternion(rotation), q_wxyz, rtol=0, atol=1e-14)
    torch.testing.assert_close(quaternion_to_matrix(-3 * q_wxyz), rotation)
    torch.testing.assert_close(normalize_quaternion(3 * q_wxyz), q_wxyz)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -2, 3], [-1, 1e-9, 0]])
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


CAMERA = Intrinsics(640, 480, 500.0, 510.0, 300.0, 250.0)
# 90 degrees wide and high: the corner pixels' centers are seen at 19/20 of the half width.
SQUARE = Intrinsics.from_focal(20, 20, 10.0)
TURNED = np.array([[[0.0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]])  # along +x, x = 5


def test_pixels_by_hand() -> None:
    """Catches pixel centers at integers, rows mixed up with columns, and directions of length one.

    The image's middle (320, 240) lies between pixels 319 and 320: pixel 320 is seen at
    (320.5 - 320) / 500 = 0.001, pixel 239 at (239.5 - 240) / 500 = -0.001.
    """
    camera = Intrinsics.from_focal(640, 480, 500.0)
    direction = pixel_directions(camera, torch.tensor(320), torch.tensor(239))
    torch.testing.assert_close(direction, torch.tensor([0.001, -0.001, 1.0]))
    corner = backproject(camera, torch.tensor([0]), torch.tensor([0]), torch.tensor([2.0]))
    torch.testing.assert_close(corner, torch.tensor([[2 * -319.5 / 500, 2 * -239.5 / 500, 2.0]]))


def test_project_undoes_backproject(shape: tuple[int, ...], generator: torch.Generator) -> None:
    """Catches a half pixel lost on the way, batch shapes that are flattened, pixels that are
    rounded, and an absolute depth: callers mask points behind the camera by its sign."""
    columns, rows, depth = torch.rand(3, *shape, generator=generator)
    pixel = 640 * columns, 480 * rows, 5 * depth - 2.5
    points = backproject(CAMERA, *pixel)
    assert points.shape == (*shape, 3)
    torch.testing.assert_close(project(CAMERA, points), pixel, rtol=0, atol=1e-3)


def test_box_by_hand(generator: torch.Generator) -> None:
    """Catches half and full sides mixed up, a scale of another axis than the longest, NaN for rays
    along an axis, the near wall taken for the far, and an axis left out: from inside, every exit is
    on a wall and none is outside; a ray that begins outside and leads away left it before."""
    box = SceneBounds((0.0, -1.0, 2.0), (4.0, 1.0, 5.0))
    np.testing.assert_allclose(box.center, [2.0, 0.0, 3.5])
    assert box.metres_per_unit == 2.0
    low, high = torch.tensor(box.minimum), torch.tensor(box.maximum)
    origins = low + (high - low) * torch.rand(500, 3, generator=generator)
    directions = torch.randn(500, 3, generator=generator)
    exits = origins + box.far_bound(origins, directions)[:, None] * directions
    beyond = torch.maximum(low - exits, exits - high).amax(dim=-1)
    torch.testing.assert_close(beyond, torch.zeros(500), rtol=0, atol=1e-5)
    along = torch.tensor([[0.0, -0.0, 1.0], [1e-12, 0.0, -2.0], [0.0, 0.0, 1.0]])
    starts = torch.tensor([[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [1.0, 0.0, 9.0]])
    assert box.far_bound(starts, along).tolist() == pytest.approx([2.0, 0.5, -4.0])


OBSERVED = [  # of the first the wall is seen at +-0.95 * 2 m, and the camera is at z = 0
    (np.eye(4)[None], 0.1, [-2.0, -2.0, -0.1], [2.0, 2.0, 2.1]),
    (TURNED, 0.0, [5.0, -1.9, -1.9], [7.0, 1.9, 1.9]),
]


@pytest.mark.parametrize(("pose", "margin", "low", "high"), OBSERVED)
def test_observed_wall(pose, margin, low, high) -> None:
    """Catches pixels that are half off, no margin, a camera left outside: a wall is 2 m ahead."""
    box = observed_bounds(sequence_of(np.full((1, 20, 20), 2000), SQUARE, poses=pose), margin)
    np.testing.assert_allclose([box.minimum, box.maximum], [low, high], atol=1e-5)


def test_missing_and_wild_depths_do_not_stretch_the_box() -> None:
    """Catches pixels without a measurement taken for points at the camera, a few wild ones, and a
    NumPy error about quantiles where the depth folder is at fault."""
    depths_mm = np.full((5, 20, 20), 2000)
    depths_mm[0, 3, 4:6] = 60_000
    depths_mm[1:, :10] = 0
    box = observed_bounds(sequence_of(depths_mm, SQUARE), margin=0.1)
    assert box.maximum[2] == pytest.approx(2.1, abs=1e-5)
    with pytest.raises(DataError, match=r"^no pixel of room has a depth.*$"):
        observed_bounds(sequence_of(np.zeros((2, 20, 20)), SQUARE))
