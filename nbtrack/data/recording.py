"""A recording whose files are found and whose texts are read, before any pixel is decoded."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nbtrack.core.arrays import Poses, Position
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.formats import DECLARATION_FILE, FORMATS, Declaration, Format, declaration
from nbtrack.data.pairs import check_paired, listed_pairs, numbered_files, numbers_of, posed_by_time
from nbtrack.data.text_files import Calibration, Times, read_calibration, read_poses, read_rows

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
    file_poses: Poses  # as `declared` says; NaN without a pose
    pose_file: Path | None  # named in messages; with `*` where every frame has a file
    calibration: Calibration  # of the depth images, and of the colour that lies on them
    text_files: list[Path]  # everything read beside the images
    notes: list[str]  # what was assumed, and left out

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

    def contents(self) -> tuple[list[tuple[str, str, int, int]], list[str], Declaration]:
        """What changes when a recording does: texts, the declaration, and of every image its name,
        size and time of change (ns)."""
        images = []
        for file in self.color_files + self.depth_files:
            status = file.stat()
            images.append((file.parent.name, file.name, status.st_size, status.st_mtime_ns))
        texts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in self.text_files]
        return images, texts, self.declared


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
    folder = Path(folder)
    declared = declaration(folder, format)
    layout = FORMATS[declared.format]
    colors, depths, times, left_out = _images(folder, declared, depth_folder)
    poses, path, pose_files, chosen = _poses(folder, declared, pose_file, colors, times)
    _check_together(declared.poses_to_opencv(poses)[:, :3, 3], path)
    camera, notes = _calibration(folder, layout), [left_out, chosen]
    if not camera.source.is_file():
        notes.append(f"{camera.source.name}, {camera.fx:g} px at 640x480: no {layout.cameras[0]}")
    names = [*layout.color, *layout.depth, DECLARATION_FILE, TIMES_FILE]
    texts = [*(folder / name for name in names), *pose_files, camera.source]
    return Recording(
        folder=folder,
        name=folder.resolve().name,
        format=layout,
        declared=declared,
        color_files=colors,
        depth_files=depths,
        times=times,
        file_poses=poses,
        pose_file=path,
        calibration=camera,
        text_files=[text for text in texts if text.is_file()],
        notes=[note for note in notes if note],
    )


def _images(
    folder: Path, declared: Declaration, depth_folder: str | None
) -> tuple[list[Path], list[Path], Times, str]:
    """Colours and depths in pairs, their times, and a word on who is left out."""
    layout = FORMATS[declared.format]
    if layout.color[0].endswith(".txt"):
        names = (layout.color, layout.depth)
        return listed_pairs(*(_first_there(folder, name, "images", layout) for name in names))
    places = [(depth_folder or Path(p).parent, Path(p).name) for p in layout.depth]
    colors = numbered_files([folder / pattern for pattern in layout.color])
    depths = numbered_files([folder / place / name for place, name in places])
    check_paired(colors, depths)
    return colors, depths, _times(folder, colors, declared.frame_rate), ""


def _times(folder: Path, colors: list[Path], rate_hz: float) -> Times:
    """Of frames that no list of files times: from a file, else by the numbers in their names."""
    path, numbers = folder / TIMES_FILE, numbers_of(colors)
    if not path.is_file():
        is_counted = (np.diff(numbers) > 0).all()
        return (numbers - numbers[0] if is_counted else np.arange(len(colors))) / rate_hz
    rows = read_rows(path, lambda line: [float(line)], (1,), "the time (s) of a frame")
    times = np.array(rows).ravel()
    if len(times) != len(colors) or not (np.diff(times) > 0).all():
        raise DataError(
            f"{path} has {len(times)} times for {len(colors)} images: write one a line (s), in "
            "rising order, or remove it"
        )
    return times


def _first_there(folder: Path, names: tuple[str, ...], what: str, layout: Format) -> Path:
    for name in names:
        if (folder / name).is_file():
            return folder / name
    needed = f"{layout.label} needs {' or '.join(names)}"
    raise MissingError(
        f"no {what} in {folder}: {needed}; add it, or name another format with --format"
    )


def _calibration(folder: Path, layout: Format) -> Calibration:
    """From the folder's own file, else assumed, by the folder's name."""
    known = [c for c in layout.known_cameras if c.source.name in folder.resolve().name]
    if known and not any((folder / name).is_file() for name in layout.cameras):
        return replace(known[0], source=folder / f"the camera assumed for {layout.label}")
    named = tuple(f"{c.source} in the folder's name" for c in layout.known_cameras)
    return read_calibration(_first_there(folder, layout.cameras + named, "calibration", layout))


def _poses(
    folder: Path, declared: Declaration, pose_file: str | None, colors: list[Path], times: Times
) -> tuple[Poses, Path | None, list[Path], str]:
    """A pose a frame, the files that they were read from, by one name and all, and how chosen.

    Without a file all poses are NaN.
    """
    layout = FORMATS[declared.format]
    names = (pose_file,) if pose_file else layout.poses
    files = [folder / name for name in names if (folder / name).is_file()]
    if len(files) > 1:
        both = " and ".join(file.name for file in files)
        raise DataError(f"{folder} has {both}: keep one, or choose by `data convert --poses FILE`")
    patterns = [folder / (f"{n}/*.txt" if (folder / n).is_dir() else n) for n in names]
    patterns = [p for p in patterns if "*" in p.name and p.parent.is_dir()]
    if patterns and not files:
        path, files = patterns[0], numbered_files(patterns, (".txt",))
        check_paired(colors, files)
    elif not files and not pose_file:
        return np.full((len(colors), 4, 4), np.nan), None, [], "no poses"
    else:
        path = _first_there(folder, names, "poses", layout)
        files = [path]
    tables = [read_poses(file, declared.quaternion) for file in files]
    poses, chosen = np.concatenate([T for T, _ in tables]), ""
    if (pose_times := tables[0][1]) is not None:
        poses = _placed(poses, pose_times, times, path, layout.color[0].endswith(".txt"))
    numbers = numbers_of(colors)
    if len(poses) > len(colors) and 0 <= numbers.min() <= numbers.max() < len(poses):
        chosen = f"of {len(poses)} poses in {path.name} those of the {len(colors)} images' numbers"
        poses = poses[numbers]
    if len(poses) != len(colors):
        advice = "write 'nan' for each number of a frame without a pose, or remove its images"
        if len(poses) > len(colors):
            advice = "remove those without an image, or number the images as the poses"
        raise DataError(
            f"{path} has {len(poses)} poses but there are {len(colors)} images: every frame needs "
            f"one; {advice}"
        )
    return poses, path, files, chosen


def _check_together(positions: Float[np.ndarray, "frames 3"], path: Path | None) -> None:
    """Raises DataError for a pose that lies far from all others."""
    known = np.isfinite(positions).all(axis=1)
    if not known.any():
        return
    away = np.linalg.norm(positions - np.median(positions[known], axis=0), axis=1)
    usual = np.quantile(away[known], 0.9, method="lower")
    for i in np.flatnonzero((away > _ALONE) & (away > _ALONE * usual)):
        raise DataError(
            f"{path} frame {i} lies {away[i]:.3g} m from the others, which keep within {usual:.3g} "
            "m: correct its pose, or write nan for it"
        )


def _placed(poses: Poses, pose_times: Times, times: Times, path: Path, is_by_time: bool) -> Poses:
    """The pose of every frame, in formats by time; else as they stand, one a frame.

    nbtrack's own trajectories leave frames out, and are placed by time in any format.
    """
    if is_by_time:
        return posed_by_time(times, poses, pose_times, path)
    if len(poses) == len(times):
        return poses
    placed = posed_by_time(times, poses, pose_times, path, tolerance=1e-3)
    # Unless all poses find a frame the times are something else.
    return placed if np.isfinite(placed).sum() == np.isfinite(poses).sum() else poses
