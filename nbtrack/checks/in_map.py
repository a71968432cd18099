"""Whether a map and a recording belong together, share a world, and see the same."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Pose, Poses
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
_MISFIT_FACTOR = 3.0  # times what is usual in the map's own frames
_MISFIT_ALLOWED = 0.05  # m
_N_FRAMES = 40  # looked at
_STRIDE = 4  # pixels between two that are looked at
_MOSTLY = 0.5  # share of a frame's points outside of the map's bounds, where the frame lies outside


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
    allowed = max(_MISFIT_ALLOWED, _MISFIT_FACTOR * usual)
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


def outside_map_share(field: Field, sequence: RgbdSequence, T_estimated: Poses) -> float:
    """The share of some frames, spread evenly, that saw little of what was mapped: most of their
    points lie outside of the map, at their true poses where known, else at the estimated ones."""
    outside = []
    for index in range(0, len(sequence), math.ceil(len(sequence) / _N_FRAMES)):
        frame = sequence[index]
        points, _ = frame.points(*frame.measured_pixels(_STRIDE))
        T = T_estimated[index] if frame.T_world_camera is None else frame.T_world_camera
        world = points.numpy() @ T[:3, :3].T + T[:3, 3]
        is_outside = (world < field.bounds.minimum) | (world > field.bounds.maximum)
        if len(world):
            outside.append(is_outside.any(axis=1).mean() > _MOSTLY)
    return float(np.mean(outside or [0.0]))
