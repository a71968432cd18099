"""Paths of an animated camera: smooth pieces between key poses, as in the Neural RGB-D dataset.

The dataset's scenes were rendered along such paths. This module imitates the one of
`breakfast_room` (Azinović et al. 2022). That path has 14 pieces of 46 to 216 frames. In each piece
the position is one cubic polynomial of time and the turning rate is constant, so that the rate
jumps where two pieces join. There is no tremor, and almost no motion where the camera turns back.
The camera moves 14.2 mm a frame, which is 5.7e-3 of the scene's unit (2.5 m).
"""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PPoly
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.synthetic.motion import attempts, camera_poses, has_speed, is_clear, steps_between
from nbtrack.synthetic.room import Room
from nbtrack.tracking.metrics import still_metrics

# Key poses: x, y, z (m, world), pitch, yaw, roll (rad), and the frame in which the camera is there.
Keys = Float[np.ndarray, "n 7"]

# Translation (in units of the scene) and rotation (degrees) from one frame to the next.
MEAN_STEP = np.array([5.7e-3, 0.45])
_MAX_STEP = np.array([8.5e-3, 0.95])  # the path of `breakfast_room` has 7.8e-3 and 0.92


def keyframe_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of an animated camera in a room.

    Its mean speeds are `MEAN_STEP`, where the unit of length is that of a map of what the camera
    sees. Every room has key poses for two paths, one of 240 frames and one of 300; a seed moves and
    turns these poses a little. Up to 240 frames are the beginning of the first path, and more are
    taken from the second. After its 300 frames the camera goes back and forth along it (our
    choice). Raises `NumericalError` as `attempts` does.
    """
    keys_of_240_frames, keys_of_300_frames = room.walk.keys
    keys = np.array(keys_of_240_frames if n_frames <= 240 else keys_of_300_frames)
    base = _calibrated_path(room, keys)
    # A camera that stands still must have at least this error (m): the path then leads well away
    # from its start.
    least_error_m = min(1.0, 0.8 * still_metrics(base)["still_ate_m"])

    for rng in attempts(room, seed):
        moved = keys.copy()  # moved so little that the paths of two seeds pass the same things
        moved[:, :3] += rng.uniform(-1, 1, (len(keys), 3)) * (0.2, 0.1, 0.2)  # m, our choice
        moved[:, 4] += rng.uniform(-0.12, 0.12, len(keys))  # yaw, rad
        poses = _calibrated_path(room, moved)
        is_far = still_metrics(poses)["still_ate_m"] > least_error_m
        if is_far and is_clear(room, poses) and _is_like_the_dataset(room, poses):
            # Indices 0, 1, ..., last, last - 1, ..., 0, 1, ...: at least `n_frames` of them.
            back_and_forth = np.pad(np.arange(len(poses)), (0, n_frames), mode="reflect")
            return poses[back_and_forth[:n_frames]]


def _is_like_the_dataset(room: Room, poses: Poses) -> bool:
    """Whether a path in free space has the right speed, and what it looks at is far enough away.

    In every twelfth image, at most a quarter of what is seen is nearer than 0.8 m.
    """
    unit, nearness = _view(room, poses)
    to_mm = np.array([1e3 * unit, 1.0])  # degrees stay degrees
    return nearness > 0.8 and has_speed(poses, MEAN_STEP * to_mm, _MAX_STEP * to_mm, tolerance=0.03)


def _calibrated_path(room: Room, keys: Keys) -> Poses:
    """A path with the mean speeds `MEAN_STEP`, through key poses that are scaled to give them.

    The keys' x, z and yaw are scaled about their means; the keys keep their frames. This is a
    fixed-point iteration of four rounds: scaling changes what the camera sees, and so the unit in
    which the speed is given.
    """
    keys = keys.copy()
    spread = [0, 2, 4]  # columns: x, z, yaw
    # The unit of length (m) of `MEAN_STEP`. The first value is that of the whole room; each round
    # replaces it by that of what the camera sees.
    unit = np.max(room.parts[0].solid.half)
    for _ in range(4):
        poses = _path(keys)
        if room.sdf(poses[:, :3, 3]).min() > 0:  # rays are cast from free space only
            unit, _ = _view(room, poses)
        wanted = MEAN_STEP * [1e3 * unit, 1.0]  # mm, degrees
        # At most a factor of two a round (our choice), since a scaled path sees other things.
        move, turn = np.clip(wanted / steps_between(poses).mean(axis=1), 0.5, 2.0)
        middle = keys[:, spread].mean(axis=0)
        keys[:, spread] = middle + (keys[:, spread] - middle) * [move, move, turn]
    return _path(keys)


def _path(keys: Keys) -> Poses:
    """Camera-to-world poses through the keys, one for each frame.

    Between two keys the position is one cubic polynomial and the turning rate is constant. At a key
    the direction of motion is continuous, and the more it bends there, the slower is the camera.
    """
    places = keys[:, :3]
    times = keys[:, 6]  # frames
    legs = np.diff(places, axis=0)
    directions = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    # The mean of the directions before and after a key: the more the path bends, the shorter it is.
    joins = (directions[1:] + directions[:-1]) / 2
    tangents = np.concatenate([directions[:1], joins, directions[-1:]])
    speeds = np.linalg.norm(legs, axis=1) / np.diff(times)
    coefficients = []  # of one spline for each piece, since the speed jumps between two pieces
    for k, speed in enumerate(speeds):
        ends = slice(k, k + 2)
        coefficients.append(CubicHermiteSpline(times[ends], places[ends], speed * tangents[ends]).c)
    frames = np.arange(round(times[-1]) + 1)
    rotation = Slerp(times, Rotation.from_matrix(camera_poses(keys[:, :6])[:, :3, :3]))
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    # The last time may be a rounding error below its frame, and Slerp does not extrapolate.
    poses[:, :3, :3] = rotation(frames.clip(max=times[-1])).as_matrix()
    poses[:, :3, 3] = PPoly(np.concatenate(coefficients, axis=1), times)(frames)
    return poses


def _view(room: Room, poses: Poses) -> tuple[float, float]:
    """Two lengths (m) of what every twelfth frame of a path sees: the unit of a map, and nearness.

    The unit is half of the longest side of the box around all that is seen and the cameras, as
    `SceneBounds` has it. For nearness, the lower quartile of z-depths is taken in each frame; it is
    the smallest of these quartiles.
    """
    # A grid of 7 x 5 rays with z = 1, which covers most of an image.
    across, down = np.linspace(-0.55, 0.55, 7), np.linspace(-0.4, 0.4, 5)
    rays_camera = np.stack(np.meshgrid(across, down, [1.0]), axis=-1).reshape(-1, 3)
    directions = (rays_camera @ poses[::12, :3, :3].mT).reshape(-1, 3)
    origins = poses[::12, :3, 3].repeat(len(rays_camera), axis=0)
    depths, _ = room.first_hit(origins, directions)
    points_world = np.concatenate([origins + depths[:, None] * directions, poses[:, :3, 3]])
    quartiles = np.quantile(depths.reshape(-1, len(rays_camera)), 0.25, axis=1)
    # A scene's bounds leave 0.1 m on every side of what is seen.
    return float(np.ptp(points_world, axis=0).max() / 2 + 0.1), float(quartiles.min())
