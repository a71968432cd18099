"""A walk around the whole of a room, looking ahead, for recordings longer than a glance around."""

import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline
from skimage.graph import MCP_Geometric, route_through_array

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import NumericalError
from nbtrack.synthetic.motion import CLEARANCE, HEIGHTS, camera_poses, relative_speed, tremor
from nbtrack.synthetic.primitives import Points, Values
from nbtrack.synthetic.room import Room

_CELL = 0.1  # m, of the plan of free space
_MARGIN = 0.1  # m that the plan keeps in addition to the clearance, since the path is smoothed
_COVERED = 2.0  # m: the tour passes so near to every free place
_SMOOTHED = 0.4  # m, std of the path's smoothing along itself
_AHEAD = 45.0  # frames, std of the smoothing of the direction of view: 180 degrees in about 120


def tour(room: Room, n_frames: int, seed: int) -> Poses:
    """Camera-to-world poses (OpenCV axes) of a closed walk around a room's free space.

    The walk passes within 1.2 m of every place where a camera has room, by the nearest one that it
    has not passed, and returns to its start. The camera looks ahead and turns slowly. Its mean
    speed is the length of the walk over the frames; height, tilt, bursts of speed and tremor are as
    in `handheld_trajectory`. A seed chooses where the walk begins, and all of these.

    Raises `NumericalError` where the walk comes nearer than `CLEARANCE` to a surface.
    Source: our choice.
    """
    rng = np.random.default_rng([seed, room.number])
    around = _closed_walk(room, rng)
    length = np.linalg.norm(np.diff(around, axis=0, append=around[:1]), axis=1)
    # Three rounds, so that smoothing and interpolation meet no end in the middle one.
    covered = np.concatenate([[0.0], np.cumsum(np.tile(length, 3))[:-1]])
    curve = CubicSpline(covered, np.tile(around, (3, 1)))
    speed = relative_speed(n_frames, rng)
    share = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) / speed.sum()
    at = length.sum() * (1 + share)
    x, z = curve(at).T
    forward = curve(np.concatenate([at - length.sum(), at, at + length.sum()]), 1)
    yaw = np.unwrap(np.arctan2(-forward[:, 0], -forward[:, 1]))
    yaw = ndimage.gaussian_filter1d(yaw, _AHEAD)[n_frames : 2 * n_frames]
    height = rng.uniform(1.3, 1.5) + _wander(n_frames, 0.05, rng)
    pitch = room.walk.pitch + _wander(n_frames, 0.09, rng)
    roll, trembling = _wander(n_frames, 0.025, rng), tremor(n_frames, rng)
    poses = camera_poses(np.stack([x, height, z], axis=1), yaw, pitch, roll, trembling)
    nearest = room.sdf(poses[:, :3, 3]).min()
    if nearest < CLEARANCE:
        raise NumericalError(
            f"room '{room.name}': the tour comes within {nearest:.2f} m of a surface; "
            f"{CLEARANCE} m or more are allowed; move the furniture"
        )
    return poses


def _wander(n_frames: int, std: float, rng: np.random.Generator) -> Values:
    """A smooth random curve with knots every 40 frames."""
    knots = np.arange(-1.0, n_frames / 40 + 3.0)
    values = std * np.clip(rng.normal(size=len(knots)), -2.0, 2.0)
    return CubicSpline(knots, values)(np.arange(n_frames) / 40)


def _closed_walk(room: Room, rng: np.random.Generator) -> Points:
    """Places (n x 2: x and z, m) of a smooth closed walk past all of a room's free space."""
    shell = room.parts[0].solid
    x, z = (np.arange(_CELL - side / 2, side / 2, _CELL) for side in shell.size[::2])
    heights = np.linspace(*HEIGHTS, 5)
    points = np.stack(np.meshgrid(x, heights, z, indexing="ij"), axis=-1)
    clearance = room.sdf(points.reshape(-1, 3)).reshape(points.shape[:3]).min(axis=1)
    labels, _ = ndimage.label(clearance >= CLEARANCE + _MARGIN)
    free = labels == 1 + np.bincount(labels.ravel())[1:].argmax()  # the largest connected part
    cells = np.argwhere(free)
    passed = [tuple(cells[rng.integers(len(cells))])]
    # Begin as far from a random place as one can walk, then go where one has not been.
    passed = [_farthest(free, passed)[0]]
    while (farthest := _farthest(free, passed))[1] > _COVERED:
        passed.append(farthest[0])
    ordered = [passed.pop(0)]
    while passed:
        nearest = min(passed, key=_walked(free, ordered[-1:]).__getitem__)
        passed.remove(nearest)
        ordered.append(nearest)
    costs = np.where(free, 1.0 / np.maximum(clearance - CLEARANCE, 0.01), -1.0)  # the middle
    route = []
    for start, end in zip(ordered, ordered[1:] + ordered[:1], strict=True):
        route += route_through_array(costs, start, end, geometric=True)[0][:-1]
    rows, columns = np.array(route).T
    return ndimage.gaussian_filter1d(
        np.stack([x[rows], z[columns]], axis=1), _SMOOTHED / _CELL, axis=0, mode="wrap"
    )


def _walked(free: np.ndarray, starts: list) -> Values:
    """Length (m) of the shortest walk from any start to every free cell; 0 elsewhere."""
    costs, _ = MCP_Geometric(np.where(free, _CELL, -1.0)).find_costs(starts)
    return np.where(free, costs, 0.0)


def _farthest(free: np.ndarray, starts: list) -> tuple[tuple[int, int], float]:
    """The free cell with the longest shortest walk from all starts, and that walk (m)."""
    lengths = _walked(free, starts)
    cell = np.unravel_index(lengths.argmax(), lengths.shape)
    return cell, float(lengths[cell])
