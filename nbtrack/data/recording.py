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
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Frames, Poses, Position
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.formats import (
    FORMATS,
    WORLD_TO_CAMERA,
    Declaration,
    Format,
    declaration,
    files_of,
    inverse,
    is_declared,
)
from nbtrack.data.names import frame_keys, frame_numbers, stamp_in
from nbtrack.data.text_files import Calibration, Times, read_calibration, read_poses, read_rows

_END_OF_PNG = 64  # bytes: the checksum of all pixels, and the marker of the end
_TOLERANCE = 0.02  # s between what belongs together: that of the TUM benchmark's associate.py
_SAME_TIME = 1e-6  # s: the last digit of lists
_ON_TIME = 1e-3  # s between a stamp and the number, over the rate, of the same frame
_GAP = 0.0505  # s between poses that are interpolated, 20 Hz: at a hand's 2 m/s² 0.6 mm off
_ABSURD = 1e12  # s: no stamp, and larger numbers overflow
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
    """Times of frames that no list names: from a file, their names, or the numbers in these."""
    path, numbers, stamps = folder / TIMES_FILE, frame_numbers(colors), _stamps_of(colors)
    if not path.is_file():
        if stamps is not None and (np.diff(stamps) > 0).all():
            return stamps
        return (np.arange(len(colors)) if numbers is None else numbers - numbers[0]) / rate_hz
    rows = read_rows(path, lambda line: [float(line)], (1,), "the time (s) of a frame")
    times = np.array(rows).ravel()
    if len(times) != len(colors) or not (np.diff(times) > 0).all():
        raise DataError(
            f"{path} has {len(times)} times for {len(colors)} images: write one each (s), rising"
        )
    return times


def _calibration(folder: Path, layout: Format) -> Calibration:
    """The folder's own calibration, else one that is assumed by the folder's name."""
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
    tables = [read_poses(file, recording.declared.quaternion) for file in files]
    poses, stamps = np.concatenate([T for T, _ in tables]), tables[0][1]
    is_listed, has_file = layout.color[0].endswith(".txt"), (folder / TIMES_FILE).is_file()
    is_timed = is_listed or has_file or _stamps_of(colors) is not None
    if "*" in path.name:
        _check_paired(colors, files)
        paired = poses
    elif stamps is not None and (is_listed or (is_timed and _share_clock(recording, stamps))):
        paired = _by_time(recording, poses, stamps, path)
    else:
        paired = _by_number(recording, poses, stamps, path)
        is_whole = stamps is not None and len(stamps) == len(colors)
        if is_whole and not is_timed and (np.diff(stamps) > 0).all():
            recording = replace(recording, times=stamps)
    if paired is None or len(paired) != len(colors):
        raise DataError(
            f"{path} has {len(poses)} poses but there are {len(colors)} images, {colors[0].name} "
            f"to {colors[-1].name}, and nothing tells whose each is: every image needs one, 'nan' "
            "where it has none, and every pose an image; remove what is odd, or write "
            f"{TIMES_FILE}, a time (s) an image on the clock of the poses' stamps"
        )
    recording = replace(recording, file_poses=paired, pose_file=path)
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


def _share_clock(recording: Recording, stamps: Times) -> bool:
    """Whether stamps lie near frames' times, and are not all theirs to the last digit."""
    is_near = _nearest(recording.times, stamps, _TOLERANCE) >= 0
    is_own = np.isin(stamps, recording.times).all()
    return is_near.any() and np.isfinite(stamps).all() and not is_own


def _by_time(recording: Recording, poses: Poses, stamps: Times, path: Path) -> Poses:
    """A pose a frame: interpolated where one before and one after are close to each other,
    else the nearest; NaN where none is near."""
    times = recording.times
    placed = _at(poses, _nearest(times, stamps, _TOLERANCE, path))
    stamps = stamps.clip(-_ABSURD, _ABSURD)
    order = np.argsort(stamps, kind="stable")
    later = np.searchsorted(stamps[order], times).clip(1, len(order) - 1)
    first, second = order[later - 1], order[later]
    late, early = times - stamps[first], stamps[second] - times
    apart = np.minimum(late, early)
    # A frame keeps a pose of its very time as the file has it.
    kept = (late + early <= _GAP) & (apart > _SAME_TIME)
    kept &= np.isfinite(poses[first] + poses[second]).all(axis=(1, 2))
    if kept.any():
        flip = inverse if recording.declared.poses == WORLD_TO_CAMERA else np.copy
        share = late[kept] / (late + early)[kept]
        placed[kept] = flip(_between(flip(poses[first[kept]]), flip(poses[second[kept]]), share))
        recording.notes.append(
            f"{kept.sum()} of {len(times)} poses are interpolated, the nearest in {path.name} "
            f"{1e3 * np.median(apart[kept]):.1f} ms away (at most {1e3 * apart[kept].max():.1f} ms)"
        )
    return placed


def _at(poses: Poses, places: Frames) -> Poses:
    """The poses at places in a list; NaN at -1."""
    return np.where(places[:, None, None] >= 0, poses[places], np.nan)


def _between(first: Poses, second: Poses, share: Times) -> Poses:
    """Poses after a share of the way: the camera goes straight, and turns about one axis."""
    T, start = first.copy(), Rotation.from_matrix(first[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    T[:, :3, :3] = (start * Rotation.from_rotvec(share[:, None] * turn)).as_matrix()
    T[:, :3, 3] += share[:, None] * (second - first)[:, :3, 3]
    return T


def _by_number(
    recording: Recording, poses: Poses, stamps: Times | None, path: Path
) -> Poses | None:
    """A pose a frame, of a list that names no images; None where nothing tells it.

    By the images' numbers, where stamps, or places in the list, are these in just one way; else one
    after another, if there are as many. Raises DataError if no stamp is a frame's.
    """
    colors, rate = recording.color_files, recording.declared.frame_rate
    n_images, n_poses, numbers = len(colors), len(poses), frame_numbers(colors)
    is_stamped = stamps is not None and (np.abs(stamps) < _ABSURD).all()
    clock = stamps if is_stamped else np.arange(n_poses) / rate
    near = min(_ON_TIME, 0.25 / rate)
    ways = [_nearest(times, clock, near) for times in _clocks(recording, numbers, clock)]
    whole = {tuple(way) for way in ways if (way >= 0).sum() == min(n_images, n_poses)}
    if len(whole) == 1 and (is_stamped or n_poses > n_images):
        if n_poses > n_images:
            chosen = f"those of the {n_images} images' numbers"
            recording.notes.append(f"of {n_poses} poses in {path.name} {chosen}")
        return _at(poses, np.array(whole.pop()))
    if n_poses != n_images:
        if is_stamped and not whole:
            _nearest(recording.times, clock, _ON_TIME, path)
        return None
    if is_stamped and any((way >= 0).mean() > 0.75 for way in ways):
        steps, image_steps = rate * np.diff(clock), rate * np.diff(recording.times)
        # Stamps leave out other frames than the images do. Equal steps only count the lines.
        if np.ptp(steps) > 0.1 and (np.rint(steps) != np.rint(image_steps)).any():
            return None
    if not np.array_equal(numbers, np.arange(n_images)):
        named = f"images {colors[0].name} to {colors[-1].name}"
        recording.notes.append(f"{named} have the poses of {path.name} one after another")
    return poses


def _clocks(recording: Recording, numbers: Frames | None, clock: Times) -> list[Times]:
    """Times (s) that frames may have on a clock of poses, by the number from which they count."""
    if np.isin(clock, recording.times).all():
        return [recording.times]  # as in trajectories that nbtrack wrote
    if numbers is None:
        return []
    first, is_whole = numbers[0], np.ptp(numbers) == len(numbers) - 1
    is_known = recording.format.counts_from_0 and not (first == 1 and is_whole)
    starts = {0} if is_known else {0, min(first, 1), first}
    return [(numbers - start) / recording.declared.frame_rate for start in starts]


def _stamps_of(files: list[Path]) -> Times | None:
    """The times (s) that all files are named after, if they are."""
    stamps = [stamp_in(path) for path in files]
    return None if None in stamps else np.array(stamps)


def _check_paired(colors: list[Path], others: list[Path]) -> None:
    """Raises DataError unless every image has its depth map or pose, with the same frame number."""
    keys, other_keys = frame_keys(colors), frame_keys(others)
    if keys != other_keys or len(set(keys)) < len(keys):
        count = Counter([*keys, *other_keys])
        both = zip((*colors, *others), (*keys, *other_keys), strict=True)
        odd = [path.name for path, key in both if count[key] != 2]
        raise DataError(
            f"{colors[0].parent} has {len(colors)} images but {others[0].parent.name}/ has "
            f"{len(others)} {others[0].suffix} files ({len(odd)} without a partner, or with two: "
            f"{', '.join(odd[:4])}): every image needs one of its number, and a folder one "
            "session; rename or remove them"
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


def _nearest(times: Times, others: Times, tolerance: float, path: Path | None = None) -> Frames:
    """For every time the index of the nearest other one; -1 if none is within the tolerance (s).

    Raises DataError, which names the file of the others where it is given, if that is so
    everywhere, or one of them is not finite.
    """
    closest = cKDTree(np.nan_to_num(others)[:, None]).query(times[:, None], p=1)[1]
    is_near = np.abs(others[closest] - times) <= tolerance
    if path and not (is_near.any() and np.isfinite(others).all()):
        raise DataError(
            f"{path} ({_span(others)}) has no time within {tolerance:g} s of the images' "
            f"({_span(times)}): it needs finite timestamps of the same clock"
        )
    return np.where(is_near, closest, -1)


def _span(times: Times) -> str:
    return f"{times.min():.13g} to {times.max():.13g} s"
