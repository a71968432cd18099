"""Smooth trajectories like those of a hand-held 30 Hz camera that looks around a room."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from nbtrack.core.errors import ConfigError, NumericalError
from nbtrack.synthetic.room import Room, Walk

Signal = Float[np.ndarray, "n"]

MEAN_STEP_MM = 6.0  # translation a frame; hand-held recordings at 30 Hz move 5 to 7
MEAN_STEP_DEG = 0.65  # rotation a frame; hand-held recordings turn 0.5 to 0.8
HEIGHTS = (1.1, 1.7)  # m above the floor
CLEARANCE = 0.35  # m, least distance of the camera to any surface (our choice)
_KNOT_SPACING = 0.35  # rad of turning between knots of the path, about 35 frames
_BURST_FRAMES = 14  # frames between knots of the speed
_CALIBRATION_FRAMES = 120  # shorter trajectories are the beginning of one of this length
# Frames in which a walk with two places goes from one to the other. A camera turns by about half
# a circle in that time, so that a walk that looks ahead in a doorway once does so again.
CROSSING_FRAMES = 300
_ATTEMPTS = 40


@dataclass(frozen=True)
class MotionStatistics:
    """How fast a trajectory moves, frame to frame."""

    mean_mm: float
    max_mm: float
    mean_deg: float
    max_deg: float


def motion_statistics(T_world_camera: Float[np.ndarray, "n 4 4"]) -> MotionStatistics:
    """Mean and largest translation (mm) and rotation (degrees) between consecutive frames.

    Raises:
        ConfigError: fewer than two frames.
    """
    if len(T_world_camera) < 2:
        raise ConfigError(
            f"{len(T_world_camera)} frames have no motion; at least 2 are needed; ask for more"
        )
    step_mm = 1e3 * np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    rotation = T_world_camera[:, :3, :3]
    chord = np.linalg.norm(rotation[1:] - rotation[:-1], axis=(1, 2))
    # |R1 - R0| (Frobenius) = 2 sqrt(2) sin(angle / 2): accurate for the small angles here.
    step_deg = np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))
    return MotionStatistics(
        float(step_mm.mean()), float(step_mm.max()), float(step_deg.mean()), float(step_deg.max())
    )


def handheld_trajectory(room: Room, n_frames: int, seed: int) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world poses (OpenCV axes) of a walk that looks around a room.

    The camera orbits the middle of the room's free space and looks across it, so that it sees
    furniture at 1.5 to 3 m while turning. Where the walk has a second place, the middle of the
    orbit goes there and back, `CROSSING_FRAMES` each way. Radius, height (1.1 to 1.7 m),
    direction, tilt and roll wander as cubic splines (twice continuously differentiable), the
    speed varies up to threefold, and a hand's tremor of 1.5 to 5 Hz lies on top. Mean speeds are
    set to `MEAN_STEP_MM` and `MEAN_STEP_DEG` over the trajectory (over its first 120 frames if it
    is shorter).

    Args:
        n_frames: at least 2.
        seed: the same seed gives the same poses.

    Raises:
        ConfigError: fewer than two frames.
        NumericalError: no path keeps `CLEARANCE` from every surface: the room is too full.

    Source: our choice; the statistics are those of hand-held RGB-D recordings.
    """
    if n_frames < 2:
        raise ConfigError(f"{n_frames} frames; a trajectory has at least 2; raise the number")
    length = max(n_frames, _CALIBRATION_FRAMES)
    for attempt in range(_ATTEMPTS):
        poses = _calibrated_path(room, length, np.random.default_rng([seed, attempt, room.number]))
        statistics = motion_statistics(poses)
        calm = (
            statistics.max_mm < 3 * MEAN_STEP_MM
            and statistics.max_deg < 3 * MEAN_STEP_DEG
            and abs(statistics.mean_mm / MEAN_STEP_MM - 1) < 0.05
            and abs(statistics.mean_deg / MEAN_STEP_DEG - 1) < 0.05
        )
        positions = poses[:, :3, 3]
        upright = positions[:, 1].min() >= HEIGHTS[0] and positions[:, 1].max() <= HEIGHTS[1]
        if calm and upright and room.sdf(positions).min() >= CLEARANCE:
            return poses[:n_frames]
    raise NumericalError(
        f"room '{room.name}': none of {_ATTEMPTS} paths keeps {CLEARANCE} m from every surface; "
        "the middle of its walk must be free; move the walk's center or the furniture"
    )


@dataclass(frozen=True)
class _Wander:
    """Random smooth signals of one walk: path shape over the angle turned, speed over time."""

    path: CubicSpline  # turned angle -> radius (relative), side, yaw, pitch, roll, height
    speed: Signal  # per frame, mean one
    tremor: Float[np.ndarray, "n 6"]  # translation (m) and rotation vector (rad), per frame


def _calibrated_path(
    room: Room, length: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """Adjust turning rate and orbit radius until the mean speeds are as wanted."""
    wander = _draw_wander(length, rng)
    rate, radius = np.radians(0.5), 0.45
    for _ in range(12):
        poses = _poses(room, wander, rate, radius)
        statistics = motion_statistics(poses)
        rate *= np.clip(MEAN_STEP_DEG / statistics.mean_deg, 0.7, 1.4)
        radius *= np.clip(MEAN_STEP_MM / statistics.mean_mm, 0.7, 1.4)
    return poses


def _draw_wander(length: int, rng: np.random.Generator) -> _Wander:
    knots = np.arange(-2.0, 1.6 * length * np.radians(MEAN_STEP_DEG) / _KNOT_SPACING + 4.0)
    # Radius (relative), side (rad), yaw (rad), pitch (rad), roll (rad), height (m).
    spread = np.array([0.25, 0.18, 0.07, 0.09, 0.025, 0.10])
    values = spread * np.clip(rng.normal(size=(len(knots), 6)), -2.0, 2.0)
    values[:, 5] = np.clip(values[:, 5] + rng.uniform(1.3, 1.5), 1.15, 1.65)
    speed_knots = np.arange(-1.0, length / _BURST_FRAMES + 3.0)
    speed_values = 0.4 * np.clip(rng.normal(size=len(speed_knots)), -1.6, 1.6)
    frames = np.arange(length)
    speed = np.exp(CubicSpline(speed_knots, speed_values)(frames / _BURST_FRAMES))
    return _Wander(
        CubicSpline(knots * _KNOT_SPACING, values), speed / speed.mean(), _tremor(frames, rng)
    )


def _tremor(frames: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "n 6"]:
    """Four sines per axis between 1.5 and 5 Hz (at 30 frames a second)."""
    cycles_per_frame = rng.uniform(1.5, 5.0, (4, 6)) / 30.0
    phases = rng.uniform(0, 2 * np.pi, (4, 6))
    amplitude = np.array([0.6e-3] * 3 + [0.5e-3] * 3) / 2.0
    waves = np.sin(2 * np.pi * cycles_per_frame * frames[:, None, None] + phases)
    return amplitude * waves.sum(axis=1)


def _poses(room: Room, wander: _Wander, rate: float, radius: float) -> Float[np.ndarray, "n 4 4"]:
    turned = rate * np.concatenate([[0.0], np.cumsum(wander.speed)[:-1]])
    relative_radius, side, yaw_offset, pitch_offset, roll, height = wander.path(turned).T
    walk = room.walk
    yaw = walk.start_yaw + walk.turn * turned + yaw_offset
    pitch = walk.pitch + pitch_offset + wander.tremor[:, 3]
    look = _camera_axes(yaw + wander.tremor[:, 4], pitch, roll + wander.tremor[:, 5])
    # Opposite to the direction of view, so that the whole room lies before the camera.
    from_center = walk.start_yaw + walk.turn * turned + side + np.pi
    reach = radius * (1.0 + relative_radius)
    middle = _middle(walk, len(turned))
    poses = np.tile(np.eye(4), (len(turned), 1, 1))
    poses[:, :3, :3] = look
    poses[:, 0, 3] = middle[:, 0] - reach * np.sin(from_center)
    poses[:, 1, 3] = height
    poses[:, 2, 3] = middle[:, 1] - reach * np.cos(from_center)
    poses[:, :3, 3] += wander.tremor[:, :3]
    return poses


def _middle(walk: Walk, length: int) -> Float[np.ndarray, "n 2"]:
    """Middle of the orbit (x and z, m) per frame: at rest at both places, fastest between them."""
    start = np.asarray(walk.center)
    if walk.end is None:
        return np.tile(start, (length, 1))
    crossed = 0.5 - 0.5 * np.cos(np.pi / CROSSING_FRAMES * np.arange(length))
    return start + crossed[:, None] * (np.asarray(walk.end) - start)


def _camera_axes(yaw: Signal, pitch: Signal, roll: Signal) -> Float[np.ndarray, "n 3 3"]:
    """Camera-to-world rotations, OpenCV axes; yaw 0 looks along -z, positive turns left."""
    zeros = np.zeros_like(yaw)
    forward = np.stack(
        [-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], axis=-1
    )
    right = np.stack([np.cos(yaw), zeros, -np.sin(yaw)], axis=-1)
    down = np.cross(forward, right)
    cosine, sine = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cosine * right + sine * down, cosine * down - sine * right, forward], axis=-1)
