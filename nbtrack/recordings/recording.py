"""Open a recording: find and pair its files, and read its poses and calibration, but no image."""

from dataclasses import dataclass, replace
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
    """The frames of a recording: their files, times, poses and camera, and what numbers mean."""

    folder: Path
    name: str  # of the folder
    format: Format
    declared: Declaration  # what the numbers in the files mean
    color_files: list[Path]  # one for each frame, in the order of the recording
    depth_files: list[Path]  # one for each frame
    times: Times  # s, of each frame; without recorded times frame number / declared rate
    calibration: Calibration  # of the depth images, to which colour is registered
    notes: list[str]  # for the user: what was assumed, and what was left out
    # One for each frame, with the numbers of the file, whose meaning is `declared`; NaN without.
    file_poses: Poses
    pose_file: Path | None = None  # for messages; with `*` if every frame has a file of its own

    def __post_init__(self) -> None:
        """Lets nobody change the arrays in place: all who use the recording share them."""
        self.times.flags.writeable = self.file_poses.flags.writeable = False

    def __len__(self) -> int:
        return len(self.color_files)

    @property
    def T_world_camera(self) -> Poses:
        """Camera-to-world poses (m) with OpenCV's camera axes; NaN for frames without a pose."""
        return self.declared.poses_to_opencv(self.file_poses)

    @property
    def has_pose(self) -> Bool[np.ndarray, "frames"]:
        """Which frames have a pose."""
        return np.isfinite(self.file_poses).all(axis=(1, 2))

    @property
    def origin(self) -> Position:
        """The point (m, world) that is subtracted from all positions in sequences.

        It is 0 if no coordinate of the median camera is above 1 km. Farther away, as in map
        coordinates, single precision would lose millimetres, so the origin is the point nearest to
        the median camera whose coordinates are whole kilometres. Recordings of one place then
        mostly share their origin.
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
    """Find the files of a recording, and read its poses and calibration. Images are read later.

    Without `format` the files tell the format. `depth_folder` and `pose_file` replace those of the
    format. Raises MissingError, DataError or ConfigError if something is not there or is wrong.
    """
    folder = absolute(folder)
    declared = declaration(folder, format)
    layout = FORMATS[declared.format]
    patterns = [f"{depth_folder}/{Path(p).name}" if depth_folder else p for p in layout.depth]
    colors = layout.files(folder, layout.color, "colour images (PNG or JPEG)")
    depths = layout.files(folder, patterns, "depth maps (PNG of 16 bits)")
    list_note = ""
    if colors[0].suffix == ".txt":  # a list of images, as `depths` is one of depth maps
        colors, depths, recorded_times, list_note = pair_lists(colors[0], depths[0])
    else:
        check_paired(colors, depths)
        recorded_times = _recorded_times(folder, colors)
    camera, camera_note = _calibration(folder, layout)
    if camera.depth_scale:  # it replaces the format's, but not one in `sequence.toml`
        declared = declaration(folder, declared.format, camera.depth_scale)
    moments = Moments(colors, recorded_times, declared.frame_rate, layout.counts_from_0)
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


def _recorded_times(folder: Path, colors: list[Path]) -> Times | None:
    """The times (s) of the images in a folder; None if they are not known.

    They come from `timestamps.txt`, or without this file from the images' names if all hold a time.
    Raises DataError if they do not rise, or are not one finite time for each image.
    """
    path = folder / TIMES_FILE
    if path.is_file():
        times = in_seconds(read_numbers(path, (1,), "the time (s) of a frame").ravel())
        if len(times) != len(colors) or not np.isfinite(times).all():
            found = f"{path} has {len(times)} times for {len(colors)} images"
            raise DataError(f"{found}: write one each, rising, in seconds, ms, us or ns")
    else:
        stamps = [stamp_in(file) for file in colors]
        # The same time in all names is the one when the recording began.
        if None in stamps or len(set(stamps)) == 1:
            return None
        path, times = colors[0].parent, np.array(stamps)
    check_rising(times, path)
    return times


def _calibration(folder: Path, layout: Format) -> tuple[Calibration, str]:
    """The calibration of a recording, and a note for the user.

    It is read from the folder. If the folder has no file of it, and the format knows a camera for
    the folder's name, that camera is assumed. The note says what is assumed, or which entries of
    the file are not used; else it is empty. Raises MissingError if there is no calibration.
    """
    known = [c for c in layout.known_cameras if c.source.name in folder.name]
    if known and not any((folder / name).is_file() for name in layout.cameras):
        assumed = f"the camera assumed for {layout.label}"
        note = f"{assumed}, {known[0].fx:g} px at 640x480: no {layout.cameras[0]}"
        return replace(known[0], source=folder / assumed), note
    file = layout.files(folder, layout.cameras, "calibration")[0]
    with naming_damaged(file, f"camera of {layout.label}", _AGAIN):
        camera = layout.read_camera(file)
    note = f"not used of {camera.source.name}: {', '.join(camera.unused)}" if camera.unused else ""
    return camera, note


def _pose_pattern(folder: Path, layout: Format) -> str | None:
    """The one of the format's patterns of pose files that matches files in the folder.

    The pattern holds a `*` if every frame has a file of its own. It is None if the folder has no
    poses. Raises DataError if files of several patterns are there.
    """
    there = [pattern for pattern in layout.poses if files_of(folder, pattern)]
    if len(there) > 1:
        both = " and ".join(there)
        raise DataError(f"{folder} has {both}: keep one, or choose by `data convert --poses FILE`")
    return there[0] if there else None


def _poses_and_times(
    files: list[Path], path: Path, layout: Format, declared: Declaration, moments: Moments
) -> tuple[Poses, Times, str]:
    """The pose (as in the file) and the time (s) of each frame, and a note for the user.

    `path` is the one file of poses, or a pattern with `*` if each frame has a file of its own. The
    note says how poses were given to frames; it is empty if poses and frames are plainly pairs.
    """
    tables = []
    for file in files:
        with naming_damaged(file, f"pose file of {layout.label}", _AGAIN):
            tables.append(layout.read_poses(file, declared.quaternion))
    listed = checked_poses(np.concatenate([poses for poses, _ in tables]), path)
    stamps = np.concatenate([times for _, times in tables])  # s; NaN for a pose without a time
    if len(stamps) > 1 and np.ptp(stamps) == 0:  # a tool that has no times wrote the same one
        stamps = np.full(len(stamps), np.nan)
    check_rising(stamps, path)
    # Frames without recorded times get those of the poses if each pose has one and these are
    # equally many.
    is_one_each = len(stamps) == len(moments.times) and np.isfinite(stamps).all()
    times = stamps if moments.recorded_times is None and is_one_each else moments.times
    if "*" in path.name:  # every frame has a file of its own
        check_paired(moments.images, files)
        return listed, times, ""
    # In formats without `stamps_tell` a stamp says whose a pose is only if frames have times, too.
    tells = layout.stamps_tell or moments.recorded_times is not None
    telling = stamps if tells else np.full(len(stamps), np.nan)
    poses, note = moments.poses_of(path, listed, telling, declared.inverted_if_world_to_camera)
    return poses, times, f"{path.name}: {note}" if note else ""
