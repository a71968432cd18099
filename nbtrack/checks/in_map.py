"""Whether a map and a recording belong together and share a world."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Pose, Poses
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.machinery.errors import DataError
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import misfit_of
from nbtrack.tracking.metrics import LOST_THRESHOLD_M, pose_errors
from nbtrack.tracking.trajectories import Trajectory

# A map is refused if the misfit of a frame exceeds both limits. In nine maps of three rooms (one a
# real recording) frames of the same room had at most 0.024 m, and of other rooms at least 0.095 m.
_MISFIT_FACTOR = 3.0  # times the usual misfit of the map's own frames
_MISFIT_ALLOWED = 0.05  # m
# `outside_map_share` looks at so many frames of a run at most, and about so many points of each. A
# frame lies outside if a larger share of its points than `_MOSTLY` is outside of the map's bounds.
_N_FRAMES = 40
_N_POINTS = 500
_MOSTLY = 0.5


def check_belongs(finished: Map, frame: Frame) -> str | None:
    """Check that a frame was seen in a map's room, and that its pose is in the map's world frame.

    Raises DataError if the map's misfit in the frame, at the given pose, is above 5 cm and above
    three times what is usual in the map's own frames. If the frame has no depth, nothing can be
    told: then a warning is returned. Otherwise None is returned.
    """
    name = f"the map of {finished.record['scene']}"
    usual = finished.record["misfit_m"]
    misfit_m = misfit_of(finished.field, frame)
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
    """Move a trajectory's true poses into the map's world, if `other_world` finds them in another.

    Returns the trajectory, whose errors are those against the moved poses, and whether any pose was
    moved.
    """
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
    """The rigid motion T_map_world (m) that moves true poses from their world into the map's.

    It is None if the true poses seem to be in the map's world already, if no motion explains the
    errors of the estimates, or if fewer than three frames have a true pose. A motion explains the
    errors if their median is above `LOST_THRESHOLD_M` before it, and after it is below this
    threshold and below a tenth of what it was (our choice).
    """
    is_known = np.isfinite(T_true).all(axis=(1, 2))
    if is_known.sum() < 3:
        return None
    T_estimated, T_true = T_estimated[is_known], T_true[is_known]
    # The rotation is computed from orientations, since positions do not determine it if the camera
    # moves along a line. Only the half of the frames that agree best is used: others may be lost.
    turns = Rotation.from_matrix(T_estimated[:, :3, :3] @ T_true[:, :3, :3].mT)
    off_mean = (turns.mean().inv() * turns).magnitude()
    agrees = off_mean <= np.median(off_mean)
    T_map_world = np.eye(4)
    T_map_world[:3, :3] = turns[agrees].mean().as_matrix()
    turned_positions = T_true[:, :3, 3] @ T_map_world[:3, :3].T
    T_map_world[:3, 3] = np.median(T_estimated[:, :3, 3] - turned_positions, axis=0)
    errors_m, _ = pose_errors(T_estimated, T_true)
    left_m, _ = pose_errors(T_estimated, T_map_world @ T_true)
    usual_m = np.median(errors_m)
    is_explained = np.median(left_m) < min(LOST_THRESHOLD_M, usual_m / 10)
    return T_map_world if usual_m > LOST_THRESHOLD_M and is_explained else None


def outside_map_share(field: Field, sequence: RgbdSequence, T_estimated: Poses) -> float:
    """The share of a run's frames that see mostly what lies outside of the map's bounds.

    At most `_N_FRAMES` evenly spread frames are looked at. Frames without depth do not count; if no
    other is left, the share is 0. Points are placed by the true pose of their frame if it is known,
    else by the estimated one.
    """
    outside = []
    stride = math.ceil((sequence.depths_mm[0].size / _N_POINTS) ** 0.5)
    for index in range(0, len(sequence), math.ceil(len(sequence) / _N_FRAMES)):
        frame = sequence[index]
        points_camera, _ = frame.points(*frame.measured_pixels(stride))
        T = T_estimated[index] if frame.T_world_camera is None else frame.T_world_camera
        points_world = points_camera.double().numpy() @ T[:3, :3].T + T[:3, 3]
        is_outside = (points_world < field.bounds.minimum) | (points_world > field.bounds.maximum)
        if len(points_world):
            outside.append(is_outside.any(axis=1).mean() > _MOSTLY)
    return float(np.mean(outside)) if outside else 0.0
