"""A recording: its files found and paired, its texts read, before any pixel is decoded."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from nbtrack.core.arrays import Poses, Position
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import absolute, naming_damaged
from nbtrack.machinery.inputs import checked_poses, read_numbers
from nbtrack.recordings.calibration import Calibration
from nbtrack.recordings.formats import FORMATS, Declaration, Format, declaration, files_of
from nbtrack.recordings.pairing import TIMES_FILE, Moments, check_paired, pair_lists
from nbtrack.recordings.pose_files import Times, check_rising, in_seconds, stamp_in

_AGAIN = "export the recording again, or name another format with --format"


@dataclass(frozen=True, eq=False)
class Recording:
    """What is found in a folder: paired image files, poses as the file has them, their meaning."""

    folder: Path
    name: str  # the folder's own
    format: Format
    declared: Declaration
    color_files: list[Path]  # in the order of the recording, frame by frame
    depth_files: list[Path]
    times: Times  # of the frames, as recorded, or by their numbers and the rate declared
    calibration: Calibration  # of the depth images, and of the colour that lies on them
    notes: list[str]  # what was assumed, and left out
    file_poses: Poses  # as `declared` says; NaN without a pose
    pose_file: Path | None = None  # named in messages; with `*` where every frame has a file

    def __len__(self) -> int:
        return len(self.color_files)

    @cached_property
    def T_world_camera(self) -> Poses:
        """Camera-to-world poses with OpenCV's camera axes; NaN where there is none."""
        return self.declared.poses_to_opencv(self.file_poses)

    @cached_property
    def has_pose(self) -> Bool[np.ndarray, "frames"]:
        """Which frames have a pose."""
        return np.isfinite(self.file_poses).all(axis=(1, 2))

    @cached_property
    def origin(self) -> Position:
        """The point (m, world) that is subtracted from positions in sequences.

        It is 0 unless the cameras are more than 1 km from 0, as in map coordinates: there single
        precision would soon lose millimetres. Then it is near them, in whole kilometres, so that
        recordings of one place have one origin, which is that of its map.
        """
        if not self.has_pose.any():
            return np.zeros(3)
        center = np.median(self.T_world_camera[self.has_pose, :3, 3], axis=0)
        return np.round(center, -3) if np.abs(center).max() > 1000 else np.zeros(3)


def open_recording(
    folder: Path | str,
    format: str | None = None,
    depth_folder: str | None = None,
    pose_file: str | None = None,
) -> Recording:
    """Find the files of a recording and read its poses and calibration; pixels come later.

    Without `format` the files tell it; `depth_folder` and `pose_file` replace the format's own.
    Raises MissingError, DataError or ConfigError if something is not there, wrong or unknown.
    """
    folder = absolute(folder)
    declared = declaration(folder, format)
    layout = FORMATS[declared.format]
    patterns = [f"{depth_folder}/{Path(p).name}" if depth_folder else p for p in layout.depth]
    colors = layout.files(folder, layout.color, "colour images (PNG or JPEG)")
    depths = layout.files(folder, patterns, "depth maps (PNG of 16 bits)")
    list_note = ""
    if colors[0].suffix == ".txt":  # lists of images
        colors, depths, own_times, list_note = pair_lists(colors[0], depths[0])
    else:
        check_paired(colors, depths)
        own_times = _own_times(folder, colors)
    camera, camera_note = _calibration(folder, layout)
    if camera.depth_scale:
        declared = declaration(folder, declared.format, camera.depth_scale)
    moments = Moments(colors, own_times, declared.frame_rate, layout.counts_from_0)
    pattern = pose_file or _pose_pattern(folder, layout)
    pose_path = folder / pattern if pattern else None
    if pose_path:
        files = layout.files(folder, (pattern,), "poses")
        poses, times, pose_note = _poses_and_times(files, pose_path, layout, declared, moments)
    else:
        poses, times = np.full((len(colors), 4, 4), np.nan), moments.times
        pose_note = "no poses"
    notes = [note for note in (list_note, camera_note, pose_note) if note]
    return Recording(
        folder, folder.name, layout, declared, color_files=colors, depth_files=depths, times=times,
        calibration=camera, notes=notes, file_poses=poses, pose_file=pose_path,
    )  # fmt: skip


def _own_times(folder: Path, colors: list[Path]) -> Times | None:
    """Times (s) of images that stand in a folder, not in a list with times; None if not known.

    They come from `timestamps.txt`, else from the images' names if all hold a time.
    """
    path = folder / TIMES_FILE
    if path.is_file():
        times = in_seconds(read_numbers(path, (1,), "the time (s) of a frame").ravel())
        if len(times) != len(colors) or not np.isfinite(times).all():
            found = f"{path} has {len(times)} times for {len(colors)} images"
            raise DataError(f"{found}: write one each, rising, in seconds, ms, us or ns")
    else:
        stamps = [stamp_in(file) for file in colors]
        if None in stamps or len(set(stamps)) == 1:  # one of all: when the recording began
            return None
        path, times = colors[0].parent, np.array(stamps)
    check_rising(times, path)
    return times


def _calibration(folder: Path, layout: Format) -> tuple[Calibration, str]:
    """The folder's own calibration, else one that is assumed by the folder's name; and a note.

    The note tells what is assumed, or what the file says that is not used; else it is empty.
    """
    known = [c for c in layout.known_cameras if c.source.name in folder.name]
    if known and not any((folder / name).is_file() for name in layout.cameras):
        assumed = f"the camera assumed for {layout.label}"
        note = f"{assumed}, {known[0].fx:g} px at 640x480: no {layout.cameras[0]}"
        return replace(known[0], source=folder / assumed), note
    file = layout.files(folder, layout.cameras, "calibration")[0]
    with naming_damaged(file, f"camera of {layout.label}", _AGAIN):
        camera = layout.read_camera(file)
    unused = ", ".join(camera.unused)
    return camera, f"not used of {camera.source.name}: {unused}" if camera.unused else ""


def _pose_pattern(folder: Path, layout: Format) -> str | None:
    """The format's pattern whose files of poses are there, with `*` where every frame has a file.

    None if the folder has no poses. Raises DataError if it has those of two patterns.
    """
    there = [pattern for pattern in layout.poses if files_of(folder, pattern)]
    if len(there) > 1:
        both = " and ".join(there)
        raise DataError(f"{folder} has {both}: keep one, or choose by `data convert --poses FILE`")
    return there[0] if there else None


def _poses_and_times(
    files: list[Path], path: Path, layout: Format, declared: Declaration, moments: Moments
) -> tuple[Poses, Times, str]:
    """A pose and a time (s) for each frame, and a note of how poses were given to frames.

    The note is empty where that is plain. `path` is the one file of poses, or a pattern with `*`
    where each frame has a file.
    """
    tables = []
    for file in files:
        with naming_damaged(file, f"pose file of {layout.label}", _AGAIN):
            tables.append(layout.read_poses(file, declared.quaternion))
    listed = checked_poses(np.concatenate([poses for poses, _ in tables]), path)
    stamps = np.concatenate([times for _, times in tables])
    if len(stamps) > 1 and np.ptp(stamps) == 0:  # written by a tool that has no times
        stamps = np.full(len(stamps), np.nan)
    check_rising(stamps, path)
    # Frames without times of their own have those of the poses, if there are as many.
    is_one_each = len(stamps) == len(moments.times) and (np.diff(stamps) > 0).all()
    times = stamps if moments.own is None and is_one_each else moments.times
    if "*" in path.name:
        check_paired(moments.images, files)
        return listed, times, ""
    # In some formats stamps are not used to give poses to frames, but only as times, above.
    used = stamps if layout.stamps_tell else np.full(len(stamps), np.nan)
    poses, note = moments.poses_of(path, listed, used, declared.inverted_if_world_to_camera)
    return poses, times, f"{path.name}: {note}" if note else ""
