"""The pinhole camera; the box of what it saw of a known room, and where rays leave it."""

import math

import numpy as np
import pytest
import torch
from box_room import sequence_of

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, backproject, pixel_directions, project
from nbtrack.data.sequence import observed_bounds
from nbtrack.machinery.errors import DataError

CAMERA = Intrinsics(640, 480, 500.0, 510.0, 300.0, 250.0)
# 90 degrees wide and high: the corner pixels' centers are seen at 19/20 of the half width.
SQUARE = Intrinsics.from_focal(20, 20, 10.0)
AHEAD = np.eye(4)[None]
TURNED = np.array([[[0.0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]])  # along +x, x = 5


def test_pixels_by_hand() -> None:
    """Catches pixel centers at integers, and rows mixed up with columns.

    The image's middle (320, 240) lies between pixels 319 and 320: pixel 320 is seen at
    (320.5 - 320) / 500 = 0.001, pixel 239 at (239.5 - 240) / 500 = -0.001.
    """
    camera = Intrinsics.from_focal(640, 480, 500.0)
    direction = pixel_directions(camera, torch.tensor(320), torch.tensor(239))
    torch.testing.assert_close(direction, torch.tensor([0.001, -0.001, 1.0]))
    corner = backproject(camera, torch.tensor([0]), torch.tensor([0]), torch.tensor([2.0]))
    expected = torch.tensor([[2 * -319.5 / 500, 2 * -239.5 / 500, 2.0]])
    torch.testing.assert_close(corner, expected)
    # No direction of length one: 60 degrees over 640 pixels make the docstring's 1.23.
    camera = Intrinsics.from_focal(640, 480, 320 / math.tan(math.radians(30)))
    corner = pixel_directions(camera, torch.tensor(0), torch.tensor(0))
    assert corner.norm().item() == pytest.approx(1.23, abs=0.005)


@pytest.mark.parametrize("shape", [(), (1,), (50,), (3, 4), (0,)], ids=str)
def test_project_undoes_backproject(shape: tuple[int, ...]) -> None:
    """Catches a half pixel lost on the way, batch shapes that are flattened, pixels that are
    rounded, and an absolute depth: callers mask points behind the camera by its sign."""
    generator = torch.Generator().manual_seed(0)
    columns, rows, depth = torch.rand(3, *shape, generator=generator)
    pixel = 640 * columns, 480 * rows, 5 * depth - 2.5
    points = backproject(CAMERA, *pixel)
    assert points.shape == (*shape, 3)
    torch.testing.assert_close(project(CAMERA, points), pixel, rtol=0, atol=1e-3)


def test_box_by_hand() -> None:
    """Catches half and full sides mixed up, a scale of another axis than the longest, NaN for rays
    along an axis, the near wall taken for the far, and an axis left out: from inside, every exit is
    on a wall and none is outside; a ray that begins outside and leads away left it before."""
    box = SceneBounds((0.0, -1.0, 2.0), (4.0, 1.0, 5.0))
    np.testing.assert_allclose(box.center, [2.0, 0.0, 3.5])
    assert box.metres_per_unit == 2.0
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(box.minimum), torch.tensor(box.maximum)
    origins = low + (high - low) * torch.rand(500, 3, generator=generator)
    directions = torch.randn(500, 3, generator=generator)
    exits = origins + box.far_bound(origins, directions)[:, None] * directions
    beyond = torch.maximum(low - exits, exits - high).amax(dim=-1)
    torch.testing.assert_close(beyond, torch.zeros(500), rtol=0, atol=1e-5)
    along = torch.tensor([[0.0, -0.0, 1.0], [1e-12, 0.0, -2.0], [0.0, 0.0, 1.0]])
    starts = torch.tensor([[1.0, 0.0, 3.0], [1.0, 0.0, 3.0], [1.0, 0.0, 9.0]])
    assert box.far_bound(starts, along).tolist() == pytest.approx([2.0, 0.5, -4.0])


@pytest.mark.parametrize(
    ("pose", "margin", "low", "high"),
    [
        (AHEAD, 0.1, [-2.0, -2.0, -0.1], [2.0, 2.0, 2.1]),  # seen at +-0.95 * 2 m; camera at z = 0
        (TURNED, 0.0, [5.0, -1.9, -1.9], [7.0, 1.9, 1.9]),
    ],
)
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
