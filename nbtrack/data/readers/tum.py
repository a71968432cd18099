"""The TUM RGB-D benchmark (Sturm et al. 2012), and recordings in its layout.

    rgb.txt, depth.txt    `timestamp file` a line, timestamps in seconds
    groundtruth.txt       `timestamp tx ty tz qx qy qz qw`: camera-to-world, OpenCV camera axes
    rgb/, depth/          8-bit colour; 16-bit depth, 5000 a metre, registered to the colour

The three streams have times of their own and are associated by them. Source: the benchmark's page
on file formats, and its script associate.py for the tolerance of 0.02 s.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import Calibration, read_calibration
from nbtrack.data.readers.declaration import Declaration
from nbtrack.data.readers.pose_files import from_quaternions
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file, read_lines, read_numbers

_TOLERANCE = 0.02  # s
_NEEDED = "the TUM layout"
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
CALIBRATION_FILES = ("intrinsics.json", "intrinsics.txt", "calibration.txt")
_SIZE = (640, 480)
# fx fy cx cy and distortion k1 k2 p1 p2 k3 of the three cameras: the benchmark's own calibration.
# Its depth maps carry their scale correction already.
_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    lists = [folder / "rgb.txt", folder / "depth.txt"]
    (color_times, color_files), (depth_times, depth_files) = map(_read_list, lists)
    pose_file = folder / (request.pose_file or "groundtruth.txt")
    meaning = f"'{_COLUMNS}'"
    numbers = read_numbers(pose_file, (8,), meaning, _NEEDED)
    if not np.isfinite(numbers[:, 0]).all():
        row = int(np.flatnonzero(~np.isfinite(numbers[:, 0]))[0])
        raise DataError(f"{pose_file} pose {row} has no finite timestamp: write {meaning}")
    poses = from_quaternions(numbers[:, 1:], declared.quaternion, pose_file)
    colors, depths = _pairs(color_times, depth_times)
    if len(colors) == 0:
        raise DataError(
            f"{lists[0]} ({_span(color_times)}) and {lists[1]} ({_span(depth_times)}) have no "
            f"times within {_TOLERANCE} s of each other: both need timestamps of one clock"
        )
    times = color_times[colors]
    nearest = _nearest(times, numbers[:, 0])
    has_pose = np.abs(numbers[nearest, 0] - times) <= _TOLERANCE
    if not has_pose.any():
        raise DataError(
            f"{pose_file} ({_span(numbers[:, 0])}) has no pose within {_TOLERANCE} s of an image "
            f"({_span(times)}): it needs timestamps of the same clock"
        )
    file_poses = np.where(has_pose[:, None, None], poses[nearest], np.nan)
    calibration = _calibration(folder)
    texts = [*lists, pose_file, *([calibration.source] if is_file(calibration.source) else [])]
    return Recording(
        folder, [color_files[i] for i in colors], [depth_files[i] for i in depths], file_poses,
        pose_file, calibration, declared, texts, times,
    )  # fmt: skip


def _read_list(path: Path) -> tuple[Float[np.ndarray, "files"], list[Path]]:
    """Times (s) and files of a list, in the order of time."""
    times, files = [], []
    for number, line in read_lines(path, _NEEDED):
        words = line.split(maxsplit=1)
        try:
            time = float(words[0])
        except ValueError:
            time = float("nan")
        if len(words) != 2 or not np.isfinite(time):
            raise DataError(
                f"{path} line {number} is {line[:60]!r}: every line holds 'timestamp file', as in "
                "'1305031102.175 rgb/1305031102.175.png'"
            )
        file = path.parent / words[1].strip()
        if not is_file(file):
            raise MissingError(
                f"no file {str(file)[:200]!r}, named in {path} line {number}: add it or remove the "
                "line"
            )
        times.append(time)
        files.append(file)
    if not times:
        raise DataError(f"{path} is empty: every line holds 'timestamp file'; write it anew")
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [files[i] for i in order]


def _nearest(times: Float[np.ndarray, "n"], others: Float[np.ndarray, "m"]) -> Int[np.ndarray, "n"]:
    """For every time the index of the nearest other one (m > 0)."""
    order = np.argsort(others, kind="stable")
    ranks = np.searchsorted(others[order], times)
    before, after = order[(ranks - 1).clip(0)], order[ranks.clip(max=len(others) - 1)]
    return np.where(np.abs(others[before] - times) <= np.abs(others[after] - times), before, after)


def _pairs(
    color_times: Float[np.ndarray, "n"], depth_times: Float[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Indices of images and depth maps that are each other's nearest, within the tolerance."""
    depths = _nearest(color_times, depth_times)
    mutual = _nearest(depth_times, color_times)[depths] == np.arange(len(color_times))
    kept = mutual & (np.abs(depth_times[depths] - color_times) <= _TOLERANCE)
    return np.flatnonzero(kept), depths[kept]


def _calibration(folder: Path) -> Calibration:
    """The folder's own calibration file, or that of the benchmark's camera in its name."""
    for name in CALIBRATION_FILES:
        if is_file(folder / name):
            return read_calibration(folder / name, _NEEDED)
    match = re.search(r"freiburg([123])", folder.resolve().name)
    if match is None:
        raise MissingError(
            f"no calibration for {folder}: add {' or '.join(CALIBRATION_FILES)} (fx fy cx cy), or "
            "name the folder after the benchmark's camera, freiburg1, freiburg2 or freiburg3"
        )
    (fx, fy, cx, cy), distortion = _CAMERAS[match[1]]
    middle = (cx + 0.5, cy + 0.5)
    return Calibration(folder / match[0], fx, fy, middle, _SIZE, distortion)


def _span(times: Float[np.ndarray, "n"]) -> str:
    return f"{times.min():.3f} to {times.max():.3f} s"


register(Format(
    "tum", "TUM RGB-D", ("rgb.txt", "depth.txt", "groundtruth.txt"), _open,
    Declaration(depth_scale=5000.0),
))  # fmt: skip
