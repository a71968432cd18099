"""The scene's box: what a camera saw of a known room, and where rays leave it."""

import numpy as np
import pytest
import torch

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.data.sequence import RgbdSequence, observed_bounds

UNIT = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
# 90 degrees wide and high: the corner pixels' centers are seen at 19/20 of the half width.
CAMERA = Intrinsics.from_focal(20, 20, 10.0)


def facing_walls(depths_mm: np.ndarray, poses: np.ndarray) -> RgbdSequence:
    """A sequence of black images with given depth."""
    return RgbdSequence(
        "room", CAMERA, np.zeros((*depths_mm.shape, 3), np.uint8), depths_mm.astype(np.uint16),
        poses, np.arange(len(poses)),
    )  # fmt: skip


def test_box_by_hand() -> None:
    """Catches half and full sides mixed up, and a scale of another axis than the longest."""
    box = SceneBounds((0.0, -1.0, 2.0), (4.0, 1.0, 5.0))
    np.testing.assert_allclose(box.center, [2.0, 0.0, 3.5])
    assert box.metres_per_unit == 2.0


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, 0), (0, 0, 1), 1.0),  # along an axis
        ((0, 0, 0), (0, 0, -2), 0.5),  # in units of the direction
        ((0, 0, 0), (0.5, 0, 1), 1.0),  # z is reached first
        ((0, 0, 0), (2, 0, 1), 0.5),  # x is reached first
        ((0.5, 0, 0), (1, 0.1, 0.2), 0.5),  # 0.5 m to go in x
        ((0.5, 0, 0), (-1, 0.1, 0.2), 1.5),  # and 1.5 m backward
        ((0.2, 0.3, 0.4), (0, -0.0, 1), 0.6),  # minus zero is no direction either
        ((0.2, 0.3, 0.4), (1e-12, 0, -1), 1.4),
        ((0, 0, 3), (0, 0, 1), -2.0),  # outside and away: it left 2 m ago
    ],
)
def test_exit_depth(origin: tuple, direction: tuple, expected: float) -> None:
    """Catches NaN for rays along an axis, the near wall taken for the far, and a wrong unit."""
    found = UNIT.exit_depth(torch.tensor([origin]).float(), torch.tensor([direction]).float())
    assert found.item() == pytest.approx(expected, abs=1e-6)


def test_exit_points_lie_on_the_box() -> None:
    """Catches an axis left out: from inside, every exit is on a wall and none is outside."""
    generator = torch.Generator().manual_seed(0)
    box = SceneBounds((-2.0, 0.0, 1.0), (1.0, 2.5, 4.0))
    low, high = torch.tensor(box.minimum), torch.tensor(box.maximum)
    origins = low + (high - low) * torch.rand(500, 3, generator=generator)
    directions = torch.randn(500, 3, generator=generator)
    exits = origins + box.exit_depth(origins, directions)[:, None] * directions
    beyond = torch.maximum(low - exits, exits - high)
    torch.testing.assert_close(beyond.amax(dim=-1), torch.zeros(500), rtol=0, atol=1e-5)


def test_observed_wall() -> None:
    """Catches pixels that are half off, a missing margin, and a camera that is left outside.

    From the origin a wall 2 m away is seen at +-0.95 * 2 = 1.9 m; the camera is at z = 0.
    """
    sequence = facing_walls(np.full((1, 20, 20), 2000), np.eye(4)[None])
    box = observed_bounds(sequence, margin=0.1)
    np.testing.assert_allclose(box.minimum, [-2.0, -2.0, -0.1], atol=1e-5)
    np.testing.assert_allclose(box.maximum, [2.0, 2.0, 2.1], atol=1e-5)


def test_poses_are_applied() -> None:
    """Catches the inverse pose: a camera at (5, 0, 0) that looks along +x sees x = 7."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = [5.0, 0.0, 0.0]
    box = observed_bounds(facing_walls(np.full((1, 20, 20), 2000), pose[None]), margin=0.0)
    np.testing.assert_allclose(box.minimum, [5.0, -1.9, -1.9], atol=1e-5)
    np.testing.assert_allclose(box.maximum, [7.0, 1.9, 1.9], atol=1e-5)


def test_missing_and_wild_depths_do_not_stretch_the_box() -> None:
    """Catches pixels without a measurement taken for points at the camera, and a few wild ones."""
    depths_mm = np.full((5, 20, 20), 2000)
    depths_mm[0, 3, 4:6] = 60_000
    depths_mm[1:, :10] = 0
    poses = np.tile(np.eye(4), (5, 1, 1))
    box = observed_bounds(facing_walls(depths_mm, poses), margin=0.1)
    assert box.maximum[2] == pytest.approx(2.1, abs=1e-5)


def test_no_depth_at_all() -> None:
    """Catches a NumPy error about quantiles where the depth folder is at fault."""
    with pytest.raises(DataError, match="no pixel of room has a depth") as caught:
        observed_bounds(facing_walls(np.zeros((2, 20, 20)), np.tile(np.eye(4), (2, 1, 1))))
    assert "\n" not in str(caught.value)
