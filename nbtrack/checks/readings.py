"""How the numbers of a recording are read, and how well its frames then agree.

Read rightly, the surfaces that two frames both see coincide.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int, UInt16
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.core.arrays import Frames, Poses
from nbtrack.core.camera import Intrinsics, pixel_directions, project
from nbtrack.data.sequence import RgbdSequence
from nbtrack.recordings.formats import Declaration
from nbtrack.recordings.recording import Recording

_HIDDEN_BEHIND = 0.25  # m behind a surface points are hidden: several times a camera's noise
_SAME_SURFACE = 0.025  # of the depth: where neighbours blend to more, they lie on two surfaces
_POINTS_PER_FRAME = 1000  # 20 pairs of frames have enough for a median
_SMOOTHED = 5  # frames, over which positions are averaged
Pairs = Int[np.ndarray, "2 pairs"]  # of frames


@dataclass(frozen=True)
class Reading:
    """One way to read a recording. Lengths and shares that are 0 are as declared."""

    declared: Declaration
    camera: Intrinsics
    metres: float = 1.0  # of one unit of the poses' positions
    focal_share: float = 0.0  # by which focal lengths are longer
    depth_share: float = 0.0  # by which depths are longer
    depth_growth: float = 0.0  # share by which depths are longer in the end than at first
    depth_shift: int = 0  # frames by which depth is late
    drift_x: float = 0.0  # m, by which positions are too far along x in the end
    drift_y: float = 0.0
    drift_z: float = 0.0
    scatter: float = 0.0  # m, by which positions scatter, in the mean square
    color_shift: int = 0  # frames by which colours are late
    color_right: float = 0.0  # by which colours are too far right, as a share of the width
    is_mirrored: bool = False  # colours alone

    @property
    def calibration(self) -> Intrinsics:
        """The camera with its focal lengths changed."""
        factor = 1 + self.focal_share
        return replace(self.camera, fx=factor * self.camera.fx, fy=factor * self.camera.fy)

    def points(self, columns: Tensor, rows: Tensor, values: Tensor) -> Tensor:
        """Points (..., 3; m, camera frame) of pixels with depth values as in the files."""
        directions = pixel_directions(self.calibration, columns, rows)
        if self.declared.depth_along == "ray":
            directions = directions / directions.norm(dim=-1, keepdim=True)
        metres = values * ((1 + self.depth_share) / self.declared.depth_scale)
        return directions * metres[..., None]

    def T_world_camera(self, file_poses: Poses, order: str) -> Poses:
        """Camera-to-world poses with OpenCV axes, of a file read with this order of quaternions."""
        T = file_poses.copy()
        if self.declared.quaternion != order:
            numbers = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=order == "wxyz")
            T[:, :3, :3] = Rotation.from_quat(numbers, scalar_first=order == "xyzw").as_matrix()
        T[:, :3, 3] *= self.metres
        T = self.declared.poses_to_opencv(T)
        drift = [self.drift_x, self.drift_y, self.drift_z]
        T[:, :3, 3] -= np.outer(np.linspace(0, 1, len(T)), drift)
        # Scattered positions move towards the averages over their neighbours.
        off = T[:, :3, 3] - uniform_filter1d(T[:, :3, 3], _SMOOTHED, axis=0, mode="nearest")
        T[:, :3, 3] -= self.scatter * off / max(1e-9, np.sqrt((off**2).sum(axis=1).mean()))
        return T


def on_grid(values: UInt16[np.ndarray, "frames h w"], stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows (n,) of every `stride`-th pixel of each axis, and values (frames, n)."""
    some = torch.from_numpy(values[:, ::stride, ::stride].astype(np.float32))
    rows, columns = (stride * torch.from_numpy(np.indices(some.shape[1:]))).flatten(1)
    return columns, rows, some.flatten(1)


class Comparison(NamedTuple):
    """Points of first frames beside what the second ones measured: (pairs, points) each."""

    residual: Tensor  # m, by which points lie behind the surface that was measured
    measured: Tensor  # m, the depth of that surface
    is_valid: Tensor  # False where hidden, outside, or between two surfaces
    seen_at: Tensor  # (pairs, 1, points, 2): -1 at the first pixel, 1 at the last


class FramePairs:
    """Pairs of frames that see much the same, to be read in one way or another."""

    def __init__(self, recording: Recording, ids: Frames, kept: RgbdSequence, pairs: Pairs) -> None:
        """Pairs are positions in the numbers of a recording's frames that have a pose; of these,
        those of the pairs are kept, with depth values as in the files."""
        self.pairs = pairs
        self.file_poses = recording.file_poses[ids]
        self.order = recording.declared.quaternion
        self.colors = kept.colors
        self.places = np.searchsorted(kept.frame_ids, ids[pairs])
        first, second = kept.depths_mm[self.places]
        stride = math.ceil((math.prod(first.shape[1:]) / _POINTS_PER_FRAME) ** 0.5)
        self.columns, self.rows, self.values = on_grid(first, stride)
        self.inverse = 1 / torch.from_numpy(second[:, None].astype(np.float32))

    def compare(self, reading: Reading) -> Comparison:
        """Points of first frames, seen from the second ones.

        Depth is interpolated between four pixels, in 1/z, which is exact for planes.
        """
        growth = reading.depth_growth * (self.pairs / len(self.file_poses) - 0.5)
        longer_a, longer_b = torch.from_numpy(1 + growth[..., None]).float()
        points_a = reading.points(self.columns, self.rows, self.values / longer_a)
        poses = reading.T_world_camera(self.file_poses, self.order)
        T_world_a, T_world_b = poses[self.pairs - reading.depth_shift]
        T_b_a = torch.from_numpy(np.linalg.solve(T_world_b, T_world_a)).float()
        points_b = points_a @ T_b_a[:, :3, :3].mT + T_b_a[:, None, :3, 3]
        columns, rows, depth = project(reading.calibration, points_b)
        height, width = self.inverse.shape[2:]
        at = 2 * torch.stack([columns / (width - 1), rows / (height - 1)], dim=-1)[:, None] - 1
        blended, nearest = (
            1 / grid_sample(self.inverse, at, mode, align_corners=True)[:, 0, 0]
            for mode in ("bilinear", "nearest")
        )
        measured = reading.points(columns, rows, blended / longer_b)[..., 2]
        valid = (self.values > 0) & (depth > 1e-6) & (at.abs() <= 1).all(dim=-1)[:, 0]
        valid &= (blended / nearest - 1).abs() < _SAME_SURFACE  # false where there is no depth
        valid &= depth - measured < _HIDDEN_BEHIND  # but in front is a contradiction, however far
        return Comparison(depth - measured, measured, valid, at)
