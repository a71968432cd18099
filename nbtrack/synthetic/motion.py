"""Smooth trajectories like those of a hand-held 30 Hz camera carried through a room."""

import numpy as np
from scipy.interpolate import CubicSpline

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import NumericalError
from nbtrack.synthetic.primitives import Points, Values
from nbtrack.synthetic.room import Room, Walk

MEAN_STEP_MM = 6.0  # translation a frame; hand-held recordings at 30 Hz move 5 to 7
MEAN_STEP_DEG = 0.65  # rotation a frame; hand-held recordings turn 0.5 to 0.8
HEIGHTS = (1.1, 1.7)  # m above the floor
CLEARANCE = 0.35  # m, least distance of the camera to any surface (our choice)
_KNOT_SPACING = 0.35  # rad of turning between knots of the path, about 35 frames
_BURST_FRAMES = 14  # frames between knots of the speed
_CALIBRATION_FRAMES = 120  # shorter trajectories are the beginning of one of this length
# How far a seed moves the center of a path (m, along x and z) and turns its start (rad): paths of
# two seeds cross each other and see the same side of the room.
_CENTER_REACH, _HEADING_REACH = 0.3, 0.25
_FLATTENING = 0.25  # width of the path's ellipse over its length
_ATTEMPTS = 400


def motion_statistics(T_world_camera: Poses) -> tuple[float, float, float, float]:
    """Mean and largest translation (mm), mean and largest rotation (degrees) between frames."""
    step_mm = 1e3 * np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    chord = np.linalg.norm(np.diff(T_world_camera[:, :3, :3], axis=0), axis=(1, 2))
    # |R1 - R0| (Frobenius) = 2 sqrt(2) sin(angle / 2): accurate for the small angles here.
    step_deg = np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))
    return tuple(float(f(steps)) for steps in (step_mm, step_deg) for f in (np.mean, np.max))


def handheld_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of a walk through a room that turns to look around.

    The camera goes along a flat ellipse, 1.6 m long, in the middle of the room's free space, and
    always looks across its center: from one end ahead, then to the side, and from the other end
    back to where it came from, half a circle in about 280 frames. A seed moves and turns the
    ellipse a little, so that two seeds give two paths past the same things. Reach, height (1.1 to
    1.7 m), direction, tilt and roll wander as cubic splines (twice continuously differentiable),
    the speed varies up to threefold, and a hand's tremor of 1.5 to 5 Hz lies on top. Mean speeds
    over the trajectory, or 120 frames if it is shorter, are `MEAN_STEP_MM` and `MEAN_STEP_DEG`.

    Raises `NumericalError` where no path keeps `CLEARANCE`: the room is too full.
    Source: our choice; the statistics are those of hand-held RGB-D recordings.
    """
    length = max(n_frames, _CALIBRATION_FRAMES)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, attempt, room.number])
        poses = _calibrated_path(room.walk, length, rng)
        mean_mm, max_mm, mean_deg, max_deg = motion_statistics(poses)
        calm = max_mm < 3 * MEAN_STEP_MM and max_deg < 3 * MEAN_STEP_DEG
        calm &= abs(mean_mm / MEAN_STEP_MM - 1) < 0.05
        calm &= abs(mean_deg / MEAN_STEP_DEG - 1) < 0.05
        positions = poses[:, :3, 3]
        upright = positions[:, 1].min() >= HEIGHTS[0] and positions[:, 1].max() <= HEIGHTS[1]
        if calm and upright and room.sdf(positions).min() >= CLEARANCE:
            return poses[:n_frames]
    raise NumericalError(
        f"room '{room.name}': none of {_ATTEMPTS} paths keeps {CLEARANCE} m from every surface; "
        "the middle of its walk must be free; move the walk's center or the furniture"
    )


def _calibrated_path(walk: Walk, length: int, rng: np.random.Generator) -> Poses:
    """Draw a path and its speed; adjust turning rate and radius until mean speeds are as wanted."""
    knots = np.arange(-2.0, 1.6 * length * np.radians(MEAN_STEP_DEG) / _KNOT_SPACING + 4.0)
    # Radius (relative), side (rad), yaw (rad), pitch (rad), roll (rad), height (m).
    spread = np.array([0.04, 0.05, 0.07, 0.09, 0.025, 0.05])
    values = spread * np.clip(rng.normal(size=(len(knots), 6)), -2.0, 2.0)
    values[:, 3] += walk.pitch
    values[:, 5] = np.clip(values[:, 5] + rng.uniform(1.3, 1.5), 1.15, 1.65)
    path = CubicSpline(knots * _KNOT_SPACING, values)  # over the angle turned
    speed = relative_speed(length, rng)
    trembling = tremor(length, rng)
    center = np.asarray(walk.center) + rng.uniform(-_CENTER_REACH, _CENTER_REACH, 2)
    heading = walk.start_yaw + rng.uniform(-_HEADING_REACH, _HEADING_REACH)
    rate, radius = np.radians(0.5), 0.7
    for _ in range(12):
        turned = rate * np.concatenate([[0.0], np.cumsum(speed)[:-1]])
        poses = _poses(center, heading, walk.turn * turned, path(turned), radius, trembling)
        mean_mm, _, mean_deg, _ = motion_statistics(poses)
        rate *= np.clip(MEAN_STEP_DEG / mean_deg, 0.7, 1.4)
        radius *= np.clip(MEAN_STEP_MM / mean_mm, 0.7, 1.4)
    return poses


def relative_speed(length: int, rng: np.random.Generator) -> Values:
    """A smooth speed of each frame, up to threefold from slow to fast, of mean 1."""
    bursts = np.arange(-1.0, length / _BURST_FRAMES + 3.0)
    values = 0.4 * np.clip(rng.normal(size=len(bursts)), -1.6, 1.6)
    speed = np.exp(CubicSpline(bursts, values)(np.arange(length) / _BURST_FRAMES))
    return speed / speed.mean()


def tremor(length: int, rng: np.random.Generator) -> Points:
    """A hand's tremor, (length, 6): translation (m) and rotation (pitch, yaw, roll; rad).

    Four sines of 1.5 to 5 Hz each.
    """
    cycles_per_frame, phases = rng.uniform(1.5, 5.0, (4, 6)) / 30, rng.uniform(0, 2 * np.pi, (4, 6))
    amplitude = np.array([0.6e-3] * 3 + [0.5e-3] * 3) / 2.0
    waves = np.sin(2 * np.pi * cycles_per_frame * np.arange(length)[:, None, None] + phases)
    return amplitude * waves.sum(axis=1)


def _poses(center, heading: float, turned: Values, wander, radius: float, trembling) -> Poses:
    """Poses (OpenCV axes) along an ellipse by the angle turned (rad), wandering and trembling.

    `center` (m) is x and z of the ellipse, `heading` (rad) the yaw from its first end to the other,
    `radius` (m) half its length.
    """
    relative_radius, side, yaw_offset, pitch, roll, height = wander.T
    # Opposite to the direction of view, so that the room lies before the camera.
    along, across = -np.cos(turned + side), -_FLATTENING * np.sin(turned + side)
    axes = -np.array([[np.sin(heading), np.cos(heading)], [np.cos(heading), -np.sin(heading)]])
    reach = radius * (1.0 + relative_radius[:, None])
    x, z = (center + reach * (np.stack([along, across], axis=1) @ axes)).T
    positions = np.stack([x, height, z], axis=1)
    return camera_poses(positions, heading + turned + yaw_offset, pitch, roll, trembling)


def camera_poses(positions: Points, yaw: Values, pitch: Values, roll: Values, trembling) -> Poses:
    """Poses (OpenCV axes) at positions (n x 3, m) with angles (rad), and a tremor on top.

    Yaw 0 looks along -z and positive turns left; positive pitch looks up.
    """
    yaw, pitch = yaw + trembling[:, 4], pitch + trembling[:, 3]
    roll = (roll + trembling[:, 5])[:, None]
    forward = [-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)]
    forward = np.stack(forward, axis=-1)
    right = np.stack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)], axis=-1)
    down, cosine, sine = np.cross(forward, right), np.cos(roll), np.sin(roll)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions + trembling[:, :3]
    axes = [cosine * right + sine * down, cosine * down - sine * right, forward]
    poses[:, :3, :3] = np.stack(axes, axis=-1)
    return poses
