"""Recordings on disk as sequences in memory, whatever format they are stored in."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from nbtrack.core.arrays import Frames, Position
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.recordings.images import decode
from nbtrack.recordings.recording import Recording, open_recording

_SLICE = r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?"
# Beyond so many times the distance that nine in ten depths lie within, they are no measurement: of
# eleven rooms and two real recordings the farthest was 2.1 times as far (our choice).
FAR = 5.0


def parse_frames(text: str) -> slice:
    """A Python slice written `A:B:S` with S > 0; every part may be missing. Or raises DataError.

    >>> parse_frames("10:50:2"), parse_frames(":100")
    (slice(10, 50, 2), slice(None, 100, None))
    """
    match = re.fullmatch(_SLICE, text.replace(" ", ""))
    if not match:
        raise DataError(f"frames {text!r} is no slice: write A:B, or A:B:S with S above 0")
    return slice(*(int(part) if part else None for part in match.groups()))


def read_sequence(
    folder: Path | str,
    frames: slice = slice(None),
    depth_folder: str | None = None,
    pose_file: str | None = None,
    progress: bool = False,
    format: str | None = None,
) -> RgbdSequence:
    """Read a recording; arguments and errors are those of `open_recording` and `read_frames`.

    A Neural RGB-D scene also has depth in `depth` and `depth_with_noise`, and poses in
    `trainval_poses.txt` (BundleFusion's, in another world frame).
    """
    return read_frames(open_recording(folder, format, depth_folder, pose_file), frames, progress)


def read_frames(
    recording: Recording,
    frames: slice | Frames = slice(None),
    progress: bool = False,
    needs_poses: bool = True,
    origin: Position | None = None,
) -> RgbdSequence:
    """The frames of an opened recording of some numbers, or that a slice selects and, where needed,
    that have a pose. Poses are relative to an origin (m), by default the recording's.

    Raises MissingError or DataError if an image cannot be read, or no frame is left.
    """
    is_slice = isinstance(frames, slice)
    frame_ids = select_frames(recording, frames, needs_poses) if is_slice else frames
    images = decode(recording, frame_ids, progress)
    poses, times = recording.T_world_camera[frame_ids], recording.times[frame_ids]
    origin = recording.origin if origin is None else origin
    poses[:, :3, 3] -= origin
    unit = recording.declared.metres_per_unit or None
    return RgbdSequence(recording.name, *images, poses, frame_ids, times, origin, unit)


def select_frames(recording: Recording, frames: slice, needs_poses: bool = True) -> Frames:
    """Numbers of the selected frames, where needed of those that have a pose.

    Raises DataError if there is none.
    """
    selected = frame_ids = np.arange(len(recording))[frames]
    if needs_poses and recording.pose_file is None:
        raise MissingError(
            f"no poses in {recording.folder}: {recording.format.label} needs "
            f"{' or '.join(recording.format.poses)}; add it, or track in a map of the same place "
            "with --map-from"
        )
    if needs_poses:
        frame_ids = selected[recording.has_pose[selected]]
    if not len(frame_ids):
        raise DataError(
            f"{len(selected)} of the {len(recording)} frames in {recording.folder} are selected, "
            f"but no pose in {recording.pose_file} that is not NaN: choose others, or other poses"
        )
    return frame_ids


def without_outliers(sequence: RgbdSequence) -> RgbdSequence:
    """Without depths farther than `far_limit`; a sequence that has none is returned as it is."""
    sample = sequence.depths_mm[:, ::4, ::4]
    is_far = sequence.depths_mm > far_limit(sample[sample > 0])
    if not is_far.any():
        return sequence
    return replace(sequence, depths_mm=np.where(is_far, np.uint16(0), sequence.depths_mm))


def far_limit(depths: np.ndarray) -> float:
    """The distance, in the unit of some measured depths, beyond which they are outliers."""
    return FAR * float(np.quantile(depths, 0.9)) if len(depths) else np.inf
