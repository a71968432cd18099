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
from nbtrack.mapping.holdout import depth_residual_of
from nbtrack.tracking.metrics import LOST_THRESHOLD_M, pose_errors
from nbtrack.tracking.trajectories import Trajectory

# A map is refused if the misfit of a frame exceeds both limits. In nine maps of three rooms (one a
# real recording) frames of the same room had at most 0.024 m, and of other rooms at least 0.095 m.
_MISFIT_FACTOR = 3.0  # times the usual misfit of the map's own frames
_MISFIT_ALLOWED = 0.05  # m
_N_FRAMES = 40  # of a run, at most, are looked at
_N_POINTS = 500  # of each frame, at most, are looked at
_MOSTLY = 0.5  # a frame lies outside if a larger share of its points is outside of the map's bounds


def check_belongs(finished: Map, frame: Frame) -> str | None:
    """Check that a frame was seen in a map's room, in the same world frame; DataError if not.

    The misfit is the frame's depth residual at its given pose. It may be at most 5 cm, or three
    times what is usual in the map's own frames. Returns a warning if the frame has no depth, so
    that nothing can be told, and otherwise None.
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
    """Move a trajectory's true poses into the map's world, if they are in another one.

    Returns the trajectory, with errors against the moved poses, and whether it was changed.
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
    """The rigid motion T_map_world (m) that explains a run's errors, or None if there is none.

    True poses are then given in another world frame than the map's. A motion explains the errors if
    their median was above `LOST_THRESHOLD_M`, and after the motion of the true poses is below it
    and below a tenth of what it was (our choice). The result is also None if fewer than three
    frames have a true pose.
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
    """The share of a run's frames of which most points lie outside of the map's bounds.

    Some evenly spread frames are looked at, and those without depth do not count; 0 if none is
    left. Points are placed by the true pose of their frame if it is known, else by the estimated
    one.
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
