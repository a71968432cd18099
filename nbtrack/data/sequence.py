"""RGB-D sequences with known camera poses, whatever format they are stored in.

Formats are modules of `nbtrack.data.readers`; data/README.md describes them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8, UInt16

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, backproject
from nbtrack.core.errors import DataError
from nbtrack.data.readers import Recording, decode, open_recording

MILLIMETRE = 1e-3
FRAMES_PER_SECOND = 30.0  # of the recordings; turns frame ids into time stamps


@dataclass(frozen=True)
class RgbdSequence:
    """Posed RGB-D frames, kept as compactly as on disk (5 bytes a pixel).

    1,600 frames of 640x480 take 2.5 GB. Pixels become floating point only when sampled.
    """

    name: str
    intrinsics: Intrinsics
    colors: UInt8[np.ndarray, "frames height width 3"]  # RGB
    depths_mm: UInt16[np.ndarray, "frames height width"]  # z-depth, 0 = no measurement
    T_world_camera: Float[np.ndarray, "frames 4 4"]  # OpenCV camera axes
    frame_ids: Int[np.ndarray, "frames"]  # position in the folder's natural order
    excluded_frames: int = 0  # frames left out because their pose is NaN

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __repr__(self) -> str:
        size = f"{self.intrinsics.width}x{self.intrinsics.height}"
        left_out = f", {self.excluded_frames} without pose" if self.excluded_frames else ""
        return f"RgbdSequence({self.name!r}, {len(self)} frames of {size}{left_out})"

    def color(self, index: int) -> Float[np.ndarray, "height width 3"]:
        """Colour image in [0, 1]."""
        return self.colors[index].astype(np.float32) / 255

    def depth(self, index: int) -> Float[np.ndarray, "height width"]:
        """Z-depth image in metres, 0 where there is no measurement."""
        return self.depths_mm[index].astype(np.float32) * np.float32(MILLIMETRE)

    def select(self, indices: slice | Int[np.ndarray, "n"]) -> "RgbdSequence":
        """The sequence of some of the frames, in the order given; slices copy nothing."""
        return RgbdSequence(
            self.name, self.intrinsics, self.colors[indices], self.depths_mm[indices],
            self.T_world_camera[indices], self.frame_ids[indices], self.excluded_frames,
        )  # fmt: skip


def parse_frames(text: str) -> slice:
    """A Python slice written `A:B:S`; every part may be missing.

    Raises:
        DataError: the text is not a slice, or its step is not positive.

    >>> parse_frames("10:50:2"), parse_frames(":100")
    (slice(10, 50, 2), slice(None, 100, None))
    """
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
        if not 2 <= len(parts) <= 3:
            raise ValueError
        frames = slice(*parts)
    except ValueError:
        raise DataError(
            f"frames {text!r} is not a slice: write A:B or A:B:S, for example 0:100:2"
        ) from None
    if frames.step is not None and frames.step < 1:
        raise DataError(f"frames {text!r} steps by {frames.step}: a step is 1 or more")
    return frames


def read_sequence(
    folder: Path | str,
    frames: slice = slice(None),
    depth_folder: str | None = None,
    pose_file: str | None = None,
    progress: bool = False,
    format: str | None = None,
) -> RgbdSequence:
    """Read a recording in one of the formats of `nbtrack.data.readers.FORMATS`.

    Args:
        frames: Python slice over the recording's frames in their order.
        depth_folder: of a Neural RGB-D scene or a plain folder; by default the first there is of
            `depth_filtered`, `depth` and `depth_with_noise`.
        pose_file: by default the format's own; a Neural RGB-D scene also has
            `trainval_poses.txt` (the dataset's BundleFusion poses, in a frame of their own).
        progress: show a bar.
        format: the name of one; by default told by the files that are there.

    Raises:
        MissingError: the folder or a part of it does not exist.
        DataError: a file is unreadable, counts or sizes disagree, or nothing is left to read.
        ConfigError: there is no such format.
    """
    recording = open_recording(folder, format, depth_folder, pose_file)
    return read_frames(recording, frames, progress)


def read_frames(
    recording: Recording, frames: slice = slice(None), progress: bool = False
) -> RgbdSequence:
    """The frames of an opened recording that a slice selects and that have a pose.

    Raises:
        MissingError, DataError: as `read_sequence` does.
    """
    selected = np.arange(len(recording))[frames]
    if len(selected) == 0:
        raise DataError(
            f"frames {_slice_text(frames)} select nothing of the {len(recording)} frames in "
            f"{recording.folder}: choose a range within 0:{len(recording)}"
        )
    frame_ids = selected[recording.has_pose[selected]]
    if len(frame_ids) == 0:
        raise DataError(
            f"all {len(selected)} selected poses in {recording.pose_file} are NaN: at least one "
            "frame needs a pose; choose other frames or another pose file"
        )
    decoded = decode(recording, frame_ids, progress)
    return RgbdSequence(
        recording.name, decoded.intrinsics, decoded.colors, decoded.depths,
        recording.T_world_camera[frame_ids], frame_ids, len(selected) - len(frame_ids),
    )  # fmt: skip


def list_frames(
    folder: Path, depth_folder: str | None = None, format: str | None = None
) -> tuple[list[Path], list[Path]]:
    """Colour and depth files of a recording, paired, in order.

    Raises:
        MissingError, DataError, ConfigError: as `read_sequence` does, pixels aside.
    """
    recording = open_recording(folder, format, depth_folder)
    return recording.color_files, recording.depth_files


def _slice_text(frames: slice) -> str:
    parts = (frames.start, frames.stop, frames.step)
    return ":".join("" if part is None else str(part) for part in parts)


def observed_bounds(
    sequence: RgbdSequence,
    margin: float = 0.1,
    quantile: float = 0.002,
    points_per_frame: int = 2000,
) -> SceneBounds:
    """Box around everything a sequence sees, and its cameras, with `margin` metres to spare.

    Args:
        quantile: share of points cut off at either end of each axis, so that a few wild depths
            do not stretch the box (our choice; the cameras are never cut off).
        points_per_frame: pixels looked at in each frame, on a regular grid.

    Raises:
        DataError: no pixel of the sequence has a depth.
    """
    intrinsics = sequence.intrinsics
    stride = max(1, round((intrinsics.width * intrinsics.height / points_per_frame) ** 0.5))
    rows, columns = torch.meshgrid(
        torch.arange(stride // 2, intrinsics.height, stride),
        torch.arange(stride // 2, intrinsics.width, stride),
        indexing="ij",
    )
    clouds = []
    for index in range(len(sequence)):
        depth = torch.from_numpy(sequence.depth(index))[rows, columns]
        seen = depth > 0
        points_camera = backproject(intrinsics, columns[seen], rows[seen], depth[seen]).numpy()
        T_world_camera = sequence.T_world_camera[index]
        clouds.append(points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
    points_world = np.concatenate(clouds)
    if len(points_world) == 0:
        raise DataError(
            f"no pixel of {sequence.name} has a depth: all {len(sequence)} depth maps are 0; "
            "check the depth folder and its unit (uint16 millimetres)"
        )
    positions = sequence.T_world_camera[:, :3, 3]
    low, high = np.quantile(points_world, [quantile, 1 - quantile], axis=0)
    low = np.minimum(low, positions.min(axis=0)) - margin
    high = np.maximum(high, positions.max(axis=0)) + margin
    return SceneBounds(tuple(low.tolist()), tuple(high.tolist()))
