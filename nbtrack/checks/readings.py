"""Readings of a recording, and how well its frames agree under each of them.

A `Reading` turns the numbers in a recording's files into points and poses. `FramePairs` compares
the surfaces that pairs of frames measured: they coincide if the reading is right.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt16
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.core.arrays import Frames, Poses
from nbtrack.core.camera import Intrinsics, pixel_directions, project
from nbtrack.data.sequence import RgbdSequence
from nbtrack.recordings.formats import Declaration
from nbtrack.recordings.recording import Recording

# m. A point that lies farther behind a measured surface is hidden by it. Several times a depth
# camera's noise.
_HIDDEN_BEHIND = 0.25
# Share of the depth. If the depth interpolated between four pixels differs by more from that of the
# nearest pixel, the four lie on two surfaces.
_SAME_SURFACE = 0.025
_SCALE = 0.01  # share of the depth: a gap at which a point's agreement is 1/2; several times noise
_POINTS_PER_FRAME = 1000  # with these, 20 pairs of frames have enough points for a median
_AREAS = (4, 6)  # an image has so many rows and columns of areas
AREA_SCALE = 0.004  # share of the depth: a gap at which an area's cost is 1/2 (our choice)
_FAR_APART = 0.05  # share of the depth: the mean gap counts larger gaps as this one
_MIN_VALID = 0.3  # share of an area's points that must be valid, or its gap is unknown
Pairs = Int[np.ndarray, "2 pairs"]  # the first and the second frame of each pair
Gaps = Float[np.ndarray, "pairs areas"]  # signed distances of surfaces as shares of the depth


@dataclass(frozen=True)
class Reading:
    """One way to read a recording's numbers: a declaration, a camera, and corrections of both.

    All corrections at their defaults read the recording as `declared` and `camera` say.
    """

    declared: Declaration
    camera: Intrinsics
    # Metres of one unit of the poses' x, y and z; negative for a mirrored axis.
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    # The rotations of the file's poses are the inverse ones, while positions are as declared.
    is_mixed: bool = False
    focal_share: float = 0.0  # both focal lengths grow by this share
    aspect: float = 0.0  # the vertical focal length grows by this share besides
    right: float = 0.0  # the principal point moves right by this share of the width
    down: float = 0.0  # the principal point moves down by this share of the height
    depth_share: float = 0.0  # depths grow by this share
    depth_error_per_m: float = 0.0  # 1/m, added to the declared one
    depth_offset: float = 0.0  # m, added to depths
    late: float = 0.0  # frames by which the depth images come after their poses
    # Position (m) and rotation vector (degrees) of the camera in the frame of the body whose poses
    # the file has. That frame has OpenCV's axes.
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn_x: float = 0.0
    turn_y: float = 0.0
    turn_z: float = 0.0

    @property
    def calibration(self) -> Intrinsics:
        """The camera with corrected focal lengths and a corrected principal point."""
        c, factor = self.camera, 1 + self.focal_share
        cx, cy = c.cx + self.right * c.width, c.cy + self.down * c.height
        return replace(c, fx=factor * c.fx, fy=factor * (1 + self.aspect) * c.fy, cx=cx, cy=cy)

    def points(self, columns: Tensor, rows: Tensor, values: Tensor) -> Tensor:
        """Points (..., 3; m, camera frame) of pixels, from depth values as the files have them."""
        directions = pixel_directions(self.calibration, columns, rows)
        z = values / self.declared.depth_scale  # m
        if self.declared.depth_along == "ray":
            z = z / directions.norm(dim=-1)
        error_per_m = self.declared.depth_error_per_m + self.depth_error_per_m
        z = z * (1 + self.depth_share + error_per_m * z) + self.depth_offset
        return directions * z[..., None]

    def T_world_camera(self, file_poses: Poses, order: str) -> Poses:
        """Camera-to-world poses (m), of cameras with OpenCV's axes, from the poses of the file.

        `file_poses` are matrices in the file's own convention. If the file has quaternions, they
        were read in the order `order`, "wxyz" or "xyzw".
        """
        T = file_poses.copy()
        if self.declared.quaternion != order:
            # Recover the file's four numbers, and read them in the other order.
            w_first = order == "wxyz"
            numbers = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=w_first)
            T[:, :3, :3] = Rotation.from_quat(numbers, scalar_first=not w_first).as_matrix()
        if self.is_mixed:
            T[:, :3, :3] = T[:, :3, :3].mT
        T[:, :3, 3] *= self.metres
        T_body_camera = np.eye(4)
        turn_deg = [self.turn_x, self.turn_y, self.turn_z]
        T_body_camera[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
        T_body_camera[:3, 3] = self.x, self.y, self.z
        return self.declared.poses_to_opencv(T) @ T_body_camera


def on_grid(values: UInt16[np.ndarray, "frames h w"], stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Take every `stride`-th pixel along both axes of images, row by row.

    Returns the n pixels' columns (n,), their rows (n,), and their values (frames, n).
    """
    sampled = torch.from_numpy(values[:, ::stride, ::stride].astype(np.float32))
    rows, columns = stride * torch.from_numpy(np.indices(sampled.shape[1:])).flatten(1)
    return columns, rows, sampled.flatten(1)


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well pairs of frames agree under a reading."""

    reading: Reading
    area_gaps: Gaps  # the median gap between the two surfaces in each area; NaN where unknown
    apart: float  # mean absolute gap of areas, as a share of the depth; NaN if none is known
    depth_m: float  # the median depth of the overlapping points
    # The share of all points that fall onto a measured surface, and are not hidden by it.
    overlap: float
    # The same share if each of these points counts between 1 (no gap) and 0 (far apart).
    agreement: float


def cost_of(gaps: Gaps, scale: float = AREA_SCALE) -> float:
    """The mean cost of Geman and McClure over the known gaps, from 0 (no gap) to 1 (far apart).

    It is infinite if no gap is known, so that no fit ends there.
    """
    known = gaps[np.isfinite(gaps)]
    return float((known**2 / (known**2 + scale**2)).mean()) if len(known) else np.inf


def mean_apart(gaps: Gaps) -> float:
    """The mean absolute value of the known gaps; NaN if none is known.

    Gaps above `_FAR_APART` count as `_FAR_APART`, which bounds the weight of wrong ones.
    """
    known = np.abs(gaps[np.isfinite(gaps)])
    return float(np.minimum(known, _FAR_APART).mean()) if len(known) else np.nan


class FramePairs:
    """Depth maps and poses of pairs of frames that see much the same; `compare` tests a reading."""

    def __init__(self, recording: Recording, ids: Frames, rgbd: RgbdSequence, pairs: Pairs) -> None:
        """Take the depth maps of pairs from `rgbd`, whose depth values are as in the files.

        `ids` are the numbers of the recording's frames that have a pose, and `pairs` are indices in
        `ids`. Pixels on a grid in the first frame of each pair are the points that are compared.
        """
        self.pairs = pairs
        self.file_poses = recording.file_poses[ids]
        self.order = recording.declared.quaternion
        places = np.searchsorted(rgbd.frame_ids, ids[pairs])
        first, second = rgbd.depths_mm[places]  # the name says mm, the unit is that of the files
        stride = math.ceil((math.prod(first.shape[1:]) / _POINTS_PER_FRAME) ** 0.5)
        self.columns, self.rows, self.values = on_grid(first, stride)  # of the points
        # The points form a grid of rows and columns. It is cut into areas of equal size, and the
        # rows and columns that are left over belong to none.
        numbers = torch.arange(len(self.columns)).view(-1, len(self.columns.unique()))
        size = [max(1, n // parts) for n, parts in zip(numbers.shape, _AREAS, strict=True)]
        # (rows of areas, columns of areas, rows in an area, columns in an area)
        blocks = numbers.unfold(0, size[0], size[0]).unfold(1, size[1], size[1])
        self.points_of_areas = blocks[: _AREAS[0], : _AREAS[1]].flatten(2).flatten(0, 1)
        # Pixels without a depth have the value 0, and so an infinite inverse.
        self.inverse_values = 1 / torch.from_numpy(second[:, None].astype(np.float32))

    def compare(self, reading: Reading) -> Agreement:
        """How well points of the first frames (a) agree with the depth maps of the second ones (b).

        A point of a is projected into b. Its gap is its depth there minus the measured depth. The
        measured depth is interpolated between four pixels as 1/z, which is exact for planes.
        """
        points_a = reading.points(self.columns, self.rows, self.values)
        T_b_a = self._T_second_first(reading)
        points_b = points_a @ T_b_a[:, :3, :3].mT + T_b_a[:, None, :3, 3]
        columns, rows, depth = project(reading.calibration, points_b)
        height, width = self.inverse_values.shape[2:]
        # Positions as `grid_sample` takes them, (pairs, 1, points, 2): -1 is the centre of the
        # first pixel, and 1 the centre of the last one.
        uv = 2 * torch.stack([columns / (width - 1), rows / (height - 1)], dim=-1)[:, None] - 1
        blended = 1 / grid_sample(self.inverse_values, uv, "bilinear", align_corners=True)[:, 0, 0]
        nearest = 1 / grid_sample(self.inverse_values, uv, "nearest", align_corners=True)[:, 0, 0]
        measured_depth = reading.points(columns, rows, blended)[..., 2]
        residual = depth - measured_depth
        is_valid = (self.values > 0) & (depth > 1e-6) & (uv.abs() <= 1).all(dim=-1)[:, 0]
        is_valid &= (blended / nearest - 1).abs() < _SAME_SURFACE  # false if there is no depth
        # A point far behind the measured surface is hidden by it. A point far in front of it stays
        # valid, since there the two frames contradict each other.
        is_valid &= residual < _HIDDEN_BEHIND
        gap = torch.where(is_valid, residual / measured_depth, torch.nan)
        # The weight of Geman and McClure: 1 without a gap, 0 far apart, NaN for an invalid point.
        agreement = 1 / (1 + (gap / _SCALE) ** 2)
        n_points = float((self.values > 0).sum().clamp(1))
        area_gaps = self._area_gaps(gap)
        return Agreement(
            reading, area_gaps, mean_apart(area_gaps), float(measured_depth[is_valid].median()),
            float(is_valid.sum()) / n_points, float(agreement.nansum()) / n_points,
        )  # fmt: skip

    def _T_second_first(self, reading: Reading) -> Tensor:
        """Poses of the first camera of each pair in the second camera's frame, (pairs, 4, 4; m)."""
        T_world_camera = reading.T_world_camera(self.file_poses, self.order)
        if reading.late:
            # The depth image of frame k was taken at the time k - late, when the camera was between
            # the poses of two frames. That pose is interpolated.
            numbers = np.arange(len(T_world_camera))
            times = (numbers - reading.late).clip(0, numbers[-1])  # in frames
            R, t = Rotation.from_matrix(T_world_camera[:, :3, :3]), T_world_camera[:, :3, 3]
            T_world_camera[:, :3, 3] = CubicSpline(numbers, t)(times)
            T_world_camera[:, :3, :3] = Slerp(numbers, R)(times).as_matrix()
        T_first, T_second = T_world_camera[self.pairs]
        return torch.from_numpy(np.linalg.solve(T_second, T_first)).float()

    def _area_gaps(self, gaps: Float[Tensor, "pairs points"]) -> Gaps:
        """The median gap of each area's points; NaN if few of the points are valid.

        The median has less of the sensor's noise than a single gap, and all of the reading's error.
        """
        by_area = gaps[:, self.points_of_areas]  # (pairs, areas, points in an area)
        is_known = by_area.isfinite().float().mean(dim=-1) >= _MIN_VALID
        return torch.where(is_known, by_area.nanmedian(dim=-1).values, torch.nan).numpy()
