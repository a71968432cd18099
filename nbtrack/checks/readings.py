"""How the numbers of a recording are read, and how well its frames then agree.

Read rightly, the surfaces that two frames both see coincide.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt16
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
_SCALE = 0.01  # of the depth: surfaces so far apart agree by half, several times a camera's noise
_SAME = 0.2  # least agreement of points whose colours are compared: surfaces 2 * _SCALE apart
_MIN_OVERLAP = 0.1  # share of a pair's points without which its cost is none
_MIN_CONTRAST = 0.02  # standard deviation of intensities in [0, 1], below which nothing is seen
_POINTS_PER_FRAME = 1000  # 20 pairs of frames have enough for a median
_SMOOTHED = 5  # frames, over which positions are averaged
Pairs = Int[np.ndarray, "2 pairs"]  # of frames
Costs = Float[np.ndarray, "pairs"]


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
        z = values / self.declared.depth_scale  # m
        if self.declared.depth_along == "ray":
            z = z / directions.norm(dim=-1)
        z = z * (1 + self.depth_share + self.declared.depth_error_per_m * z)
        return directions * z[..., None]

    def T_world_camera(self, file_poses: Poses, order: str) -> Poses:
        """Camera-to-world poses with OpenCV's camera axes.

        `file_poses` are as the file has them, their quaternions read in the order `order`.
        """
        T_file = file_poses.copy()
        if self.declared.quaternion != order:  # the file's four numbers, read the other way
            w_first = order == "wxyz"
            numbers = Rotation.from_matrix(T_file[:, :3, :3]).as_quat(scalar_first=w_first)
            T_file[:, :3, :3] = Rotation.from_quat(numbers, scalar_first=not w_first).as_matrix()
        T_file[:, :3, 3] *= self.metres
        T_world_camera = self.declared.poses_to_opencv(T_file)
        drift = [self.drift_x, self.drift_y, self.drift_z]  # m, in the end
        positions = T_world_camera[:, :3, 3] - np.outer(np.linspace(0, 1, len(T_file)), drift)
        # Positions move towards averages over their neighbours, by `scatter` in root mean square.
        off = positions - uniform_filter1d(positions, _SMOOTHED, axis=0, mode="nearest")
        mean_off = np.sqrt((off**2).sum(axis=1).mean())
        T_world_camera[:, :3, 3] = positions - self.scatter * off / max(1e-9, mean_off)
        return T_world_camera


def on_grid(values: UInt16[np.ndarray, "frames h w"], stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows (n,) of every `stride`-th pixel along each axis, and values (frames, n)."""
    some = torch.from_numpy(values[:, ::stride, ::stride].astype(np.float32))
    rows, columns = (stride * torch.from_numpy(np.indices(some.shape[1:]))).flatten(1)
    return columns, rows, some.flatten(1)


class Comparison(NamedTuple):
    """Points of first frames beside what the second ones measured: (pairs, points) each."""

    residual: Tensor  # m, by which points lie behind the surface that was measured
    measured: Tensor  # m, the depth of that surface
    is_valid: Tensor  # False where hidden, outside, or between two surfaces
    agreement: Tensor  # 1 where both coincide, 0 where they are far apart or not valid
    seen_at: Tensor  # (pairs, 1, points, 2): -1 at the first pixel, 1 at the last


class FramePairs:
    """Pairs of frames that see much the same, to be read in one way or another."""

    def __init__(self, recording: Recording, ids: Frames, kept: RgbdSequence, pairs: Pairs) -> None:
        """Take the frames of pairs from a sequence whose depth values are as in the files.

        `ids` are the numbers of the recording's frames that have a pose, and `pairs` are indices in
        `ids`. Points are those of the first frame of each pair. `kept` also holds frames around
        those of the pairs where `color_costs` is to shift colours against depth.
        """
        self.pairs = pairs
        self.file_poses = recording.file_poses[ids]
        self.order = recording.declared.quaternion
        self.colors = kept.colors
        self.places = np.searchsorted(kept.frame_ids, ids[pairs])  # of pairs in `kept`
        first, second = kept.depths_mm[self.places]  # the files' values, in their unit
        stride = math.ceil((math.prod(first.shape[1:]) / _POINTS_PER_FRAME) ** 0.5)
        self.columns, self.rows, self.values = on_grid(first, stride)  # of the points
        # Of the second frames; infinite without a depth.
        self.inverse_values = 1 / torch.from_numpy(second[:, None].astype(np.float32))

    def compare(self, reading: Reading) -> Comparison:
        """Points of the first frames a beside what was measured in the second ones b.

        Depth is interpolated between four pixels, in 1/z, which is exact for planes.
        """
        longer_a, longer_b = self._longer(reading)
        points_a = reading.points(self.columns, self.rows, self.values / longer_a)
        T_b_a = self._T_second_first(reading)
        points_b = points_a @ T_b_a[:, :3, :3].mT + T_b_a[:, None, :3, 3]
        columns, rows, depth = project(reading.calibration, points_b)
        at = self._on_images(columns, rows)[:, None]  # (pairs, 1, points, 2)
        blended = 1 / grid_sample(self.inverse_values, at, "bilinear", align_corners=True)[:, 0, 0]
        nearest = 1 / grid_sample(self.inverse_values, at, "nearest", align_corners=True)[:, 0, 0]
        _, _, measured = reading.points(columns, rows, blended / longer_b).unbind(-1)  # z-depth
        residual = depth - measured
        is_valid = (self.values > 0) & (depth > 1e-6) & (at.abs() <= 1).all(dim=-1)[:, 0]
        is_valid &= (blended / nearest - 1).abs() < _SAME_SURFACE  # false where there is no depth
        # A point far in front of the surface stays: it contradicts, while one behind is hidden.
        is_valid &= residual < _HIDDEN_BEHIND
        # The weight of Geman and McClure of the difference, as a share of the depth.
        agreement = torch.where(is_valid, 1 / (1 + (residual / measured / _SCALE) ** 2), 0.0)
        return Comparison(residual, measured, is_valid, agreement, at)

    def _longer(self, reading: Reading) -> Tensor:
        """Factors by which depths are too long in first and in second frames, (2, pairs, 1).

        They grow evenly over the recording: its first depths are too short by half of
        `depth_growth`, its last ones too long by as much.
        """
        growth = reading.depth_growth * (self.pairs / len(self.file_poses) - 0.5)
        return torch.from_numpy(1 + growth[..., None]).float()

    def _T_second_first(self, reading: Reading) -> Tensor:
        """Poses of the first cameras in the second ones' frames, (pairs, 4, 4; m)."""
        T_world_camera = reading.T_world_camera(self.file_poses, self.order)
        # Depth that is late by some frames was taken at the pose that is so many frames before.
        numbers = (self.pairs - reading.depth_shift).clip(0, len(self.file_poses) - 1)
        T_world_first, T_world_second = T_world_camera[numbers]
        return torch.from_numpy(np.linalg.solve(T_world_second, T_world_first)).float()

    def _on_images(self, columns: Tensor, rows: Tensor) -> Tensor:
        """Pixel indices as `grid_sample` has them, (..., 2): -1 is the first pixel, 1 the last."""
        height, width = self.inverse_values.shape[2:]
        return 2 * torch.stack([columns / (width - 1), rows / (height - 1)], dim=-1) - 1

    def depth_costs(self, reading: Reading) -> Costs:
        """1 - the mean agreement of the points of a pair that are valid; NaN if these are few."""
        compared = self.compare(reading)
        overlap = compared.is_valid.float().mean(dim=1)
        costs = 1 - compared.agreement.mean(dim=1) / overlap
        return torch.where(overlap >= _MIN_OVERLAP, costs, torch.nan).numpy()

    def color_costs(self, compared: Comparison, reading: Reading) -> Costs:
        """1 - the correlation of intensities of points whose depths agree; exposures may differ.

        `compared` tells where points lie and agree, and `reading` how colours are shifted. NaN of
        pairs with few points, and without contrast.
        """
        # The points' places in all first frames, then in all second ones: (2 pairs, 1, points, 2).
        in_first = self._on_images(self.columns, self.rows).expand_as(compared.seen_at[:, 0])
        at = torch.cat([in_first[:, None], compared.seen_at])
        at[..., 0] += 2 * reading.color_right  # an image is 2 wide, from -1 to 1
        if reading.is_mirrored:
            at[..., 0] *= -1
        # `kept` holds the neighbours in order, so that so many frames later is so many places on.
        places = (self.places + reading.color_shift).clip(0, len(self.colors) - 1)
        gray = [cv2.cvtColor(self.colors[i], cv2.COLOR_RGB2GRAY) for i in places.ravel()]
        images = torch.from_numpy(np.stack(gray))[:, None].float() / 255
        in_firsts, in_seconds = grid_sample(images, at, align_corners=True)[:, 0, 0].chunk(2)
        is_inside = (at.abs() <= 1).all(dim=-1)[:, 0].view(2, *self.values.shape).all(dim=0)
        is_compared = ((compared.agreement > _SAME) & is_inside).numpy()
        costs = np.full(len(is_compared), np.nan)
        for pair in np.flatnonzero(is_compared.mean(axis=1) >= _MIN_OVERLAP):
            first = in_firsts[pair].numpy()[is_compared[pair]]
            second = in_seconds[pair].numpy()[is_compared[pair]]
            if min(first.std(), second.std()) >= _MIN_CONTRAST:
                costs[pair] = 1 - np.corrcoef(first, second)[0, 1]
        return costs
