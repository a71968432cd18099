"""How the camera of an experiment moves: hand-held, or at another speed.

Importing this module makes the motions `keyframes_at_SPEED` known by name.
"""

from functools import partial

import numpy as np
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.synthetic import Room
from nbtrack.synthetic.make import MOTIONS

HAND_HELD = (
    "scenes.motion=handheld", "tracking.vr.position_unit=metre", "tracking.sdf.position_unit=metre",
    "mapping.neus.iterations=1200",
)  # fmt: skip
"""Settings of what goes beyond the paper. With rates in metres, half a millimetre a step for 6 mm a
frame, the reach of the paper's methods over the motion is that of the paper's data. NeuS has the
iterations that the committed results were made with, fewer than those of `smoke`."""
SPEEDS = (0.5, 1.5)
"""Times the speed of the path of key poses."""


def _paced(speed: float, room: Room, n_frames: int, seed: int) -> Poses:
    """The path of key poses at so many times its speed."""
    poses = MOTIONS["keyframes"](room, round(n_frames * speed), seed)
    at = np.minimum(speed * np.arange(n_frames), len(poses) - 1)
    known, between = np.arange(len(poses)), np.tile(np.eye(4), (n_frames, 1, 1))
    turned = Rotation.from_matrix(poses[:, :3, :3])
    between[:, :3, :3] = Slerp(known, turned)(at).as_matrix()
    between[:, :3, 3] = interp1d(known, poses[:, :3, 3], axis=0)(at)
    return between


MOTIONS.update({f"keyframes_at_{speed:g}": partial(_paced, speed) for speed in SPEEDS})
