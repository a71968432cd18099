"""Read recordings of any format from disk into sequences in memory.

In a sequence all images have one size, depth is in mm along the optical axis, and the distortion of
the lens is taken out.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nbtrack.core.arrays import Frames, Position
from nbtrack.data.sequence import RgbdSequence
from nbtrack.machinery.errors import DataError
from nbtrack.recordings.images import images_of
from nbtrack.recordings.pose_files import shifted
from nbtrack.recordings.recording import Recording, open_recording

# A depth is an outlier if it is more than so many times the distance within which nine in ten
# depths lie (our choice). In eleven rooms and two real recordings the largest was 2.1 times as far.
FAR = 5.0


def parse_frames(text: str) -> slice:
    """The slice that a text `A:B:S` writes, with S > 0; every part may be missing.

    Raises DataError for another text.

    >>> parse_frames("10:50:2"), parse_frames(":100")
    (slice(10, 50, 2), slice(None, 100, None))
    """
    parts = r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?"
    match = re.fullmatch(parts, str(text).replace(" ", ""))
    if not match:
        raise DataError(f"frames {text!r:.80} is no slice: write A:B, or A:B:S with S above 0")
    return slice(*(int(part) if part else None for part in match.groups()))


def read_sequence(
    folder: Path | str,
    frames: slice = slice(None),
    origin: Position | None = None,
    **options: str | None,
) -> RgbdSequence:
    """Read the frames of a recording that have a pose, all or those of a slice.

    `origin` is as in `read_frames`; to track in a map, give `record["origin"]` of that map.
    `options` are `format`, `depth_folder` and `pose_file`, as `open_recording` takes them. For
    example, a Neural RGB-D scene also has depth in the folders `depth` and `depth_with_noise`, and
    poses in `trainval_poses.txt` (BundleFusion's, in another world frame). Raises MissingError,
    DataError or ConfigError if something is not there, wrong or unknown.
    """
    return read_frames(open_recording(folder, **options), frames, origin=origin)


def read_frames(
    recording: Recording,
    frames: slice | Frames = slice(None),
    needs_poses: bool = True,
    origin: Position | None = None,
    as_stored: bool = False,
) -> RgbdSequence:
    """Read frames of an opened recording into a sequence.

    Args:
        frames: a slice, or a list of the numbers of the frames.
        needs_poses: leave out those frames of a slice that have no pose.
        origin: a point (m) in the recording's world, from which positions in the sequence count; by
            default `recording.origin`.
        as_stored: let `depths_mm` hold the values of the files, in any unit.

    Images stay in memory for the next call. Raises DataError if an image cannot be read, or if no
    frame is left.
    """
    ids = select_frames(recording, frames, needs_poses and isinstance(frames, slice))
    images = images_of(recording)
    colors, depths = images.arrays_of(ids)
    depths_mm = depths if as_stored else images.in_millimetres(depths, ids)
    origin = np.array(recording.origin if origin is None else origin, dtype=float)
    T_world_camera = shifted(recording.T_world_camera[ids], -origin)
    return RgbdSequence(
        recording.name, images.camera_of(ids[0]), colors, depths_mm, T_world_camera=T_world_camera,
        frame_ids=ids, times=recording.times[ids], origin=origin,
        declared_unit=recording.declared.metres_per_unit or None,
    )  # fmt: skip


def select_frames(recording: Recording, frames: Any, needs_poses: bool = True) -> Frames:
    """The numbers of the frames in a slice or list; with `needs_poses` only of those with a pose.

    Raises DataError if there is no such frame, or a number that no frame has.
    """
    try:
        frame_ids = np.atleast_1d(np.arange(len(recording))[frames])
    except (IndexError, TypeError, ValueError):
        advice = f"give a slice, or a list of numbers below {len(recording)}"
        raise DataError(f"frames {frames!r:.80} of {recording.folder}: {advice}") from None
    found = f"{len(frame_ids)} of the {len(recording)} frames in {recording.folder} are selected"
    if needs_poses:
        frame_ids = frame_ids[recording.has_pose[frame_ids]]
        found += f", and {len(frame_ids)} of these have a pose"
    if not len(frame_ids):
        add = f"add poses ({recording.pose_file or ' or '.join(recording.format.poses)})"
        choose = "choose others (--frames, or scenes.track_frames for tables)"
        raise DataError(f"{found}: {choose}, {add}, or track with --map-from, without poses")
    return frame_ids


def without_outliers(sequence: RgbdSequence) -> RgbdSequence:
    """The sequence with depths beyond `far_limit` set to 0; the same object if there are none."""
    sample = sequence.depths_mm[:, ::4, ::4]  # every sixteenth pixel suffices for a quantile
    is_far = sequence.depths_mm > far_limit(sample[sample > 0])
    if not is_far.any():
        return sequence
    return replace(sequence, depths_mm=np.where(is_far, np.uint16(0), sequence.depths_mm))


def far_limit(depths: np.ndarray) -> float:
    """The depth beyond which measured depths are outliers, in the unit of `depths`."""
    return FAR * float(np.quantile(depths, 0.9)) if len(depths) else np.inf
