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
AHEAD = np.eye(4)
TURNED = np.array([[0.0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # along +x, at x = 5


def facing_walls(depths_mm: np.ndarray, pose: np.ndarray = AHEAD) -> RgbdSequence:
    """Black images with given depth, all from one pose."""
    n = len(depths_mm)
    colors, poses = np.zeros((*depths_mm.shape, 3), np.uint8), np.tile(pose, (n, 1, 1))
    return RgbdSequence("room", CAMERA, colors, depths_mm.astype(np.uint16), poses, np.arange(n))


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


def test_box_by_hand() -> None:
    """Catches half and full sides mixed up, a scale of another axis than the longest, and an axis
    left out: from inside, every exit is on a wall and none is outside."""
    box = SceneBounds((0.0, -1.0, 2.0), (4.0, 1.0, 5.0))
    np.testing.assert_allclose(box.center, [2.0, 0.0, 3.5])
    assert box.metres_per_unit == 2.0
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(box.minimum), torch.tensor(box.maximum)
    origins = low + (high - low) * torch.rand(500, 3, generator=generator)
    directions = torch.randn(500, 3, generator=generator)
    exits = origins + box.exit_depth(origins, directions)[:, None] * directions
    beyond = torch.maximum(low - exits, exits - high).amax(dim=-1)
    torch.testing.assert_close(beyond, torch.zeros(500), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("pose", "margin", "low", "high"),
    [
        (AHEAD, 0.1, [-2.0, -2.0, -0.1], [2.0, 2.0, 2.1]),  # seen at +-0.95 * 2 m; camera at z = 0
        (TURNED, 0.0, [5.0, -1.9, -1.9], [7.0, 1.9, 1.9]),
    ],
)
def test_observed_wall(pose, margin, low, high) -> None:
    """Catches pixels that are half off, a missing margin, a camera left outside, the inverse pose:
    a wall is 2 m ahead."""
    box = observed_bounds(facing_walls(np.full((1, 20, 20), 2000), pose), margin=margin)
    np.testing.assert_allclose([box.minimum, box.maximum], [low, high], atol=1e-5)


def test_missing_and_wild_depths_do_not_stretch_the_box() -> None:
    """Catches pixels without a measurement taken for points at the camera, a few wild ones, and a
    NumPy error about quantiles where the depth folder is at fault."""
    depths_mm = np.full((5, 20, 20), 2000)
    depths_mm[0, 3, 4:6] = 60_000
    depths_mm[1:, :10] = 0
    box = observed_bounds(facing_walls(depths_mm), margin=0.1)
    assert box.maximum[2] == pytest.approx(2.1, abs=1e-5)
    with pytest.raises(DataError, match=r"^no pixel of room has a depth.*$"):
        observed_bounds(facing_walls(np.zeros((2, 20, 20))))
