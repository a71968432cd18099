"""Write a recording of any format in the Neural RGB-D layout."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from nbtrack.core.camera import Intrinsics
from nbtrack.data.readers import FORMATS, decode, open_recording
from nbtrack.data.sequence import read_frames
from nbtrack.data.writer import SequenceWriter, layout_holds

_FRAMES_AT_ONCE = 32  # 50 MB at 640x480


@dataclass(frozen=True)
class Converted:
    """What was written, and what a user should know of it."""

    folder: Path
    format: str  # that it was read as
    frames: int
    without_pose: int  # written too, with a NaN pose
    intrinsics: Intrinsics

    def __str__(self) -> str:
        camera = self.intrinsics
        poses = f" ({self.without_pose} without a pose)" if self.without_pose else ""
        lines = [
            f"{self.folder}: {self.frames} frames{poses} of {camera.width}x{camera.height}, read "
            f"as {FORMATS[self.format].label}"
        ]
        if not layout_holds(camera):
            lines += [
                f"  the camera (fx {camera.fx:.2f}, fy {camera.fy:.2f}, principal point "
                f"({camera.cx:.2f}, {camera.cy:.2f})) is more than focal.txt can say: it is in "
                "intrinsics.txt, which nbtrack reads and other programs do not know"
            ]
        return "\n".join(lines)


def convert_sequence(
    folder: Path | str,
    out: Path | str,
    format: str | None = None,
    frames: slice = slice(None),
    depth_folder: str | None = None,
    pose_file: str | None = None,
    progress: bool = False,
) -> Converted:
    """Read a recording and write it as `out`, in the Neural RGB-D layout, a few frames at a time.

    Images are not resampled, other than to remove a lens's distortion: a camera that the layout
    cannot say goes to `intrinsics.txt`. Frames without a pose keep their number, with a NaN pose.
    `sequence.toml` is not copied: what it declares is in the files that are written.

    Args:
        folder, format, depth_folder, pose_file, progress: as `read_sequence` takes them.
        out: a folder that does not exist yet; it appears when it is complete.
        frames: Python slice over the recording's frames.

    Raises:
        MissingError, DataError, ConfigError: as `read_sequence` does; or `out` exists.
    """
    recording = open_recording(folder, format, depth_folder, pose_file)
    numbers = np.arange(len(recording))[frames]
    known = numbers[recording.has_pose[numbers]]
    # The reader says what is wrong where nothing is left.
    first = read_frames(recording, slice(known[0], known[0] + 1) if len(known) else frames)
    bar = tqdm(total=len(numbers), desc="converting", unit="frame", disable=not progress, delay=1.0)
    with bar, SequenceWriter(Path(out), first.intrinsics, ("depth",)) as writer:
        for start in range(0, len(numbers), _FRAMES_AT_ONCE):
            part = numbers[start : start + _FRAMES_AT_ONCE]
            decoded = decode(recording, part)
            for i, number in enumerate(part):
                depths_mm = {"depth": decoded.depths[i]}
                writer.add(decoded.colors[i], depths_mm, recording.T_world_camera[number])
            bar.update(len(part))
    return Converted(
        Path(out), recording.declared.format, len(numbers), len(numbers) - len(known),
        first.intrinsics,
    )  # fmt: skip
