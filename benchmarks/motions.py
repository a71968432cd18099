"""Motions of the camera in experiments: hand-held, or at other speeds.

To import this module adds the motions `keyframes_at_SPEED` to `MOTIONS`.
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
"""Settings of the experiments beyond the paper.

Learning rates are in metres: half a millimetre a step, while the camera moves 6 mm a frame. So the
reach of the paper's methods, divided by the motion, is that of the paper's data. NeuS has the
iterations of the committed results, which are fewer than those of `smoke`."""
SPEEDS = (0.5, 1.5)
"""Factors of the speed of the path of key poses."""


def _paced(speed: float, room: Room, n_frames: int, seed: int) -> Poses:
    """The path of key poses, sampled at `speed` times its own speed."""
    poses = MOTIONS["keyframes"](room, round(n_frames * speed), seed)
    known_times = np.arange(len(poses))  # in frames
    times = np.minimum(speed * np.arange(n_frames), len(poses) - 1)
    sampled = np.tile(np.eye(4), (n_frames, 1, 1))
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    sampled[:, :3, :3] = Slerp(known_times, rotations)(times).as_matrix()
    sampled[:, :3, 3] = interp1d(known_times, poses[:, :3, 3], axis=0)(times)
    return sampled


MOTIONS.update({f"keyframes_at_{speed:g}": partial(_paced, speed) for speed in SPEEDS})
