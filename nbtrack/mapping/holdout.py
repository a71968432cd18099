"""Which frames are kept back from mapping, and whether a map belongs to a frame."""

import numpy as np
import torch

from nbtrack.core.arrays import Frames
from nbtrack.core.camera import pixel_directions
from nbtrack.core.errors import DataError
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField
from nbtrack.mapping.files import Map

_MISFIT_PIXELS, _MISFIT_FRAMES = 500, 10
# A map is refused where its misfit exceeds both. Measured on nine maps of three rooms (one a real
# recording): frames of the same room 0.024 m at most, of other rooms 0.095 m at least.
MISFIT_FACTOR, MISFIT_ALLOWED = 3.0, 0.05  # times what is usual in the map's own frames; m


def split_holdout(n_frames: int, every: int) -> tuple[Frames, Frames]:
    """Indices of the frames to map and of those kept back for scoring.

    Every `every`-th frame is kept back, beginning in the middle of the first stretch; with
    `every` = 0, or too few frames, none is.

    >>> split_holdout(6, 3)
    (array([0, 2, 3, 5]), array([1, 4]))
    """
    indices = np.arange(n_frames)
    if every < 2 or n_frames < every:
        return indices, indices[:0]
    held_out = indices[every // 2 :: every]
    return np.setdiff1d(indices, held_out), held_out


def depth_residual_of(field: Field, frame: Frame) -> float:
    """How far (m) a map is from what a frame measured, at the frame's given pose.

    The median over random pixels of |rendered depth - measured depth|; of points and grids, which
    cannot be rendered, the distance at what was measured. NaN where nothing was.
    """
    if not frame.has_depth:
        return float("nan")
    frame = frame.to(field.device)
    pixels = frame.measured_pixels()
    order = torch.randperm(pixels.shape[1], generator=torch.Generator().manual_seed(0))
    rows, columns = pixels[:, order[:_MISFIT_PIXELS].to(pixels.device)]
    T_world_camera = torch.from_numpy(frame.T_world_camera).float().to(rows.device)
    if not isinstance(field, LearnedField):
        points_world = transform_points(T_world_camera, frame.points(rows, columns)[0])
        return float(field(points_world)[1].abs().median())
    directions = pixel_directions(frame.camera, columns, rows) @ T_world_camera[:3, :3].T
    origins, measured = T_world_camera[:3, 3].expand_as(directions), frame.at(rows, columns)[1]
    return float((field.render_rays(origins, directions)[1] - measured).abs().median())


def usual_depth_residual(field: Field, sequence: RgbdSequence, mapped: Frames) -> float:
    """The median misfit (m) of some of the mapped frames, evenly spread; 0 if none has a depth."""
    spread = np.linspace(0, len(mapped) - 1, min(_MISFIT_FRAMES, len(mapped))).round().astype(int)
    frames = [sequence[index] for index in mapped[spread].tolist()]
    return float(np.median([depth_residual_of(field, f) for f in frames if f.has_depth] or [0.0]))


def check_belongs(finished: Map, frame: Frame) -> str | None:
    """A warning where it cannot be told whether a map belongs to a frame; None where it does.

    The rule: its misfit is at most 5 cm, or three times what is usual in the map's own frames.
    Raises DataError if it is more.
    """
    name, usual = f"the map of {finished.record['scene']}", finished.record["misfit_m"]
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
