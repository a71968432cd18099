"""What a recording says of a map, in a box whose distance is exact."""

import numpy as np
from box_room import BoxRoom, box_sequence, narrow_room, poses_at

from nbtrack.checks.in_map import outside_map_share
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.sequence import RgbdSequence

ROOM = BoxRoom(half=(1.5, 1.2, 2.0))


def seen(n_frames: int = 12) -> RgbdSequence:
    """From before the middle, turned to all sides a little: most see four or five walls."""
    random = np.random.default_rng(0)
    turns = random.normal(scale=0.2, size=(n_frames, 3))
    poses = poses_at(random.uniform(-0.2, 0.2, (n_frames, 3)) - [0, 0, 0.4], turns)
    return box_sequence(poses, narrow_room(), 24)  # with three walls a motion does the same


def test_frames_outside_of_what_was_mapped() -> None:
    """Catches a camera in a part that no map holds, without a word: the map ends at x = 0, and half
    of the frames look to where it is not, known by their true poses alone."""
    towards_x = np.outer([1] * 5 + [-1] * 5, [0, np.pi / 2, 0])
    poses = poses_at(np.zeros((10, 3)), towards_x)
    half = BoxRoom(half=(1.5, 1.2, 2.0))
    half.bounds = SceneBounds((-1.6, -1.3, -2.1), (0.0, 1.3, 2.1))
    astray = np.tile(poses[9], (10, 1, 1))
    assert outside_map_share(half, box_sequence(poses, ROOM, 48), astray) == 0.5
    assert outside_map_share(ROOM, seen(), seen().T_world_camera) == 0
