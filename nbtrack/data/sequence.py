"""RGB-D sequences with known camera poses, in memory."""

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8, UInt16

from nbtrack.core.arrays import Poses, Position
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.frame import MILLIMETRE, Frame
from nbtrack.machinery.errors import ConfigError, DataError, typed
from nbtrack.machinery.inputs import check_array, checked_poses

# `observed_bounds` uses about so many pixels of each frame, on a regular grid (our choice).
_POINTS_PER_FRAME = 2000
# The share of points that it leaves out at either end of each axis (our choice).
_CUT_OFF = 0.002
# The fields of a sequence that have one row for each frame.
ARRAYS = "colors", "depths_mm", "T_world_camera", "frame_ids", "times"


@typed
@dataclass(frozen=True)
class RgbdSequence:
    """RGB-D frames with camera poses, kept as integers (5 bytes a pixel).

    1,600 frames of 640x480 take 2.5 GB. Pixels become floating point only when they are used.
    """

    name: str
    intrinsics: Intrinsics
    colors: UInt8[np.ndarray, "frames height width 3"]  # RGB
    depths_mm: UInt16[np.ndarray, "frames height width"]  # z-depth, 0 = no measurement
    T_world_camera: Poses  # OpenCV camera axes; NaN if unknown
    frame_ids: Int[np.ndarray, "frames"]  # index in the recording's folder, in natural order
    times: Float[np.ndarray, "frames"]  # s, as recorded, or from frame numbers and a frame rate
    # The position (m) of this sequence's world origin in the recording's own world frame.
    origin: Position = field(default_factory=lambda: np.zeros(3))
    declared_unit: float | None = None  # m, see `SceneBounds`

    def __post_init__(self) -> None:
        """Raises DataError for an array of another type, shape or number of frames."""
        n, size = len(self.colors), (self.intrinsics.height, self.intrinsics.width)
        check_array("colors", self.colors, (n, *size, 3), [UInt8], "uint8")
        check_array("depths_mm", self.depths_mm, (n, *size), [UInt16], "uint16")
        check_array("T_world_camera", self.T_world_camera, (n, 4, 4), [Float], "floating point")
        check_array("frame_ids", self.frame_ids, (n,), [Int], "whole numbers")
        check_array("times", self.times, (n,), [Float], "floating point")
        check_array("origin", self.origin, (3,), [Float], "floating point")

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __repr__(self) -> str:
        size = f"{self.intrinsics.width}x{self.intrinsics.height}"
        return f"RgbdSequence({self.name!r}, {len(self)} frames of {size})"

    @typed
    def __getitem__(self, index: int) -> Frame:
        """A copy of one frame, with its true pose if that is known; `select` takes several."""
        color = torch.from_numpy(self.colors[index].copy())
        depth_mm = torch.from_numpy(self.depths_mm[index].astype(np.int32))
        name = f"frame {self.frame_ids[index]} of {self.name}"
        T_world_camera = self.T_world_camera[index].copy()
        known = T_world_camera if np.isfinite(T_world_camera).all() else None
        return Frame(self.intrinsics, color, depth_mm, known, name)

    def color(self, index: int) -> Float[np.ndarray, "height width 3"]:
        """The colour image of a frame, in [0, 1]."""
        return self.colors[index].astype(np.float32) / 255

    def depth(self, index: int) -> Float[np.ndarray, "height width"]:
        """The z-depth image of a frame (m), 0 where there is no measurement."""
        return self.depths_mm[index].astype(np.float32) * np.float32(MILLIMETRE)

    @property
    def digest(self) -> str:
        """A hash of all that is mapped, tracked or kept with results: sixteen hexadecimal digits.

        These are images, poses, frame numbers, times, camera and unit. By it a checkpoint that was
        made with other data is refused.
        """
        digest = hashlib.blake2b(digest_size=8)
        digest.update(repr((self.intrinsics, self.declared_unit)).encode())
        for name in ARRAYS:
            digest.update(np.ascontiguousarray(getattr(self, name)).data)
        return digest.hexdigest()

    def select(self, indices: slice | Int[np.ndarray, "n"]) -> "RgbdSequence":
        """A sequence of some of the frames, in the order given. A slice copies no images.

        Raises ConfigError for anything but a slice or a list of indices.
        """
        if not isinstance(indices, slice) and np.ndim(indices) != 1:
            raise ConfigError(f"`select` takes a slice or a list of frames, not {indices!r:.80}")
        return replace(self, **{name: getattr(self, name)[indices] for name in ARRAYS})


@typed
def observed_bounds(sequence: RgbdSequence, margin: float = 0.1) -> SceneBounds:
    """The box around what a sequence sees and around its cameras, enlarged by `margin` (m).

    A few points at either end of each axis are left out, so that wrong depths do not stretch it.
    Raises DataError if a frame has no known pose, or if no pixel that is used has a depth.
    """
    poses = checked_poses(sequence.T_world_camera, Path(sequence.name))
    is_posed = np.isfinite(poses).all(axis=(1, 2))
    if not (len(sequence) and is_posed.all()):
        found = f"{(~is_posed).sum()} of the {len(sequence)} frames of {sequence.name} have no pose"
        raise DataError(f"{found}: `select` those that have one, and at least one frame")
    height, width = sequence.depths_mm.shape[1:]
    stride = max(1, round((width * height / _POINTS_PER_FRAME) ** 0.5))
    clouds = []
    for frame in sequence:
        points_camera, _ = frame.points(*frame.measured_pixels(stride, stride // 2))
        rotation, position = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
        clouds.append(points_camera.numpy() @ rotation.T + position)
    points_world = np.concatenate(clouds)
    if not len(points_world):
        raise DataError(f"no pixel of {sequence.name} has a depth, of one in {stride**2}: check it")
    positions = sequence.T_world_camera[:, :3, 3]
    low, high = np.quantile(points_world, [_CUT_OFF, 1 - _CUT_OFF], axis=0)
    low = np.minimum(low, positions.min(axis=0)) - margin
    high = np.maximum(high, positions.max(axis=0)) + margin
    return SceneBounds(tuple(low.tolist()), tuple(high.tolist()), sequence.declared_unit)
