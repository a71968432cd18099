"""A recording: its files found and paired, its texts read, before any pixel is decoded.

Images, depth maps and poses belong together by numbers in their names, or by times in lists.
"""

import hashlib
import os
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from nbtrack.core.arrays import Frames, Poses, Position
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.formats import (
    FORMATS,
    Declaration,
    Format,
    declaration,
    files_of,
    is_declared,
    numbers_in,
    stamp_in,
)
from nbtrack.data.text_files import Calibration, Times, read_calibration, read_poses, read_rows

_END_OF_PNG = 64  # bytes: the checksum of all pixels, and the marker of the end
_TOLERANCE = 0.02  # s between what belongs together: that of the TUM benchmark's associate.py
_SINCE_1970 = 1e8  # s: times of a clock, and not of a recording's beginning
_FAR_FROM_ZERO = 1000.0  # m; there single precision still resolves 0.06 mm
_ALONE = 1000.0  # m from the middle, and so many times as far as nine in ten: no camera went there
TIMES_FILE = "timestamps.txt"  # one a line (s); ours, in folders of numbered images


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
        """Where (m) sequences have their origin: whole metres near the cameras of a recording that
        is far from zero, as in map coordinates, since single precision would lose them; else 0."""
        if not self.has_pose.any():
            return np.zeros(3)
        center = np.median(self.T_world_camera[self.has_pose, :3, 3], axis=0)
        return np.round(center) if np.abs(center).max() > _FAR_FROM_ZERO else np.zeros(3)

    def contents(self) -> tuple[list[tuple[str, str, str]], str, Declaration]:
        """What changes when a recording does: of every image its name and a digest, one of times,
        poses and camera, and the declaration."""
        files = self.color_files + self.depth_files
        images = [(file.parent.name, file.name, image_digest(file)) for file in files]
        digest = hashlib.sha256(repr(replace(self.calibration, source=Path())).encode())
        digest.update(self.times.tobytes() + self.file_poses.tobytes())
        return images, digest.hexdigest(), self.declared


def image_digest(file: Path) -> str:
    """A digest of an image file that is cheap for long recordings.

    A PNG ends with checksums of all its pixels, so that its size and its end tell; other files are
    read whole.
    """
    with file.open("rb") as opened:
        size = opened.seek(0, os.SEEK_END)
        opened.seek(max(0, size - _END_OF_PNG) if file.suffix.lower() == ".png" else 0)
        return hashlib.blake2b(opened.read() + str(size).encode(), digest_size=8).hexdigest()


def open_recording(
    folder: Path | str,
    format: str | None = None,
    depth_folder: str | None = None,
    pose_file: str | None = None,
) -> Recording:
    """Find the files of a recording and read its poses and calibration; pixels come later.

    The format is told by the files, unless named; a depth folder or a pose file replaces its own.
    Raises MissingError, DataError or ConfigError if something is not there, wrong or unknown.
    """
    folder, notes = Path(folder), []
    declared = declaration(folder, format)
    layout = FORMATS[declared.format]
    images = _images(folder, declared, depth_folder, notes)
    camera, no_poses = _calibration(folder, layout), np.full((len(images[0]), 4, 4), np.nan)
    if not camera.source.is_file():
        notes.append(f"{camera.source.name}, {camera.fx:g} px at 640x480: no {layout.cameras[0]}")
    if camera.unused:
        notes.append(f"not used of {camera.source.name}: {', '.join(camera.unused)}")
    if camera.depth_scale and not is_declared(folder, "depth_scale"):
        declared = replace(declared, depth_scale=camera.depth_scale)
    name = folder.resolve().name
    recording = Recording(folder, name, layout, declared, *images, camera, notes, no_poses)
    return _with_poses(recording, pose_file)


def _images(
    folder: Path, declared: Declaration, depth_folder: str | None, notes: list[str]
) -> tuple[list[Path], list[Path], Times]:
    """Colours and depths in pairs, and their times; notes are added on what is left out."""
    layout = FORMATS[declared.format]
    depth = [f"{depth_folder}/{Path(p).name}" if depth_folder else p for p in layout.depth]
    colors = layout.files(folder, layout.color, "colour images (PNG or JPEG)")
    depths = layout.files(folder, depth, "depth maps (PNG of 16 bits)")
    if colors[0].suffix == ".txt":
        return _listed_pairs(colors[0], depths[0], notes)
    _check_paired(colors, depths)
    return colors, depths, _times(folder, colors, declared.frame_rate)


def _times(folder: Path, colors: list[Path], rate_hz: float) -> Times:
    """Of frames that no list of files times: from a file, their names, or the numbers in these."""
    path, numbers, stamps = folder / TIMES_FILE, _numbers_of(colors), _stamps_of(colors)
    if not path.is_file():
        if stamps is not None and (np.diff(stamps) > 0).all():
            return stamps
        is_counted = (np.diff(numbers) > 0).all()
        return (numbers - numbers[0] if is_counted else np.arange(len(colors))) / rate_hz
    rows = read_rows(path, lambda line: [float(line)], (1,), "the time (s) of a frame")
    times = np.array(rows).ravel()
    if len(times) != len(colors) or not (np.diff(times) > 0).all():
        raise DataError(
            f"{path} has {len(times)} times for {len(colors)} images: write one each (s), rising"
        )
    return times


def _calibration(folder: Path, layout: Format) -> Calibration:
    """From the folder's own file, else assumed, by the folder's name."""
    known = [c for c in layout.known_cameras if c.source.name in folder.resolve().name]
    if known and not any((folder / name).is_file() for name in layout.cameras):
        return replace(known[0], source=folder / f"the camera assumed for {layout.label}")
    named = tuple(f"{c.source} in the folder's name" for c in layout.known_cameras)
    return read_calibration(layout.files(folder, layout.cameras + named, "calibration")[0])


def _with_poses(recording: Recording, pose_file: str | None) -> Recording:
    """The recording with a pose a frame, where there is a file of poses."""
    folder, layout, colors = recording.folder, recording.format, recording.color_files
    names = (pose_file,) if pose_file else layout.poses
    there = [name for name in names if files_of(folder, name)]
    if len(there) > 1:
        both = " and ".join(there)
        raise DataError(f"{folder} has {both}: keep one, or choose by `data convert --poses FILE`")
    if not there and not pose_file:
        recording.notes.append("no poses")
        return recording
    files = layout.files(folder, names, "poses")
    path = folder / there[0]
    if "*" in path.name:
        _check_paired(colors, files)
    tables = [read_poses(file, recording.declared.quaternion) for file in files]
    poses, pose_times = np.concatenate([T for T, _ in tables]), tables[0][1]
    if pose_times is not None:
        is_by_time = layout.color[0].endswith(".txt")
        is_by_time |= _stamps_of(colors) is not None and pose_times.max() > _SINCE_1970
        poses = _placed(poses, pose_times, recording.times, path, is_by_time)
        is_untimed = not is_by_time and not (folder / TIMES_FILE).is_file()
        if is_untimed and len(pose_times) == len(colors) and (np.diff(pose_times) > 0).all():
            recording = replace(recording, times=pose_times)  # what they are stamped with
    numbers = _numbers_of(colors)
    if len(poses) > len(colors) and 0 <= numbers.min() <= numbers.max() < len(poses):
        chosen = f"those of the {len(colors)} images' numbers"
        recording.notes.append(f"of {len(poses)} poses in {path.name} {chosen}")
        poses = poses[numbers]
    if len(poses) != len(colors):
        raise DataError(
            f"{path} has {len(poses)} poses but there are {len(colors)} images: every image needs "
            "one, 'nan' where it has none, and every pose an image; remove what is odd"
        )
    recording = replace(recording, file_poses=poses, pose_file=path)
    _check_together(recording)
    return recording


def _check_together(recording: Recording) -> None:
    """Raises DataError for a pose that lies far from all others."""
    ids = np.flatnonzero(recording.has_pose)
    positions = recording.T_world_camera[ids, :3, 3]
    if not len(ids):
        return
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    usual = np.quantile(away, 0.9, method="lower")
    for i in np.flatnonzero((away > _ALONE) & (away > _ALONE * usual)):
        raise DataError(
            f"{recording.pose_file} frame {ids[i]} lies {away[i]:.3g} m from the others, which "
            f"keep within {usual:.3g} m: correct its pose, or write nan for it"
        )


def _placed(poses: Poses, pose_times: Times, times: Times, path: Path, is_by_time: bool) -> Poses:
    """The pose nearest to every frame in time; NaN where none is near.

    In formats by number they are taken as they stand, but for nbtrack's own trajectories, which
    leave frames out.
    """
    if len(poses) == len(times) and not is_by_time:
        return poses
    closest = _nearest(times, pose_times, _TOLERANCE if is_by_time else 1e-3, path)
    placed = np.where(closest[:, None, None] >= 0, poses[closest], np.nan)
    # Unless all poses find a frame the times are something else.
    is_whole = np.isfinite(placed).sum() == np.isfinite(poses).sum()
    return placed if is_by_time or is_whole else poses


def _stamps_of(files: list[Path]) -> Times | None:
    """The times (s) that all files are named after, if they are."""
    stamps = [stamp_in(path) for path in files]
    return None if None in stamps else np.array(stamps)


def _numbers_of(files: list[Path]) -> Frames:
    """Frame numbers: the last in each file's name; -1 if it has none. Of times: microseconds."""
    if (stamps := _stamps_of(files)) is not None:
        return np.rint(1e6 * stamps).astype(np.int64)
    return np.array([[-1, *numbers_in(path)][-1] for path in files])


def _check_paired(colors: list[Path], others: list[Path]) -> None:
    """Raises DataError unless every image has its depth map or pose, with the same frame number."""
    numbers, other_numbers = _numbers_of(colors), _numbers_of(others)
    if not np.array_equal(numbers, other_numbers):
        count = Counter([*numbers, *other_numbers])
        odd = [path.name for path in (*colors, *others) if count[_numbers_of([path])[0]] != 2]
        raise DataError(
            f"{colors[0].parent} has {len(colors)} images but {others[0].parent.name}/ has "
            f"{len(others)} {others[0].suffix} files ({len(odd)} without a partner: "
            f"{', '.join(odd[:4])}): every image needs one of its number; rename or remove them"
        )


def _listed_pairs(
    color_list: Path, depth_list: Path, notes: list[str]
) -> tuple[list[Path], list[Path], Times]:
    """Images and depth maps of two lists that are each other's nearest in time, and the times."""
    (color_times, colors), (depth_times, depths) = map(_read_list, (color_list, depth_list))
    closest = _nearest(color_times, depth_times, _TOLERANCE, depth_list)
    back = _nearest(depth_times, color_times, _TOLERANCE, color_list)
    kept = (closest >= 0) & (back[closest] == np.arange(len(colors)))
    if not kept.all():
        left_out = f"{(~kept).sum()} of the {len(kept)} images in {color_list.name} are left out"
        notes.append(f"{left_out}: no depth map of {depth_list.name} is within {_TOLERANCE} s")
    colors = [colors[i] for i in np.flatnonzero(kept)]
    return colors, [depths[i] for i in closest[kept]], color_times[kept]


def _read_list(path: Path) -> tuple[Times, list[Path]]:
    """Times and files of a list with `timestamp file` a line, in the order of time."""
    meaning = "'timestamp file', as in '1305031102.175 rgb/1305031102.175.png'"
    rows = sorted(read_rows(path, _entry, (2,), meaning), key=lambda row: row[0])
    files = [path.parent / name for _, name in rows]
    # Unlike pathlib's, it takes names that no file can have.
    if absent := [file for file in files if not os.path.isfile(file)]:
        raise MissingError(
            f"{len(absent)} of {len(files)} files named in {path} are not there, the first of them "
            f"{str(absent[0])[:200]!r}: add them, or take their lines out"
        )
    return np.array([time for time, _ in rows]), files


def _entry(line: str) -> tuple[float, str]:
    time, name = line.split(maxsplit=1)
    if not np.isfinite(float(time)):
        raise ValueError
    return float(time), name.strip()


def _nearest(times: Times, others: Times, tolerance: float, path: Path) -> Frames:
    """For every time the index of the nearest other one; -1 if none is within the tolerance (s).

    Raises DataError, which names the file of the others, if that is so everywhere, or one of them
    is not finite.
    """
    closest = cKDTree(np.nan_to_num(others)[:, None]).query(times[:, None], p=1)[1]
    is_near = np.abs(others[closest] - times) <= tolerance
    if not (is_near.any() and np.isfinite(others).all()):
        raise DataError(
            f"{path} ({_span(others)}) has no time within {tolerance:g} s of the images' "
            f"({_span(times)}): it needs finite timestamps of the same clock"
        )
    return np.where(is_near, closest, -1)


def _span(times: Times) -> str:
    return f"{times.min():.13g} to {times.max():.13g} s"
