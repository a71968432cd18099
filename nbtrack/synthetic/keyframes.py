"""Paths of an animated camera: smooth pieces between key poses, as in the Neural RGB-D dataset.

The dataset's scenes were rendered along such paths. The figures below are statistics of one of
them, `breakfast_room` (Azinović et al. 2022): 14 pieces of 46 to 216 frames, one cubic of the
position a piece, a constant turning rate in each that jumps at the joins, no tremor, and almost no
motion where the camera turns back. Its 14.2 mm a frame are 5.7e-3 of the scene's unit of 2.5 m.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PPoly
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.synthetic.motion import camera_poses, has_speed, is_clear, steps_between, too_full
from nbtrack.synthetic.primitives import Points, Values
from nbtrack.synthetic.room import Room
from nbtrack.tracking.metrics import still_metrics

Keys = Float[np.ndarray, "n 7"]  # as `camera_poses` takes them, and the frame that is there

MEAN_STEP = np.array([5.7e-3, 0.45])  # translation (units of the scene), rotation (degrees)
_FASTEST = np.array([8.5e-3, 0.95])  # the dataset's path: 7.8e-3 and 0.92
_FRAMES_A_PIECE = 83  # in the mean
_SHORTEST = 46  # frames of a piece (our choice, as the longest)
_LONGEST = 130
_SPEEDS = (0.85, 1.2)  # of pieces, over the mean speed
_RATES = (0.5, 1.9)  # the same of turning
_TURNS_BACK = 0.25  # share of the joins where the camera goes back to where it came from
_HEIGHTS = (1.25, 1.7)  # m above the floor, at the key poses
_AROUND = 0.5  # m; how far a key pose is from the middle of a room's walk
_ASTRAY = 0.8  # rad; how far it is turned from the view there
# A camera that stands still should be off by so much (m), where a room allows it: at the key poses,
# and after a seed has moved them.
_MIN_STILL = 1.2
_MIN_STILL_MOVED = 1.0
_CALIBRATION_FRAMES = 240  # shorter paths are the beginning of one of this length
_WALK_FRAMES = 300  # longer paths go to and fro on one of this length: every room has one
_ATTEMPTS = 600
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

    Its mean speeds, over 240 frames where it is shorter, are `MEAN_STEP`, in the unit of a map of
    what the camera sees. The key poses belong to the room; a seed moves and turns them a little.
    A path of more than 300 frames turns back at both ends of one of that length (our choice).
    Raises `NumericalError` where no path keeps `CLEARANCE`: the room is too full.
    """
    length = min(max(n_frames, _CALIBRATION_FRAMES), _WALK_FRAMES)
    seeds = [[attempt, room.number] for attempt in range(_ATTEMPTS)]
    drawn = (_drawn_keys(room, length, np.random.default_rng(numbers)) for numbers in seeds)
    keys, poses = _first_fit(room, length, drawn, _MIN_STILL)
    moved = (_moved(keys, np.random.default_rng([seed, *numbers])) for numbers in seeds)
    _, poses = _first_fit(room, length, moved, min(_MIN_STILL_MOVED, 0.8 * _still(poses)))
    return poses[np.pad(np.arange(length), (0, n_frames), mode="reflect")[:n_frames]]


def _first_fit(
    room: Room, length: int, candidates: Iterable[Keys], least: float
) -> tuple[Keys, Poses]:
    """The first keys whose path leaves its start by more than that (m), else by the most."""
    best = None
    farthest = 0.0
    for keys in candidates:
        poses = _calibrated_path(room, keys, length)
        if _still(poses) > farthest and _is_fit(room, poses):
            best = keys, poses
            farthest = _still(poses)
        if farthest > least:
            break
    if best is None:
        raise too_full(room)
    return best


def _moved(keys: Keys, rng: np.random.Generator) -> Keys:
    """Key poses near others."""
    moved = keys.copy()
    moved[:, :3] += rng.uniform(-1, 1, (len(keys), 3)) * _SHIFTED
    moved[:, 4] += rng.uniform(-_TURNED, _TURNED, len(keys))
    return moved


def _drawn_keys(room: Room, length: int, rng: np.random.Generator) -> Keys:
    """Random key poses: legs of a walk whose heading, height, speed and turning rate vary."""
    size = np.array(room.parts[0].solid.size)
    n_pieces = max(2, round(length / _FRAMES_A_PIECE))
    frames = rng.uniform(_SHORTEST, _LONGEST, n_pieces)
    frames *= (length - 1) / frames.sum()
    bend = rng.uniform(-1.2, 1.2, n_pieces)
    bend += np.pi * (rng.random(n_pieces) < _TURNS_BACK)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(bend)
    legs = (frames * rng.uniform(*_SPEEDS, n_pieces))[:, None] * MEAN_STEP[0] * size.max() / 2
    legs = legs * np.stack([np.sin(heading), np.cos(heading)], axis=1)
    height = rng.uniform(*_HEIGHTS, n_pieces + 1)
    level = np.cumsum([np.zeros(2), *legs], axis=0)
    middle = np.array(room.walk.center) + rng.uniform(-_AROUND, _AROUND, 2)
    x, z = (middle + level - level.mean(axis=0)).T
    turned = frames * rng.uniform(*_RATES, n_pieces) * rng.choice([-1, 1], n_pieces)
    yaw = room.walk.start_yaw + rng.uniform(-_ASTRAY, _ASTRAY)
    yaw = yaw + np.radians(MEAN_STEP[1]) * np.cumsum([0, *turned])
    pitch = room.walk.pitch + rng.uniform(-0.1, 0.1, n_pieces + 1)
    times = np.cumsum([0, *frames])
    return np.stack([x, height, z, pitch, yaw, np.zeros_like(yaw), times], axis=1)


def _calibrated_path(room: Room, keys: Keys, length: int) -> Poses:
    """The path through key poses, which are moved together and turned until speeds are right."""
    keys = keys.copy()
    columns = [0, 1, 2, 4]  # x, y, z, yaw
    unit = np.max(room.parts[0].solid.size) / 2
    for _ in range(4):
        poses = _path(keys, length)
        unit = _unit_of_view(room, poses) if room.sdf(poses[:, :3, 3]).min() > 0 else unit
        wanted = MEAN_STEP * [1e3 * unit, 1.0]
        farther, faster = np.clip(wanted / steps_between(poses).mean(axis=1), 0.5, 2.0)
        middle = keys[:, columns].mean(axis=0)
        away = keys[:, columns] - middle
        keys[:, columns] = middle + away * [farther, 1, farther, faster]
    return _path(keys, length)


def _path(keys: Keys, length: int) -> Poses:
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
    at = np.arange(length)
    turning = Slerp(times, Rotation.from_matrix(camera_poses(keys[:, :6])[:, :3, :3]))
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3, :3] = turning(at.clip(max=times[-1])).as_matrix()
    poses[:, :3, 3] = PPoly(np.concatenate(pieces, axis=1), times)(at)
    return poses


def _still(poses: Poses) -> float:
    return still_metrics(poses)["still_ate_m"]


def _views(room: Room, poses: Poses) -> tuple[Points, Values]:
    """Points (m, world) that some frames see, and their z-depths (m)."""
    rays = np.stack(np.meshgrid(_ACROSS, _DOWN, [1.0]), axis=-1).reshape(-1, 3)
    directions = (rays @ poses[::12, :3, :3].mT).reshape(-1, 3)
    origins = poses[::12, :3, 3].repeat(len(rays), axis=0)
    depths, _ = room.first_hit(origins, directions)
    return origins + depths[:, None] * directions, depths


def _unit_of_view(room: Room, poses: Poses) -> float:
    """The unit (m) that a map of what the camera sees would have; see `SceneBounds`."""
    points = np.concatenate([_views(room, poses)[0], poses[:, :3, 3]])
    return float(np.ptp(points, axis=0).max() / 2 + _MARGIN)


def _is_fit(room: Room, poses: Poses) -> bool:
    """Whether a path is free of obstacles, at the right speed, and looks at things far enough."""
    if not is_clear(room, poses):
        return False
    unit = [1e3 * _unit_of_view(room, poses), 1.0]
    depths = _views(room, poses)[1].reshape(-1, len(_ACROSS) * len(_DOWN))
    is_far = np.quantile(depths, 0.25, axis=1).min() > _NEAR
    return bool(is_far and has_speed(poses, MEAN_STEP * unit, _FASTEST * unit, 0.03))
