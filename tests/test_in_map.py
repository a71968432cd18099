"""What a recording says of a map, in a box whose distance is exact."""

import numpy as np
from box_room import BoxRoom, box_sequence
from scipy.spatial.transform import Rotation

from nbtrack.checks.in_map import outside_map_share
from nbtrack.core.bounds import SceneBounds

ROOM = BoxRoom(half=(1.5, 1.2, 2.0))


def test_frames_outside_of_what_was_mapped() -> None:
    """Catches a camera in a part that no map holds, without a word: the map ends at x = 0, and half
    of the frames look to where it is not, known by their true poses alone."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:5, :3, :3] = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()  # towards x
    poses[5:, :3, :3] = Rotation.from_rotvec([0, -np.pi / 2, 0]).as_matrix()
    half = BoxRoom(half=(1.5, 1.2, 2.0))
    half.bounds = SceneBounds((-1.6, -1.3, -2.1), (0.0, 1.3, 2.1))
    astray = np.tile(poses[9], (10, 1, 1))
    sequence = box_sequence(poses, ROOM, 48)
    assert outside_map_share(half, sequence, astray) == 0.5
    assert outside_map_share(ROOM, sequence, astray) == 0
