"""Paths of an animated camera: smooth pieces between key poses, as in the Neural RGB-D dataset.

The dataset's scenes were rendered along such paths. The figures below are statistics of one of
them, `breakfast_room` (Azinović et al. 2022): 14 pieces of 46 to 216 frames, one cubic of the
position a piece, a constant turning rate in each that jumps at the joins, no tremor, and almost no
motion where the camera turns back. Its 14.2 mm a frame are 5.7e-3 of the scene's unit of 2.5 m.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Poses
from nbtrack.synthetic.motion import CLEARANCE, camera_poses, steps_between, too_full
from nbtrack.synthetic.primitives import Points, Values
from nbtrack.synthetic.room import Room

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


@dataclass(frozen=True)
class _Keys:
    """Key poses, and the frames between them."""

    places: Points  # m, world
    yaw: Values  # rad; 0 looks along -z, positive turns left
    pitch: Values  # rad; negative looks down
    times: Values  # frames


def keyframe_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of an animated camera in a room.

    Its mean speeds, over 240 frames where it is shorter, are `MEAN_STEP`, in the unit of a map of
    what the camera sees. The key poses belong to the room; a seed moves and turns them a little.
    A path of more than 300 frames turns back at both ends of one of that length (our choice).
    Raises `NumericalError` where no path keeps `CLEARANCE`: the room is too full.
    """
    length = min(max(n_frames, _CALIBRATION_FRAMES), _WALK_FRAMES)
    keys = _keys_of_room(room, length)
    least = min(_MIN_STILL_MOVED, 0.8 * _still(_calibrated_path(room, keys, length)))
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt, room.number])
        shift = rng.uniform(-1, 1, keys.places.shape) * _SHIFTED
        turn = rng.uniform(-_TURNED, _TURNED, len(keys.yaw))
        moved = _Keys(keys.places + shift, keys.yaw + turn, keys.pitch, keys.times)
        poses = _calibrated_path(room, moved, length)
        if _still(poses) > least and _is_fit(room, poses):
            period = 2 * (length - 1)
            to_and_fro = np.abs((np.arange(n_frames) + length - 1) % period - (length - 1))
            return poses[to_and_fro]
    raise too_full(room)


def _keys_of_room(room: Room, length: int) -> _Keys:
    """The first drawn key poses whose path leaves its start by enough, else by the most."""
    best = None
    farthest = 0.0
    for attempt in range(_ATTEMPTS):
        keys = _drawn_keys(room, length, np.random.default_rng([attempt, room.number]))
        poses = _calibrated_path(room, keys, length)
        if _still(poses) > farthest and _is_fit(room, poses):
            best = keys
            farthest = _still(poses)
        if farthest > _MIN_STILL:
            break
    if best is None:
        raise too_full(room)
    return best


def _drawn_keys(room: Room, length: int, rng: np.random.Generator) -> _Keys:
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
    places = np.empty((n_pieces + 1, 3))
    places[:, 1] = rng.uniform(*_HEIGHTS, n_pieces + 1)
    level = np.concatenate([np.zeros((1, 2)), np.cumsum(legs, axis=0)])
    middle = np.array(room.walk.center) + rng.uniform(-_AROUND, _AROUND, 2)
    places[:, ::2] = middle + level - level.mean(axis=0)
    turned = frames * rng.uniform(*_RATES, n_pieces) * rng.choice([-1, 1], n_pieces)
    yaw = room.walk.start_yaw + rng.uniform(-_ASTRAY, _ASTRAY)
    yaw = yaw + np.radians(MEAN_STEP[1]) * np.cumsum([0, *turned])
    pitch = room.walk.pitch + rng.uniform(-0.1, 0.1, n_pieces + 1)
    return _Keys(places, yaw, pitch, np.concatenate([[0.0], np.cumsum(frames)]))


def _calibrated_path(room: Room, keys: _Keys, length: int) -> Poses:
    """The path through key poses, which are moved together and turned until speeds are right."""
    places = keys.places
    yaw = keys.yaw
    unit = np.max(room.parts[0].solid.size) / 2
    for _ in range(4):
        poses = _path(_Keys(places, yaw, keys.pitch, keys.times), length)
        step_mm, step_deg = steps_between(poses).mean(axis=1)
        unit = _unit_of_view(room, poses) if room.sdf(poses[:, :3, 3]).min() > 0 else unit
        ratio = np.clip(MEAN_STEP * [1e3 * unit, 1.0] / [step_mm, step_deg], 0.5, 2.0)
        places = places.mean(axis=0) + (places - places.mean(axis=0)) * [ratio[0], 1, ratio[0]]
        yaw = yaw.mean() + (yaw - yaw.mean()) * ratio[1]
    return _path(_Keys(places, yaw, keys.pitch, keys.times), length)


def _path(keys: _Keys, length: int) -> Poses:
    """One cubic of the position and one turning rate between two key poses.

    At a join the camera keeps its direction, and is the slower the more the direction bends.
    """
    legs = np.diff(keys.places, axis=0)
    frames = np.diff(keys.times)[:, None]
    towards = legs / np.linalg.norm(legs, axis=1, keepdims=True)
    along = np.concatenate([towards[:1], (towards[1:] + towards[:-1]) / 2, towards[-1:]])
    speed = np.linalg.norm(legs, axis=1, keepdims=True) / frames
    at = np.arange(length)
    piece = np.minimum(np.searchsorted(keys.times, at, side="right") - 1, len(legs) - 1)
    places = np.empty((length, 3))
    for k, (start, end) in enumerate(zip(keys.times, keys.times[1:], strict=False)):
        ends = keys.places[k : k + 2]
        velocities = along[k : k + 2] * speed[k]
        places[piece == k] = CubicHermiteSpline([start, end], ends, velocities)(at[piece == k])
    level = np.zeros(len(keys.yaw))
    turned = camera_poses(tuple(keys.places.T), keys.yaw, keys.pitch, level)[:, :3, :3]
    poses = np.tile(np.eye(4), (length, 1, 1))
    turning = Slerp(keys.times, Rotation.from_matrix(turned))
    poses[:, :3, :3] = turning(at.clip(max=keys.times[-1])).as_matrix()
    poses[:, :3, 3] = places
    return poses


def _still(poses: Poses) -> float:
    """The ATE (m) of a camera that stays at the first pose."""
    away = np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1)
    return float(np.sqrt(np.mean(away**2)))


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
    """Whether a path is at the right speed, free of obstacles, and looks at things far enough."""
    if room.sdf(poses[:, :3, 3]).min() < CLEARANCE:
        return False
    steps = steps_between(poses) / [[1e3 * _unit_of_view(room, poses)], [1.0]]
    is_calm = (steps.max(axis=1) <= _FASTEST).all()
    is_calm &= (np.abs(steps.mean(axis=1) / MEAN_STEP - 1) < 0.03).all()
    depths = _views(room, poses)[1].reshape(-1, len(_ACROSS) * len(_DOWN))
    return bool(is_calm and np.quantile(depths, 0.25, axis=1).min() > _NEAR)
