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

# Translation (units of the scene) and rotation (degrees) a frame.
MEAN_STEP = np.array([5.7e-3, 0.45])
_FASTEST = np.array([8.5e-3, 0.95])  # at most; the dataset's path: 7.8e-3 and 0.92


def keyframe_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of an animated camera in a room.

    Its mean speeds are `MEAN_STEP`, in the unit of a map of what the camera sees. The key poses
    belong to the room, those of 240 frames and those of 300; a seed moves and turns them a little.
    A shorter path is the beginning of one of these, a longer one turns back at both ends (our
    choice). Raises `NumericalError` as `attempts` does.
    """
    of_short, of_long = room.walk.keys
    keys = np.array(of_short if n_frames <= 240 else of_long)  # frames of the shorter path
    base = _calibrated_path(room, keys)
    # The smallest allowed error (m) of a camera that stands still. A path with a larger one leads
    # well away from its start.
    least = min(1.0, 0.8 * still_metrics(base)["still_ate_m"])

    for rng in attempts(room, seed):
        moved = keys.copy()  # so little that the paths of two seeds pass the same things
        moved[:, :3] += rng.uniform(-1, 1, (len(keys), 3)) * (0.2, 0.1, 0.2)  # m
        moved[:, 4] += rng.uniform(-0.12, 0.12, len(keys))  # yaw, rad
        poses = _calibrated_path(room, moved)
        is_far = still_metrics(poses)["still_ate_m"] > least
        if is_far and is_clear(room, poses) and _is_like_the_dataset(room, poses):
            # Frame numbers 0, 1, ..., last, last - 1, ..., 0, 1, ...: at least `n_frames` of them.
            back_and_forth = np.pad(np.arange(len(poses)), (0, n_frames), mode="reflect")
            return poses[back_and_forth[:n_frames]]


def _is_like_the_dataset(room: Room, poses: Poses) -> bool:
    """Whether a path in free space has the right speed, and looks at things far enough.

    At most a quarter of an image is nearer than 0.8 m.
    """
    unit, near = _view(room, poses)
    to_mm = np.array([1e3 * unit, 1.0])  # degrees stay degrees
    return near > 0.8 and has_speed(poses, MEAN_STEP * to_mm, _FASTEST * to_mm, tolerance=0.03)


def _calibrated_path(room: Room, keys: Keys) -> Poses:
    """The path through key poses after x, z and yaw were scaled about their means.

    Four rounds of scaling give the path the mean speeds `MEAN_STEP`. The keys keep their frames.
    """
    keys = keys.copy()
    spread = [0, 2, 4]  # columns: x, z, yaw
    # The unit of the scene (m), in which `MEAN_STEP` is given: at first that of the whole room,
    # then that of what the camera sees.
    unit = np.max(room.parts[0].solid.half)
    for _ in range(4):
        poses = _path(keys)
        if room.sdf(poses[:, :3, 3]).min() > 0:  # only a camera in free space sees something
            unit, _ = _view(room, poses)
        wanted = MEAN_STEP * [1e3 * unit, 1.0]  # mm, degrees
        move, turn = np.clip(wanted / steps_between(poses).mean(axis=1), 0.5, 2.0)
        middle = keys[:, spread].mean(axis=0)
        keys[:, spread] = middle + (keys[:, spread] - middle) * [move, move, turn]
    return _path(keys)


def _path(keys: Keys) -> Poses:
    """Camera-to-world poses, with one cubic of the position and one turning rate between two keys.

    At a join the camera keeps its direction, and is the slower the more the direction bends.
    """
    places = keys[:, :3]
    times = keys[:, 6]  # frames
    legs = np.diff(places, axis=0)
    directions = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    # At a join the mean of two directions, which is shorter the more the path bends.
    joins = (directions[1:] + directions[:-1]) / 2
    tangents = np.concatenate([directions[:1], joins, directions[-1:]])
    speeds = np.linalg.norm(legs, axis=1) / np.diff(times)
    coefficients = []  # piece by piece, since the speed jumps at the joins
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
    """The unit (m) of a map of what every twelfth frame of a path sees, and how near that is (m).

    The unit is that of `SceneBounds`. The second number is the smallest lower quartile of z-depths
    of a frame.
    """
    # A grid of rays with z = 1, which covers most of an image.
    across, down = np.linspace(-0.55, 0.55, 7), np.linspace(-0.4, 0.4, 5)
    rays_camera = np.stack(np.meshgrid(across, down, [1.0]), axis=-1).reshape(-1, 3)
    directions = (rays_camera @ poses[::12, :3, :3].mT).reshape(-1, 3)
    origins = poses[::12, :3, 3].repeat(len(rays_camera), axis=0)
    depths, _ = room.first_hit(origins, directions)
    points_world = np.concatenate([origins + depths[:, None] * directions, poses[:, :3, 3]])
    near = np.quantile(depths.reshape(-1, len(rays_camera)), 0.25, axis=1).min()
    # With the 0.1 m that a scene's bounds have around what is seen.
    return float(np.ptp(points_world, axis=0).max() / 2 + 0.1), float(near)
