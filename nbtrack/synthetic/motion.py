"""Paths of a hand-held 30 Hz camera: one that looks around in a room, and a walk all around it.

In both, height, tilt and roll wander, the speed varies, and a tremor is added. Source: our choice.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from skimage.graph import route_through_array

from nbtrack.core.arrays import Poses
from nbtrack.machinery.errors import NumericalError
from nbtrack.synthetic.primitives import Values
from nbtrack.synthetic.room import Room, Walk

# Rows: x, y, z (m, world), pitch, yaw, roll (rad); `camera_poses` makes poses of them.
PoseParameters = Float[np.ndarray, "n 6"]

# Translation (mm) and rotation (degrees) from one frame to the next. Hand-held recordings at 30 Hz
# have 5 to 7 mm and 0.5 to 0.8 degrees.
MEAN_STEP = np.array([6.0, 0.65])
HEIGHTS = (1.1, 1.7)  # m above the floor
CLEARANCE = 0.35  # m, least distance of the camera to any surface (our choice)
_KNOT_SPACING = 0.35  # rad turned between two spline knots of a glance around, about 33 frames
_CELL = 0.1  # m, size of a cell in the grid of free space that a tour is planned in


def handheld_trajectory(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of a walk through a room that turns to look around.

    The camera goes along a flat ellipse, 1.5 m long, in the middle of the room's free space, and
    always looks across the ellipse's center. So it looks ahead from one end, then to the side, and
    from the other end back to where it came from. It takes about 300 frames for half a circle. A
    seed moves and turns the ellipse a little, so that two seeds give two paths past the same
    things. The ellipse's radius, and the camera's height (1.1 to 1.7 m), direction, tilt and roll
    wander as cubic splines. The turning rate varies about fourfold, and a hand's tremor of 1.5 to
    5 Hz is added. Mean speeds over the path, or over 120 frames if it is shorter, are `MEAN_STEP`.

    Raises `NumericalError` as `attempts` does.
    Source: our choice; the statistics are those of hand-held RGB-D recordings.
    """
    for rng in attempts(room, seed):
        # A shorter path is the beginning of one of 120 frames.
        poses = _glance_around(room.walk, max(n_frames, 120), rng)
        is_at_height = poses[:, 1, 3].min() >= HEIGHTS[0] and poses[:, 1, 3].max() <= HEIGHTS[1]
        is_steady = has_speed(poses, MEAN_STEP, 3 * MEAN_STEP, tolerance=0.05)
        if is_at_height and is_steady and is_clear(room, poses):
            return poses[:n_frames]


def attempts(room: Room, seed: int) -> Iterator[np.random.Generator]:
    """Yields random generators for up to 400 paths; the caller stops at the first path it accepts.

    Raises NumericalError after the last one, most often since the room is too full.
    """
    for attempt in range(400):
        yield np.random.default_rng([seed, attempt, room.number])
    found = f"room '{room.name}': no random path is clear by {CLEARANCE} m and within all limits"
    raise NumericalError(f"{found}; move its walk or furniture")


def is_clear(room: Room, poses: Poses) -> bool:
    """Whether the camera is at least `CLEARANCE` away from any surface at every pose."""
    return bool(room.sdf(poses[:, :3, 3]).min() >= CLEARANCE)


def _glance_around(walk: Walk, length: int, rng: np.random.Generator) -> Poses:
    """Random poses of `length` frames; radius and turning rate give the mean speeds `MEAN_STEP`."""
    wandering = _wandering(walk.pitch, length, rng)
    # The share of the path behind the camera at each frame, times the number of frames.
    progress = _exclusive_cumsum(_relative_speed(length, rng))
    tremor = _tremor(length, rng)
    # Paths of two seeds cross each other and see the same side of the room.
    center = np.asarray(walk.center) + rng.uniform(-0.3, 0.3, 2)  # m
    heading = walk.start_yaw + rng.uniform(-0.25, 0.25)  # rad
    # Rows: the horizontal unit vectors (x, z) that point forward and left at the start.
    axes = np.array([[-np.sin(heading), -np.cos(heading)], [-np.cos(heading), np.sin(heading)]])
    # A fixed-point iteration: radius and rate determine the path and so its mean speeds, by which
    # both are then corrected towards `MEAN_STEP`.
    radius = 0.7  # m
    rate = np.radians(0.5)  # rad a frame, in the mean
    for _ in range(12):
        angle = rate * progress
        stretch, side, glance, pitch, roll, height = wandering(angle).T
        turned = walk.turn * angle
        # Forward and left coordinates, in radii. The camera stands on the side of the center that
        # it looks away from, so that most of the room lies before it.
        ellipse = np.stack([-np.cos(turned + side), -0.25 * np.sin(turned + side)], axis=1)
        x, z = (center + radius * (1.0 + stretch[:, None]) * (ellipse @ axes)).T
        yaw = heading + turned + glance
        poses = camera_poses(np.stack([x, height, z, pitch, yaw, roll], axis=1) + tremor)
        move, turn = np.clip(MEAN_STEP / steps_between(poses).mean(axis=1), 0.7, 1.4)
        radius *= move
        rate *= turn
    return poses


def _wandering(pitch: float, length: int, rng: np.random.Generator) -> CubicSpline:
    """A random spline over the angle that the camera has turned by (rad), with six columns.

    Columns 0 to 2 are changes: of the radius (relative), of the angle at which the camera stands on
    the ellipse (rad), and of the yaw (rad). Columns 3 to 5 are values: the pitch (rad) about a mean
    of `pitch`, the roll (rad), and the height (m). The path has `length` frames.
    """
    # There are more knots on both sides than `MEAN_STEP` needs, since the path's turning rate is
    # not known yet.
    knots = np.arange(-2.0, 1.6 * length * np.radians(MEAN_STEP[1]) / _KNOT_SPACING + 4.0)
    spread = np.array([0.04, 0.05, 0.07, 0.09, 0.025, 0.05])
    values = spread * np.clip(rng.normal(size=(len(knots), 6)), -2.0, 2.0)
    values[:, 3] += pitch
    values[:, 5] = np.clip(values[:, 5] + rng.uniform(1.3, 1.5), 1.15, 1.65)
    return CubicSpline(knots * _KNOT_SPACING, values)


def steps_between(T_world_camera: Poses) -> Float[np.ndarray, "2 n"]:
    """Translations (mm, row 0) and rotations (degrees, row 1) from each frame to the next."""
    step_mm = 1e3 * np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    chord = np.linalg.norm(np.diff(T_world_camera[:, :3, :3], axis=0), axis=(1, 2))
    # The Frobenius norm |R1 - R0| is 2 sqrt(2) sin(angle / 2). It is accurate at small angles,
    # where the arc cosine of a trace is not.
    step_deg = np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))
    return np.stack([step_mm, step_deg])


def has_speed(poses: Poses, mean: Values, largest: Values, tolerance: float) -> bool:
    """Whether a path's mean step is close to `mean`, and none of its steps exceeds `largest`.

    `mean` and `largest` are pairs: mm and degrees from one frame to the next. `tolerance` is the
    largest relative deviation of the mean step.
    """
    steps = steps_between(poses)
    is_mean_right = np.abs(steps.mean(axis=1) / mean - 1) < tolerance
    return bool((is_mean_right & (steps.max(axis=1) <= largest)).all())


def tour(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of a closed walk around a room's free space.

    The walk passes the room's stops (`paths.toml`) and keeps to the middle of the free space
    between them. It goes around once, whatever `n_frames` is. The camera looks ahead and turns
    slowly. A seed chooses the stop where the walk begins, and what wanders. Source: our choice.
    """
    rng = np.random.default_rng([seed, room.number])
    first = rng.integers(len(room.walk.stops))
    around = _closed_walk(room, np.roll(room.walk.stops, -first, axis=0))
    steps = np.linalg.norm(np.diff(around, axis=0, append=around[:1]), axis=1)
    round_length = steps.sum()  # m
    # A spline of x and z over the metres walked. The walk is repeated three times and all frames
    # lie in the second round. So interpolation never comes near an end, and smoothing (4 times 45
    # frames to either side) only if there are fewer than 180 frames.
    curve = CubicSpline(_exclusive_cumsum(np.tile(steps, 3)), np.tile(around, (3, 1)))
    speed = _relative_speed(n_frames, rng)
    walked = round_length * (1 + _exclusive_cumsum(speed) / speed.sum())  # m, at each frame
    x, z = curve(walked).T
    three_rounds = np.concatenate([walked - round_length, walked, walked + round_length])
    forward_x, forward_z = curve(three_rounds, nu=1).T  # first derivative: the walking direction
    ahead = np.unwrap(np.arctan2(-forward_x, -forward_z))  # yaw
    # Smoothed over frames, so that the camera takes about 120 of them to turn by 180 degrees.
    yaw = gaussian_filter1d(ahead, 45.0)[n_frames : 2 * n_frames]
    height = rng.uniform(1.3, 1.5) + _wander(n_frames, rng, 0.05)
    pitch = room.walk.pitch + _wander(n_frames, rng, 0.09)
    roll = _wander(n_frames, rng, 0.025)
    return camera_poses(np.stack([x, height, z, pitch, yaw, roll], axis=1) + _tremor(n_frames, rng))


def _closed_walk(room: Room, stops: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Points (x and z, m) of a smooth closed walk past `stops`, in the middle of the free space."""
    # The first part is the shell, in whose middle x and z are 0.
    half_x, _, half_z = room.parts[0].solid.half
    x = np.arange(_CELL - half_x, half_x, _CELL)
    z = np.arange(_CELL - half_z, half_z, _CELL)
    heights = np.linspace(HEIGHTS[0], HEIGHTS[1], 5)
    points = np.stack(np.meshgrid(x, heights, z, indexing="ij"), axis=-1)
    # Distances (m) from surfaces on the grid of x and z: the smallest over the camera's heights.
    clearance = room.sdf(points.reshape(-1, 3)).reshape(points.shape[:3]).min(axis=1)
    is_free = clearance >= CLEARANCE + 0.1  # m more, since smoothing moves the path
    # Costs fall with the distance from surfaces, which draws routes to the middle. No route enters
    # a cell of negative cost.
    costs = np.where(is_free, 1.0 / np.maximum(clearance - CLEARANCE, 0.01), -1.0)
    cells = [(np.abs(x - at_x).argmin(), np.abs(z - at_z).argmin()) for at_x, at_z in stops]
    walk = []
    for start, end in zip(cells, [*cells[1:], cells[0]], strict=True):
        route, _ = route_through_array(costs, start, end, geometric=True)
        walk += route[:-1]  # the next route begins with the cell left out here
    rows, columns = np.array(walk).T
    places = np.stack([x[rows], z[columns]], axis=1)
    return gaussian_filter1d(places, 0.4 / _CELL, axis=0, mode="wrap")  # std: about 0.4 m


def _wander(
    n_frames: int, rng: np.random.Generator, std: float, spacing: int = 40, limit: float = 2.0
) -> Values:
    """A smooth random curve about 0: a value for each frame, from a spline.

    The spline has a knot every `spacing` frames. Values at knots are drawn from a normal
    distribution of standard deviation `std`, and clipped at `limit` standard deviations.
    """
    knots = np.arange(-1.0, n_frames / spacing + 3.0)
    values = std * np.clip(rng.normal(size=len(knots)), -limit, limit)
    return CubicSpline(knots, values)(np.arange(n_frames) / spacing)


def _relative_speed(n_frames: int, rng: np.random.Generator) -> Values:
    """A smooth random speed for each frame, with a mean of 1; it varies about fourfold."""
    speed = np.exp(_wander(n_frames, rng, 0.4, spacing=14, limit=1.6))
    return speed / speed.mean()


def _exclusive_cumsum(steps: Values) -> Values:
    """The sum of all steps before each step: 0 for the first."""
    return np.concatenate([[0.0], np.cumsum(steps)[:-1]])


def _tremor(n_frames: int, rng: np.random.Generator) -> PoseParameters:
    """A hand's tremor, to be added to the six pose parameters.

    In each it is the sum of four sines of 1.5 to 5 Hz with random phases. Together they are as
    strong as one sine of 0.6 mm in a position, or of 0.5 mrad in an angle.
    """
    frame_rate = 30  # Hz
    cycles_per_frame = rng.uniform(1.5, 5.0, (4, 6)) / frame_rate
    phases = rng.uniform(0, 2 * np.pi, (4, 6))
    amplitude = np.array([0.6e-3] * 3 + [0.5e-3] * 3) / np.sqrt(4)  # m, rad; of one of four sines
    waves = np.sin(2 * np.pi * cycles_per_frame * np.arange(n_frames)[:, None, None] + phases)
    return amplitude * waves.sum(axis=1)


def camera_poses(parameters: PoseParameters) -> Poses:
    """Camera-to-world poses (OpenCV axes) from x, y, z (m), pitch, yaw and roll (rad).

    A yaw of 0 looks along -z, a positive yaw to the left of that, and a positive pitch up. A
    positive roll lowers the camera's right side.
    """
    pitch, yaw, roll = parameters.T[3:, :, None]
    forward = np.hstack([-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
    right = np.hstack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)])
    down = np.cross(forward, right)
    rolled_right = np.cos(roll) * right + np.sin(roll) * down
    rolled_down = np.cos(roll) * down - np.sin(roll) * right
    # The columns of a pose: the camera's axes x (right), y (down), z (forward), and its position.
    poses = np.tile(np.eye(4), (len(parameters), 1, 1))
    poses[:, :3] = np.stack([rolled_right, rolled_down, forward, parameters[:, :3]], axis=-1)
    return poses
