"""Whether a map and a recording belong together, share a world, and where they misfit.

Of depths that misfit: at a pose that is right but for a little, a measured point p (camera frame)
has a distance r in the map, whose gradient is q (camera frame). If all depths of the recording are
too long by a share s, r = s (q . p) plus what a small motion of the camera explains; if its focal
lengths are too long, p changes across the axis alone. The motions are projected out of each frame,
and the share that leaves the least of r is estimated as `data check` estimates its misfits.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.checks.misfits import SHARES, Misfit, Parameter, estimate, main_misfit
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
# What motions leave of an explanation, as a share of the points' distances from the camera: before
# a flat wall 1 %, which is noise of the map's gradients; in rooms 10 % and more.
_MIN_LEFT = 0.03
_SENTENCE = "residuals in the map grow with depth, as if {} were off by"
_ADVICE = "the share may be larger; compare both recordings by `data check`"
# What misfits, and how a point changes with it: factors of its x, y and z.
_EXPLANATIONS = [
    (Parameter("", _SENTENCE.format(name), "+.1%", "", SHARES, 0.01, _ADVICE), np.array(factors))
    for name, factors in (("depths", (1, 1, 1)), ("focal lengths", (-1, -1, 0)))
]


class _Unexplained(NamedTuple):
    """What no motion of the camera explains of a frame: (points) of each."""

    residuals: Float[np.ndarray, "n"]  # m
    shares: Float[np.ndarray, "n explanations"]  # by how much (m) each changes them
    squares: float  # of the points' distances from the camera, their sum


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
    unexplained = []
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
            unexplained.extend(_without_motion(field, points, T_estimated[index]))
    misfit = main_misfit([*_misfits(unexplained)])
    return {"outside_map_share": float(np.mean(outside or [0.0])), "map_misfit": misfit}


def _moved(points: WorldPoints, T_world_camera: Pose) -> WorldPoints:
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def _without_motion(field: Field, points: WorldPoints, T: Pose) -> Iterator[_Unexplained]:
    """What motions leave of points (m, camera frame) of a frame at its pose; nothing of few."""
    x = torch.from_numpy(_moved(points, T)).float().to(field.device).requires_grad_()
    distance = field(x)[1]
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    r = distance.detach().cpu().double().numpy()
    near = np.abs(r) < _MAX_DISTANCE
    if near.sum() < _MIN_POINTS:
        return
    q = (gradient.cpu().double().numpy() @ T[:3, :3])[near]
    p = points[near]
    motions, _ = np.linalg.qr(np.hstack([np.cross(p, q), q]))
    columns = np.column_stack([r[near], *((q * p) @ factors for _, factors in _EXPLANATIONS)])
    columns -= motions @ (motions.T @ columns)
    yield _Unexplained(columns[:, 0], columns[:, 1:], (p**2).sum())


def _misfits(frames: list[_Unexplained]) -> Iterator[Misfit]:
    """Of each explanation how far it is off, if frames tell: with up to three walls in view, a
    motion does the same."""
    if len(frames) < _MIN_FRAMES:
        return
    for i, (parameter, _) in enumerate(_EXPLANATIONS):
        left = sum((frame.shares[:, i] ** 2).sum() for frame in frames)
        if left > _MIN_LEFT**2 * sum(frame.squares for frame in frames):
            costs = [
                ((frame.residuals[:, None] - frame.shares[:, i, None] * SHARES) ** 2).sum(axis=0)
                for frame in frames
            ]
            yield estimate(parameter, np.array(costs))
