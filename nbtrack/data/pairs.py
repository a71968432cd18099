"""Images, depth maps and poses that belong together: by numbers in names, or by times in lists."""

import os
import re
from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.text_files import Times, read_rows

_IMAGES = (".png", ".jpg", ".jpeg")
_TOLERANCE = 0.02  # s between what belongs together: that of the TUM benchmark's associate.py


def numbered_files(patterns: list[Path], suffixes: tuple[str, ...] = _IMAGES) -> list[Path]:
    """Files of the first pattern with a folder, `img2` before `img10`; or raises MissingError."""
    pattern = next((p for p in patterns if p.parent.is_dir()), patterns[0])
    paths = [path for path in pattern.parent.glob(pattern.name) if path.is_file()]
    paths = [path for path in paths if not path.name.startswith(".")]  # of the system
    files = [path for path in paths if path.suffix.lower() in suffixes]
    if not files:
        unread = ", ".join(sorted({path.suffix for path in paths}))
        advice = f"convert {unread}, which is not read" if paths else "add some"
        places = " or ".join(map(str, patterns))
        raise MissingError(
            f"no file {places} ({', '.join(suffixes)}): {advice}, with the frame's number in the "
            "name, depth as PNG of 16 bits"
        )
    # The name decides between img1 and img01.
    return sorted(files, key=lambda path: (_numbers(path), path.name))


def numbers_of(files: list[Path]) -> Int[np.ndarray, "_"]:
    """Frame numbers: the last in each file's name; -1 if it has none."""
    return np.array([[-1, *_numbers(path)][-1] for path in files])


def _numbers(path: Path) -> list[int]:
    # A dot ends the stem: frame-000001.color.png counts as 1. Of more digits no camera is capable.
    return [int(digits[-18:]) for digits in re.findall(r"[0-9]+", path.stem)]


def check_paired(colors: list[Path], others: list[Path]) -> None:
    """Raises DataError unless every image has its depth map or pose, with the same frame number."""
    numbers, other_numbers = numbers_of(colors), numbers_of(others)
    if not np.array_equal(numbers, other_numbers):
        count = Counter([*numbers, *other_numbers])
        odd = [path.name for path in (*colors, *others) if count[numbers_of([path])[0]] != 2]
        more = " ..." if len(odd) > 4 else ""
        raise DataError(
            f"{colors[0].parent} has {len(colors)} images but {others[0].parent.name}/ has "
            f"{len(others)} {others[0].suffix} files, with other frame numbers in the names "
            f"({len(odd)} without a partner: {', '.join(odd[:4])}{more}): every "
            "image needs one; rename or remove the odd files"
        )


def listed_pairs(color_list: Path, depth_list: Path) -> tuple[list[Path], list[Path], Times, str]:
    """Images and depth maps of two lists that are each other's nearest in time, the times, and a
    word on images that are left out."""
    (color_times, colors), (depth_times, depths) = map(_read_list, (color_list, depth_list))
    closest = _nearest(color_times, depth_times)
    kept = _nearest(depth_times, color_times)[closest] == np.arange(len(colors))
    kept &= np.abs(depth_times[closest] - color_times) <= _TOLERANCE
    if not kept.any():
        raise DataError(
            f"{color_list} ({_span(color_times)}) and {depth_list} ({_span(depth_times)}) have no "
            f"times within {_TOLERANCE} s of each other: both need timestamps of one clock"
        )
    left_out = f"{(~kept).sum()} of the {len(kept)} images in {color_list.name} are left out: no "
    left_out += f"depth map of {depth_list.name} is within {_TOLERANCE} s"
    colors = [colors[i] for i in np.flatnonzero(kept)]
    depths = [depths[i] for i in closest[kept]]
    return colors, depths, color_times[kept], "" if kept.all() else left_out


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


def _nearest(times: Times, others: Times) -> Int[np.ndarray, "_"]:
    """For every time the index of the nearest other one (m > 0)."""
    return cKDTree(others[:, None]).query(times[:, None], p=1)[1]


def posed_by_time(
    times: Times, poses: Poses, pose_times: Times, path: Path, tolerance: float = _TOLERANCE
) -> Poses:
    """The pose nearest to every frame in time; NaN where none is within the tolerance (s)."""
    closest = _nearest(times, np.nan_to_num(pose_times))
    has_pose = np.abs(pose_times[closest] - times) <= tolerance
    if not (has_pose.any() and np.isfinite(pose_times).all()):
        raise DataError(
            f"{path} ({_span(pose_times)}) has no pose within {tolerance:g} s of an image "
            f"({_span(times)}): it needs finite timestamps of the same clock, one a frame"
        )
    return np.where(has_pose[:, None, None], poses[closest], np.nan)


def _span(times: Times) -> str:
    return f"{times.min():.13g} to {times.max():.13g} s"
