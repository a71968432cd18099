"""What files' names say: which frame each belongs to, and when it was taken."""

import re
from pathlib import Path

import numpy as np

from nbtrack.core.arrays import Frames

# Seconds since 1970 with decimals, or as many milli-, micro- or nanoseconds, in 13 to 19 digits.
_STAMP = re.compile(
    r"(?<!\d)(?<!\d\.)([1-9]\d{8,9}\.\d+|1\d{12}(?:\d{3}){0,2})(?!\.?\d)", flags=re.ASCII
)


def stamp_in(path: Path) -> float | None:
    """The time (s) that a file is named after, as 1305031102.175304.png or in nanoseconds.

    >>> [stamp_in(Path(name)) for name in ("1305031102.5.png", "rgb_1305031102500000000.png")]
    [1305031102.5, 1305031102.5]
    >>> [stamp_in(Path(name)) for name in ("000017.png", "img17.5.png", "0000000000000017.png")]
    [None, None, None]
    """
    match = _STAMP.search(path.stem)
    return _seconds(match[0]) if match else None


def _seconds(stamp: str) -> float:
    return float(stamp) if "." in stamp else int(stamp) / 10 ** (len(stamp) - 10)


def numbers_in(path: Path) -> tuple[int, ...]:
    """The numbers in a file's name, a time as microseconds.

    >>> numbers_in(Path("cam0_1305031102.5.png"))
    (0, 1305031102500000)
    """
    # A dot ends the stem: frame-000001.color.png counts as 1. Of more digits no camera is capable.
    stem = _STAMP.sub(lambda match: str(round(1e6 * _seconds(match[0]))), path.stem)
    return tuple(int(digits[-18:]) for digits in re.findall(r"[0-9]+", stem))


def frame_keys(files: list[Path]) -> list[tuple[int, ...]]:
    """The numbers that vary in the names of a folder's files, of each; all, where none does.

    >>> frame_keys([Path("0017_cam0.png"), Path("0018_cam0.png")])
    [(17,), (18,)]
    >>> frame_keys([Path("a1_1.png"), Path("a1_2.png"), Path("a2_1.png")])
    [(1, 1), (1, 2), (2, 1)]
    >>> frame_keys([Path("0017_cam0.png")])
    [(17, 0)]
    """
    rows = [numbers_in(path) for path in files]
    if len(set(map(len, rows))) > 1:
        return rows
    varying = [i for i, column in enumerate(zip(*rows, strict=True)) if len(set(column)) > 1]
    return [tuple(row[i] for i in varying) for row in rows] if varying else rows


def frame_numbers(files: list[Path]) -> Frames | None:
    """The frames' numbers, where just one in the names varies."""
    keys = frame_keys(files)
    return np.array(keys).ravel() if set(map(len, keys)) == {1} else None
