"""Whether a map and a recording belong together, share a world, and where they misfit.

Of depths that misfit: at a pose that is right but for a little, a measured point p (camera frame)
has a distance r in the map, whose gradient is q (camera frame). If all depths of the recording are
too long by a share s, r = -s (q . p) plus what a small motion of the camera explains; if its focal
lengths are too long, p changes across the axis alone. One number for all frames, and a motion for
each, are a linear least-squares problem: the motions are projected out of each frame.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Pose, Poses, WorldPoints
from nbtrack.core.errors import DataError
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import depth_residual_of
from nbtrack.tracking.metrics import LOST_THRESHOLD_M, pose_errors
from nbtrack.tracking.trajectories import Trajectory

# A map is refused where its misfit exceeds both. Measured on nine maps of three rooms (one a real
# recording): frames of the same room 0.024 m at most, of other rooms 0.095 m at least.
MISFIT_FACTOR = 3.0  # times what is usual in the map's own frames
MISFIT_ALLOWED = 0.05  # m
_N_POINTS = 500  # measured ones of a frame
_MAX_DISTANCE = 0.1  # m; points farther from any surface tell nothing
_N_FRAMES = 40  # looked at
_MIN_FRAMES = 8  # that an estimate needs
_MIN_POINTS = 50  # the same, of each frame
_MOSTLY = 0.5  # share of a frame's points outside of the map's bounds, where the frame lies outside
_TINY = 1e-12
# What motions leave of a column, as a share of the points' distances from the camera: before a flat
# wall 1 %, which is noise of the map's gradients; in rooms 10 % and more.
_MIN_LEFT = 0.03
_NEGLIGIBLE = 0.01  # share by which depths may misfit (our choice)
_RESAMPLED = 200  # draws of a bootstrap
_INTERVAL = [0.025, 0.975]  # its quantiles
_EXPLANATIONS = {  # how a point changes with each: factors of its x, y and z
    "depths": np.array([1.0, 1.0, 1.0]),
    "focal lengths": np.array([-1.0, -1.0, 0.0]),
}


def check_belongs(finished: Map, frame: Frame) -> str | None:
    """A warning where it cannot be told whether a map belongs to a frame; None where it does.

    The rule: its misfit is at most 5 cm, or three times what is usual in the map's own frames.
    Raises DataError if it is more.
    """
    name = f"the map of {finished.record['scene']}"
    usual = finished.record["misfit_m"]
    misfit_m = depth_residual_of(finished.field, frame)
    if np.isnan(misfit_m):
        return f"{frame.name} has no depth: whether {name} belongs to it cannot be told"
    allowed = max(MISFIT_ALLOWED, MISFIT_FACTOR * usual)
    if misfit_m > allowed:
        raise DataError(
            f"at its given pose {frame.name} is off {name} by {misfit_m:.3f} m (usual in this map "
            f"{usual:.3f} m, allowed {allowed:.3f} m): give the room's own map, poses in the map's "
            "world frame, begin where it was mapped, or let the camera be found: --start unknown"
        )
    return None


def in_world_of_map(tracked: Trajectory) -> tuple[Trajectory, bool]:
    """The trajectory with true poses in the map's world, and whether they were in another one."""
    T_map_world = other_world(tracked.T_estimated, tracked.T_true)
    if T_map_world is None:
        return tracked, False
    T_true = T_map_world @ tracked.T_true  # NaN stays
    is_known = np.isfinite(T_true).all(axis=(1, 2))
    frames = tracked.frames.copy()
    columns = ["translation_error_m", "rotation_error_deg"]
    errors = pose_errors(tracked.T_estimated[is_known], T_true[is_known])
    frames.loc[is_known, columns] = np.column_stack(errors)
    return replace(tracked, T_true=T_true, frames=frames), True


def other_world(T_estimated: Poses, T_true: Poses) -> Pose | None:
    """The one rigid motion (m) from true to estimated poses that explains the errors of a run.

    After it those of most frames are below `LOST_THRESHOLD_M` and a tenth of what they were (our
    choice); None where no motion does that, or too little is known to tell.
    """
    is_known = np.isfinite(T_true).all(axis=(1, 2))
    if is_known.sum() < 3:
        return None
    T_estimated, T_true = T_estimated[is_known], T_true[is_known]
    # From orientations too, which tell it where the camera moves along a line.
    turns = Rotation.from_matrix(T_estimated[:, :3, :3] @ T_true[:, :3, :3].mT)
    T_map_world = np.eye(4)
    is_usual = (turns.mean().inv() * turns).magnitude()
    is_usual = is_usual <= np.median(is_usual)  # lost frames say nothing of it
    T_map_world[:3, :3] = turns[is_usual].mean().as_matrix()
    moved = T_true[:, :3, 3] @ T_map_world[:3, :3].T
    T_map_world[:3, 3] = np.median(T_estimated[:, :3, 3] - moved, axis=0)
    before, after = (pose_errors(T_estimated, T)[0] for T in (T_true, T_map_world @ T_true))
    explained = np.median(after) < min(LOST_THRESHOLD_M, np.median(before) / 10)
    return T_map_world if explained and np.median(before) > LOST_THRESHOLD_M else None


def look_in_map(field: Field, sequence: RgbdSequence, T_estimated: Poses) -> dict[str, float | str]:
    """Look at some frames, spread evenly: whether what they measured lies outside of the map, at
    their true poses where known, and how it misfits at the estimated ones.

    Returns `outside_map_share`, that of the frames that saw little of what was mapped, and
    `map_misfit`, a sentence, which is empty where nothing misfits.
    """
    outside = []
    sums = []
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])
    for index in range(0, len(sequence), math.ceil(len(sequence) / _N_FRAMES)):
        frame = sequence[index]
        pixels = frame.measured_pixels()
        if not pixels.shape[1]:
            continue
        drawn = np.random.default_rng(index).permutation(pixels.shape[1])[:_N_POINTS]
        points = frame.points(*pixels[:, drawn])[0].double().numpy()
        T = sequence.T_world_camera[index]
        world = _moved(points, T if np.isfinite(T).all() else T_estimated[index])
        outside.append(((world < low) | (world > high)).any(axis=1).mean() > _MOSTLY)
        if field.is_distance:
            sums.append(_without_motion(field, points, T_estimated[index]))
    sums = [part for part in sums if part is not None]
    misfit = _misfit(np.array(sums)) if len(sums) >= _MIN_FRAMES else ""
    return {"outside_map_share": float(np.mean(outside or [0.0])), "map_misfit": misfit}


def _moved(points: WorldPoints, T_world_camera: Pose) -> WorldPoints:
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def _without_motion(field: Field, points: WorldPoints, T: Pose) -> Float[np.ndarray, "4 2"] | None:
    """A column an explanation, motions projected out: its products with residuals and with itself,
    the sum of squared distances, and the variance of residuals (m²); None of few. Points are in the
    camera's frame (m)."""
    x = torch.from_numpy(_moved(points, T)).float().to(field.device).requires_grad_()
    distance = field(x)[1]
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    r = distance.detach().cpu().double().numpy()
    near = np.abs(r) < _MAX_DISTANCE
    if near.sum() < _MIN_POINTS:
        return None
    q = (gradient.cpu().double().numpy() @ T[:3, :3])[near]
    p = points[near]
    motions, _ = np.linalg.qr(np.hstack([np.cross(p, q), q]))
    columns = np.column_stack([r[near], *((q * p) @ change for change in _EXPLANATIONS.values())])
    columns -= motions @ (motions.T @ columns)
    squares = (columns**2).sum(axis=0)
    products = columns[:, 1:].T @ columns[:, 0]
    return np.stack([products, squares[1:], 2 * [(p**2).sum()], 2 * [squares[0] / len(p)]])


def _misfit(sums: Float[np.ndarray, "frames 4 2"]) -> str:
    """A sentence on the explanation that takes most off the residuals, if it is not negligible."""
    drawn = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLED, len(sums)))
    products, squares, _, _ = np.moveaxis(sums[drawn].sum(axis=1), 1, 0)
    low, high = np.quantile(products / squares.clip(_TINY), _INTERVAL, axis=0)
    products, squares, far, variance = sums.sum(axis=0)
    shares = products / squares.clip(_TINY)
    # With up to three walls in view a motion does the same as a scale, which is then not known.
    error = np.sqrt(variance / len(sums) / squares.clip(_TINY))
    is_told = (error < _NEGLIGIBLE / 2) & (squares > _MIN_LEFT**2 * far)
    gains = np.where(is_told, products * shares, 0.0)
    best = int(gains.argmax())
    low, high = low[best], high[best]
    if not gains.any() or (low <= _NEGLIGIBLE and high >= -_NEGLIGIBLE):
        return ""
    name = [*_EXPLANATIONS][best]
    return (
        f"residuals in the map grow with depth, as if {name} were off by {shares[best]:+.1%} "
        f"({low:+.1%} to {high:+.1%}), or somewhat more, against those of the map: compare both by "
        "`data check`"
    )
