"""The pinhole camera: pixels and points are each other's inverse."""

import math

import pytest
import torch

from nbtrack.core.camera import Intrinsics, backproject, pixel_directions, project

CAMERA = Intrinsics(640, 480, 500.0, 510.0, 300.0, 250.0)


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
    """Catches a half pixel lost on the way, and batch shapes that are flattened."""
    generator = torch.Generator().manual_seed(0)
    columns = torch.randint(640, shape, generator=generator)
    rows = torch.randint(480, shape, generator=generator)
    depth = 0.1 + 5 * torch.rand(shape, generator=generator)
    points = backproject(CAMERA, columns, rows, depth)
    assert points.shape == (*shape, 3)
    found_columns, found_rows, found_depth = project(CAMERA, points)
    torch.testing.assert_close(found_columns, columns.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(found_rows, rows.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(found_depth, depth)


def test_backproject_undoes_project() -> None:
    """Catches real-valued pixels that are rounded between the two, and an absolute depth: callers
    mask points behind the camera by the sign."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(100, 3, generator=generator) + torch.tensor([0.0, 0.0, 6.0])
    points[0, 2] = -1.0
    columns, rows, depth = project(CAMERA, points)
    assert depth[0].item() == -1.0
    torch.testing.assert_close(backproject(CAMERA, columns, rows, depth), points)


@pytest.mark.parametrize("factor", [0.5, 2.0, 0.25])
def test_scaled_camera_sees_the_same(factor: float) -> None:
    """Catches a principal point or focal length that is left behind: angles must not change.

    The real-valued pixel index i addresses i + 0.5; scaled, that is factor (i + 0.5).
    """
    small = CAMERA.scaled(factor)
    assert (small.width, small.height) == (640 * factor, 480 * factor)
    columns, rows = torch.tensor([0.0, 100.0, 639.0]), torch.tensor([3.0, 200.0, 479.0])
    torch.testing.assert_close(
        pixel_directions(small, factor * (columns + 0.5) - 0.5, factor * (rows + 0.5) - 0.5),
        pixel_directions(CAMERA, columns, rows),
    )
