"""How the camera of an experiment moves: hand-held, as in the dataset, or at another speed.

Importing this module makes the motions `breakfast_room` and `keyframes_at_SPEED` known by name.
"""

from functools import partial

import numpy as np
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import NumericalError
from nbtrack.core.files import data_folder
from nbtrack.data.dataset import DATASET_UNITS
from nbtrack.recordings.formats import Declaration
from nbtrack.synthetic import Room
from nbtrack.synthetic.make import MOTIONS

HAND_HELD = (
    "scenes.motion=handheld", "tracking.vr.position_unit=metre", "tracking.sdf.position_unit=metre",
)  # fmt: skip
"""Settings of what goes beyond the paper. With rates in metres, half a millimetre a step for 6 mm a
frame, the reach of the paper's methods over the motion is that of the paper's data."""
SPEEDS = (0.5, 1.5)
"""Times the speed of the path of key poses."""
_PLACED_CLEARANCE = 0.4  # m


def dataset_poses(scene: str) -> Poses:
    """The true path of a scene of the dataset, whose `poses.txt` lies in the data folder."""
    poses_gl = np.loadtxt(data_folder() / scene / "poses.txt").reshape(-1, 4, 4)
    return Declaration(camera_axes="opengl").poses_to_opencv(poses_gl)


def _placed(scene: str, room: Room, n_frames: int, seed: int) -> Poses:
    """The true path of a scene of the dataset, placed in a room.

    It is scaled by half the room's longest edge over the scene's unit, moved level and turned about
    the vertical. The first placement with `_PLACED_CLEARANCE` is taken, whatever is found there.
    """
    path = dataset_poses(scene)[:n_frames].copy()
    size = np.array(room.parts[0].solid.size)
    path[:, :3, 3] *= size.max() / 2 / DATASET_UNITS[scene]
    rng = np.random.default_rng([seed, room.number])
    for _ in range(10_000):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("y", rng.uniform(-np.pi, np.pi)).as_matrix()
        moved = turn @ path
        middle = (moved[:, :3, 3].min(axis=0) + moved[:, :3, 3].max(axis=0)) / 2
        moved[:, [0, 2], 3] += rng.uniform(-0.5, 0.5, 2) * size[[0, 2]] - middle[[0, 2]]
        if room.sdf(moved[:, :3, 3]).min() >= _PLACED_CLEARANCE:
            return moved
    raise NumericalError(f"the path of {scene} finds no place in {room.name}: take another room")


def _paced(speed: float, room: Room, n_frames: int, seed: int) -> Poses:
    """The path of key poses at so many times its speed."""
    poses = MOTIONS["keyframes"](room, round(n_frames * speed), seed)
    at = np.minimum(speed * np.arange(n_frames), len(poses) - 1)
    known, between = np.arange(len(poses)), np.tile(np.eye(4), (n_frames, 1, 1))
    turned = Rotation.from_matrix(poses[:, :3, :3])
    between[:, :3, :3] = Slerp(known, turned)(at).as_matrix()
    between[:, :3, 3] = interp1d(known, poses[:, :3, 3], axis=0)(at)
    return between


MOTIONS["breakfast_room"] = partial(_placed, "breakfast_room")
MOTIONS.update({f"keyframes_at_{speed:g}": partial(_paced, speed) for speed in SPEEDS})
