"""Paths of an animated camera: smooth pieces between key poses, as in the Neural RGB-D dataset.

The dataset's scenes were rendered along such paths. The figures below are statistics of one of
them, `breakfast_room` (Azinović et al. 2022): 14 pieces of 46 to 216 frames, one cubic of the
position a piece, a constant turning rate in each that jumps at the joins, no tremor, and almost no
motion where the camera turns back. Its 14.2 mm a frame are 5.7e-3 of the scene's unit of 2.5 m.
"""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PPoly
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.synthetic.motion import attempts, camera_poses, has_speed, is_clear, steps_between
from nbtrack.synthetic.room import Room
from nbtrack.tracking.metrics import still_metrics

Keys = Float[np.ndarray, "n 7"]  # as `camera_poses` takes them, and the frame that is there

MEAN_STEP = np.array([5.7e-3, 0.45])  # translation (units of the scene), rotation (degrees)
_FASTEST = np.array([8.5e-3, 0.95])  # the dataset's path: 7.8e-3 and 0.92
# A camera that stands still should be off by so much (m), or by this share of what it is without a
# seed's changes.
_MIN_STILL = 1.0
_STILL_SHARE = 0.8
_SHORT = 240  # frames of the shorter of a room's two paths
# How far a seed moves the key poses (m, along x, y, z) and turns them (rad): the paths of two seeds
# pass the same things.
_SHIFTED = (0.2, 0.1, 0.2)
_TURNED = 0.12
_ACROSS = np.linspace(-0.55, 0.55, 7)  # rays through an image
_DOWN = np.linspace(-0.4, 0.4, 5)
_NEAR = 0.8  # m; a quarter of an image at most is so near
_MARGIN = 0.1  # m; of a scene's bounds


def keyframe_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of an animated camera in a room.

    Its mean speeds are `MEAN_STEP`, in the unit of a map of what the camera sees. The key poses
    belong to the room, those of 240 frames and those of 300; a seed moves and turns them a little.
    A shorter path is the beginning of one of these, a longer one turns back at both ends (our
    choice). Raises `NumericalError` as `attempts` does.
    """
    keys = np.array(room.walk.keys[n_frames > _SHORT])
    length = round(keys[-1, 6]) + 1
    base = _calibrated_path(room, keys)
    least = min(_MIN_STILL, _STILL_SHARE * still_metrics(base)["still_ate_m"])

    for rng in attempts(room, seed):
        moved = keys.copy()
        moved[:, :3] += rng.uniform(-1, 1, (len(keys), 3)) * _SHIFTED
        moved[:, 4] += rng.uniform(-_TURNED, _TURNED, len(keys))
        poses = _calibrated_path(room, moved)
        is_far = still_metrics(poses)["still_ate_m"] > least
        if is_far and is_clear(room, poses) and _is_like_the_dataset(room, poses):
            return poses[np.pad(np.arange(length), (0, n_frames), mode="reflect")[:n_frames]]


def _is_like_the_dataset(room: Room, poses: Poses) -> bool:
    """Whether a path in free space has the right speed, and looks at things far enough."""
    unit, near = _view(room, poses)
    mean, largest = np.stack([MEAN_STEP, _FASTEST]) * [1e3 * unit, 1.0]
    return near > _NEAR and has_speed(poses, mean, largest, 0.03)


def _calibrated_path(room: Room, keys: Keys) -> Poses:
    """The path through key poses, which are moved together and turned until speeds are right."""
    keys = keys.copy()
    columns = [0, 1, 2, 4]  # x, y, z, yaw
    unit = np.max(room.parts[0].solid.size) / 2
    for _ in range(4):
        poses = _path(keys)
        unit = _view(room, poses)[0] if room.sdf(poses[:, :3, 3]).min() > 0 else unit
        wanted = MEAN_STEP * [1e3 * unit, 1.0]
        farther, faster = np.clip(wanted / steps_between(poses).mean(axis=1), 0.5, 2.0)
        middle = keys[:, columns].mean(axis=0)
        away = keys[:, columns] - middle
        keys[:, columns] = middle + away * [farther, 1, farther, faster]
    return _path(keys)


def _path(keys: Keys) -> Poses:
    """One cubic of the position and one turning rate between two key poses.

    At a join the camera keeps its direction, and is the slower the more the direction bends.
    """
    places = keys[:, :3]
    times = keys[:, 6]
    legs = np.diff(places, axis=0)
    towards = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    along = np.concatenate([towards[:1], (towards[1:] + towards[:-1]) / 2, towards[-1:]])
    speed = np.linalg.norm(legs, axis=1) / np.diff(times)
    pieces = []
    for k in range(len(legs)):
        ends = slice(k, k + 2)
        pieces.append(CubicHermiteSpline(times[ends], places[ends], along[ends] * speed[k]).c)
    at = np.arange(round(times[-1]) + 1)
    turning = Slerp(times, Rotation.from_matrix(camera_poses(keys[:, :6])[:, :3, :3]))
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, :3] = turning(at.clip(max=times[-1])).as_matrix()
    poses[:, :3, 3] = PPoly(np.concatenate(pieces, axis=1), times)(at)
    return poses


def _view(room: Room, poses: Poses) -> tuple[float, float]:
    """What some frames see: the unit (m) of a map of it, as `SceneBounds` has it, and the least
    z-depth (m) that a quarter of an image does not exceed."""
    rays = np.stack(np.meshgrid(_ACROSS, _DOWN, [1.0]), axis=-1).reshape(-1, 3)
    directions = (rays @ poses[::12, :3, :3].mT).reshape(-1, 3)
    origins = poses[::12, :3, 3].repeat(len(rays), axis=0)
    depths, _ = room.first_hit(origins, directions)
    points = np.concatenate([origins + depths[:, None] * directions, poses[:, :3, 3]])
    near = np.quantile(depths.reshape(-1, len(rays)), 0.25, axis=1).min()
    return float(np.ptp(points, axis=0).max() / 2 + _MARGIN), float(near)
