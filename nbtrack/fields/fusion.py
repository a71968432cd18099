"""Measured pixels of posed frames, averaged by voxel: the map of classical registration."""

import numpy as np
import torch
from jaxtyping import Float, Int

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import backproject
from nbtrack.data.sequence import RgbdSequence

_FRAMES_AT_ONCE = 8  # frames whose voxels wait to be merged: what the memory is bounded by

# Sorted voxel numbers, and for each the sums of x, y, z (m), red, green, blue, and one a pixel.
_Sums = tuple[Int[np.ndarray, "voxels"], Float[np.ndarray, "voxels 7"]]


def fuse_points(
    sequence: RgbdSequence, frames: Int[np.ndarray, "frames"], bounds: SceneBounds, voxel: float
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
    """One point a voxel: mean position (m, world frame) and mean colour (in [0, 1]).

    All of the frames' measured pixels inside the bounds count. The mean takes noise off, and
    the mean of points on a plane lies on the plane. Memory grows with the surface that was
    seen, not with the number of frames.

    Args:
        frames: indices of the frames to fuse.
        voxel: edge length of the cubic cells, m.
    """
    low = np.array(bounds.minimum)
    shape = np.floor((np.array(bounds.maximum) - low) / voxel).astype(np.int64) + 1
    total: _Sums = (np.empty(0, np.int64), np.empty((0, 7)))
    pending = []
    for count, index in enumerate(frames.tolist(), start=1):
        points, colors = _measured_points(sequence, index)
        cells = np.floor((points - low) / voxel).astype(np.int64)
        inside = ((cells >= 0) & (cells < shape)).all(axis=1)
        voxels = np.ravel_multi_index(tuple(cells[inside].T), tuple(shape))
        values = np.concatenate([points, colors, np.ones((len(points), 1))], axis=1)[inside]
        pending.append(_summed(voxels, values))
        if count % _FRAMES_AT_ONCE == 0 or count == len(frames):
            voxels, values = zip(total, *pending, strict=True)
            total = _summed(np.concatenate(voxels), np.concatenate(values))
            pending = []
    means = total[1][:, :6] / total[1][:, 6:]
    return means[:, :3].astype(np.float32), means[:, 3:].astype(np.float32)


def _summed(voxels: Int[np.ndarray, "n"], values: Float[np.ndarray, "n 7"]) -> _Sums:
    """Sums of the rows that share a voxel."""
    distinct, which = np.unique(voxels, return_inverse=True)
    columns = [np.bincount(which, column, len(distinct)) for column in values.T]
    return distinct, np.stack(columns, axis=1)


def _measured_points(
    sequence: RgbdSequence, index: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """World points (m) and colours (in [0, 1]) of a frame's measured pixels."""
    depth = torch.from_numpy(sequence.depth(index))
    rows, columns = torch.nonzero(depth, as_tuple=True)
    points_camera = backproject(sequence.intrinsics, columns, rows, depth[rows, columns])
    T_world_camera = sequence.T_world_camera[index]
    points = points_camera.double().numpy() @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    return points, sequence.colors[index][rows.numpy(), columns.numpy()] / 255.0
