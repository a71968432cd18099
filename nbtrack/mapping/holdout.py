"""Which frames are held out from mapping, and how far a map is from what a frame measured."""

import numpy as np
import torch

from nbtrack.core.arrays import Frames
from nbtrack.core.camera import pixel_directions
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField
from nbtrack.machinery.inputs import checked_pose

_MISFIT_PIXELS = 500  # random pixels of a frame from which its misfit is computed
_MISFIT_FRAMES = 10  # mapped frames from which a map's usual misfit is computed


def split_holdout(n_frames: int, every: int) -> tuple[Frames, Frames]:
    """Indices of the frames to map, and of the frames held out for scoring.

    Every `every`-th frame is held out, beginning with frame `every // 2`. None is held out if
    `every` is below 2 or larger than the number of frames.

    >>> split_holdout(6, 3)
    (array([0, 2, 3, 5]), array([1, 4]))
    """
    indices = np.arange(n_frames)
    held_out = indices[every // 2 :: every] if 2 <= every <= n_frames else indices[:0]
    return np.setdiff1d(indices, held_out), held_out


def misfit_of(field: Field, frame: Frame) -> float:
    """The misfit (m) of a map in a frame: how far the map is off what the frame measured.

    It is a median over random measured pixels, at the frame's true pose: of |rendered depth -
    measured depth| for a field that can be rendered; for points and grids, of the absolute distance
    that the field has at the measured points. It is NaN for a frame without measured depth. Raises
    DataError for a frame with depth whose pose is not known.
    """
    if not frame.has_depth:
        return float("nan")
    frame = frame.to(field.device)
    pixels = frame.measured_pixels()
    order = torch.randperm(pixels.shape[1], generator=torch.Generator().manual_seed(0))
    rows, columns = pixels[:, order[:_MISFIT_PIXELS].to(pixels.device)]
    T_world_camera = torch.from_numpy(checked_pose(frame.T_world_camera)).float().to(rows.device)
    if not isinstance(field, LearnedField):
        points_camera, _ = frame.points(rows, columns)
        _, distance = field(transform_points(T_world_camera, points_camera))
        return float(distance.abs().median())
    directions_world = pixel_directions(frame.camera, columns, rows) @ T_world_camera[:3, :3].T
    origins_world = T_world_camera[:3, 3].expand_as(directions_world)
    _, rendered_depth = field.render_rays(origins_world, directions_world)
    _, measured_depth = frame.at(rows, columns)
    return float((rendered_depth - measured_depth).abs().median())


def usual_misfit(field: Field, sequence: RgbdSequence, mapped: Frames) -> float:
    """A map's usual misfit (m): the median misfit in at most ten mapped frames, evenly spread.

    It is 0 if none of them has depth. `check_belongs` then allows its minimum, 5 cm.
    """
    spread = np.linspace(0, len(mapped) - 1, min(_MISFIT_FRAMES, len(mapped))).round().astype(int)
    frames = [sequence[index] for index in mapped[spread].tolist()]
    misfits = [misfit_of(field, frame) for frame in frames if frame.has_depth]
    return float(np.median(misfits)) if misfits else 0.0
