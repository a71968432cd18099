"""How the numbers of a recording are read, and how well its frames then agree.

Read rightly, the surfaces that two frames both see coincide.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt16
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.core.arrays import Frames, Poses
from nbtrack.core.camera import Intrinsics, pixel_directions, project
from nbtrack.data.sequence import RgbdSequence
from nbtrack.recordings.formats import Declaration
from nbtrack.recordings.recording import Recording

_HIDDEN_BEHIND = 0.25  # m behind a surface points are hidden: several times a camera's noise
# Of the depth: where the mean of neighbouring pixels is farther off, they lie on two surfaces.
_SAME_SURFACE = 0.025
_SCALE = 0.01  # of the depth: surfaces so far apart agree by half, several times a camera's noise
_POINTS_PER_FRAME = 1000  # 20 pairs of frames have enough for a median
_AREAS = (4, 6)  # rows and columns of them in an image
AREA_SCALE = 0.004  # of the depth: areas that lie so far apart cost by half (our choice)
_FAR_APART = 0.05  # of the depth: larger gaps count as this
_MIN_MEASURED = 0.3  # share of an area's points that have to be valid
Pairs = Int[np.ndarray, "2 pairs"]  # of frames
Gaps = Float[np.ndarray, "pairs areas"]  # between surfaces, signed, as shares of the depth


@dataclass(frozen=True)
class Reading:
    """One way to read a recording. Lengths, angles and shares that are 0 are as declared."""

    declared: Declaration
    camera: Intrinsics
    # m, of one unit of x, y and z of the poses' positions; negative where these are mirrored.
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    is_mixed: bool = False  # rotations alone are of the other direction than declared
    focal_share: float = 0.0  # by which focal lengths are longer
    aspect: float = 0.0  # by which the vertical one is longer still
    right: float = 0.0  # by which the principal point lies farther right, as a share of the width
    down: float = 0.0  # and farther down, as a share of the height
    depth_share: float = 0.0  # by which depths are longer
    depth_error_per_m: float = 0.0  # 1/m, beside the declared one
    depth_offset: float = 0.0  # m, by which depths are longer
    late: float = 0.0  # frames by which depth comes after the poses
    x: float = 0.0  # m, where the camera is in the frame (OpenCV's axes) of what poses are of
    y: float = 0.0
    z: float = 0.0
    turn_x: float = 0.0  # degrees, the rotation vector from the camera's frame to that one
    turn_y: float = 0.0
    turn_z: float = 0.0

    @property
    def calibration(self) -> Intrinsics:
        """The camera with its focal lengths and its principal point changed."""
        c, factor = self.camera, 1 + self.focal_share
        cx, cy = c.cx + self.right * c.width, c.cy + self.down * c.height
        return replace(c, fx=factor * c.fx, fy=factor * (1 + self.aspect) * c.fy, cx=cx, cy=cy)

    def points(self, columns: Tensor, rows: Tensor, values: Tensor) -> Tensor:
        """Points (..., 3; m, camera frame) of pixels with depth values as in the files."""
        directions = pixel_directions(self.calibration, columns, rows)
        z = values / self.declared.depth_scale  # m
        if self.declared.depth_along == "ray":
            z = z / directions.norm(dim=-1)
        error_per_m = self.declared.depth_error_per_m + self.depth_error_per_m
        z = z * (1 + self.depth_share + error_per_m * z) + self.depth_offset
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
        if self.is_mixed:
            T_file[:, :3, :3] = T_file[:, :3, :3].mT
        T_file[:, :3, 3] *= self.metres
        T_body_camera = np.eye(4)
        turn_deg = [self.turn_x, self.turn_y, self.turn_z]
        T_body_camera[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
        T_body_camera[:3, 3] = self.x, self.y, self.z
        return self.declared.poses_to_opencv(T_file) @ T_body_camera


def on_grid(values: UInt16[np.ndarray, "frames h w"], stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows (n,) of every `stride`-th pixel along each axis, and values (frames, n)."""
    some = torch.from_numpy(values[:, ::stride, ::stride].astype(np.float32))
    rows, columns = (stride * torch.from_numpy(np.indices(some.shape[1:]))).flatten(1)
    return columns, rows, some.flatten(1)


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well pairs of frames agree under a reading."""

    reading: Reading
    areas: Gaps  # by how much surfaces lie apart in each area, as a share of the depth
    apart: float  # the mean of their absolute values; NaN where none is known
    depth_m: float  # the median depth of the points that overlap
    overlap: float  # share of all points that fall onto a measured, not nearer, surface
    agreement: float  # the same, where surfaces that coincide count 1 and those far apart 0


def cost_of(gaps: Gaps, scale: float = AREA_SCALE) -> float:
    """The mean cost of Geman and McClure: 0 where surfaces coincide, 1 far from that.

    It is infinite where nothing is known, so that no fit ends there.
    """
    known = gaps[np.isfinite(gaps)]
    return float((known**2 / (known**2 + scale**2)).mean()) if len(known) else np.inf


def mean_apart(gaps: Gaps) -> float:
    """By how much surfaces lie apart in the mean, as a share of the depth.

    It is NaN where nothing is known.
    """
    known = np.abs(gaps[np.isfinite(gaps)])
    return float(np.minimum(known, _FAR_APART).mean()) if len(known) else np.nan


class FramePairs:
    """Pairs of frames that see much the same, whose agreement is computed for any reading."""

    def __init__(self, recording: Recording, ids: Frames, kept: RgbdSequence, pairs: Pairs) -> None:
        """Take the frames of pairs from a sequence whose depth values are as in the files.

        `ids` are the numbers of the recording's frames that have a pose, and `pairs` are indices in
        `ids`. Points are those of the first frame of each pair.
        """
        self.pairs = pairs
        self.file_poses = recording.file_poses[ids]
        self.order = recording.declared.quaternion
        places = np.searchsorted(kept.frame_ids, ids[pairs])
        first, second = kept.depths_mm[places]  # the files' values, in their unit
        stride = math.ceil((math.prod(first.shape[1:]) / _POINTS_PER_FRAME) ** 0.5)
        self.columns, self.rows, self.values = on_grid(first, stride)  # of the points
        # Numbers of the points of each area: a few rows and columns are left over.
        numbers = torch.arange(len(self.columns)).view(-1, len(self.columns.unique()))
        size = [max(1, n // parts) for n, parts in zip(numbers.shape, _AREAS, strict=True)]
        blocks = numbers.unfold(0, size[0], size[0]).unfold(1, size[1], size[1])
        self.areas = blocks[: _AREAS[0], : _AREAS[1]].flatten(2).flatten(0, 1)  # (areas, n)
        # Of the second frames; infinite without a depth.
        self.inverse_values = 1 / torch.from_numpy(second[:, None].astype(np.float32))

    def compare(self, reading: Reading) -> Agreement:
        """How points of the first frames a agree with what was measured in the second ones b.

        Depth is interpolated between four pixels, in 1/z, which is exact for planes.
        """
        points_a = reading.points(self.columns, self.rows, self.values)
        T_b_a = self._T_second_first(reading)
        points_b = points_a @ T_b_a[:, :3, :3].mT + T_b_a[:, None, :3, 3]
        columns, rows, depth = project(reading.calibration, points_b)
        height, width = self.inverse_values.shape[2:]
        # As `grid_sample` has them, (pairs, 1, points, 2): -1 is the first pixel, 1 the last.
        at = 2 * torch.stack([columns / (width - 1), rows / (height - 1)], dim=-1)[:, None] - 1
        blended = 1 / grid_sample(self.inverse_values, at, "bilinear", align_corners=True)[:, 0, 0]
        nearest = 1 / grid_sample(self.inverse_values, at, "nearest", align_corners=True)[:, 0, 0]
        _, _, measured = reading.points(columns, rows, blended).unbind(-1)  # z-depth
        residual = depth - measured
        is_valid = (self.values > 0) & (depth > 1e-6) & (at.abs() <= 1).all(dim=-1)[:, 0]
        is_valid &= (blended / nearest - 1).abs() < _SAME_SURFACE  # false where there is no depth
        # A point far behind the measured surface is hidden by it. One far in front of it is kept,
        # since there the two frames contradict each other.
        is_valid &= residual < _HIDDEN_BEHIND
        gap = torch.where(is_valid, residual / measured, torch.nan)
        # The weight of Geman and McClure: 1 where both coincide, 0 where they are far apart.
        agreement = 1 / (1 + (gap / _SCALE) ** 2)
        n_points = float((self.values > 0).sum().clamp(1))
        areas = self._areas(gap)
        return Agreement(
            reading, areas, mean_apart(areas), float(measured[is_valid].median()),
            float(is_valid.sum()) / n_points, float(agreement.nansum()) / n_points,
        )  # fmt: skip

    def _T_second_first(self, reading: Reading) -> Tensor:
        """Poses of the first cameras in the second ones' frames, (pairs, 4, 4; m)."""
        T_world_camera = reading.T_world_camera(self.file_poses, self.order)
        # Late depth belongs to an earlier pose, between two frames. The poses of these are so near
        # to each other that their matrices may be interpolated element by element.
        at = (self.pairs - reading.late).clip(0, len(T_world_camera) - 1)
        before = at.astype(int)
        share = (at - before)[..., None, None]
        after = np.minimum(before + 1, len(T_world_camera) - 1)
        T = (1 - share) * T_world_camera[before] + share * T_world_camera[after]
        return torch.from_numpy(np.linalg.solve(T[1], T[0])).float()

    def _areas(self, gaps: Float[Tensor, "pairs points"]) -> Gaps:
        """The median gap in each area of the image; NaN where few of its points are valid.

        A median over an area reduces a sensor's noise. An error of the reading stays.
        """
        by_area = gaps[:, self.areas]  # (pairs, areas, points)
        is_measured = by_area.isfinite().float().mean(dim=-1) >= _MIN_MEASURED
        return torch.where(is_measured, by_area.nanmedian(dim=-1).values, torch.nan).numpy()
