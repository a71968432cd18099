"""What the names of files, and the times in lists, tell: numbers, moments, an order.

Both are looked at in the order of recording before anything is sorted or matched by them.
"""

import re
from pathlib import Path

import numpy as np

from nbtrack.machinery.errors import DataError
from nbtrack.recordings.pose_files import Times

# Seconds since 1970 with decimals, or as many milli-, micro- or nanoseconds, in 13 to 19 digits.
_STAMP = re.compile(r"(?a)(?<!\d)(?<!\d\.)([1-9]\d{8,9}\.\d+|1\d{12}(?:\d{3}){0,2})(?!\.?\d)")
_LEAP = 10  # usual steps: a gap in numbers that is no loss of some frames


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
    """The time (s) of a stamp: decimals, or an integer whose first ten digits are seconds."""
    return float(stamp) if "." in stamp else int(stamp) / 10 ** (len(stamp) - 10)


def _numbers_in(path: Path) -> tuple[int, ...]:
    """The numbers in a file's name, a time as microseconds.

    >>> _numbers_in(Path("cam0_1305031102.5.png"))
    (0, 1305031102500000)
    """
    stem = _STAMP.sub(lambda match: str(round(1e6 * _seconds(match[0]))), path.stem)
    # Numbers of 18 digits fit into 64 bits.
    return tuple(int(digits[-18:]) for digits in re.findall(r"[0-9]+", stem))


def frame_keys(files: list[Path]) -> list[tuple[int, ...]]:
    """Of each file the numbers in its name that vary over the files; all numbers, where none does,
    or where names have different counts of them.

    >>> frame_keys([Path("0017_cam0.png"), Path("0018_cam0.png")])
    [(17,), (18,)]
    >>> frame_keys([Path("a1_1.png"), Path("a1_2.png"), Path("a2_1.png")])
    [(1, 1), (1, 2), (2, 1)]
    >>> frame_keys([Path("0017_cam0.png")])
    [(17, 0)]
    """
    rows = [_numbers_in(path) for path in files]
    if len(set(map(len, rows))) > 1:
        return rows
    varying = [i for i, column in enumerate(zip(*rows, strict=True)) if len(set(column)) > 1]
    return [tuple(row[i] for i in varying) for row in rows] if varying else rows


def check_rising(times: Times, source: Path) -> None:
    """Raises DataError where times (s; NaN: none), in the order of their source, fall or repeat.

    Whoever sorted them would shuffle a recording whose clock fell back.
    """
    rows = np.flatnonzero(np.isfinite(times))
    steps = np.diff(times[rows])
    if (steps <= 0).any():
        i = (steps <= 0).argmax()
        before, here = times[rows[i : i + 2]]
        found = f"{source}, row {rows[i + 1] + 1}: {here:.6f} s comes after {before:.6f} s"
        advice = "write rising times, or cut it there; sort it only if its order means nothing"
        why = "the clock fell back, or it has two rows of one time, or times of too few digits"
        raise DataError(f"{found}, so {why}: {advice}")


def check_order(files: list[Path]) -> None:
    """Raises DataError where the order of names, by their numbers, may not be that of frames."""
    names = f"{files[0].parent}/{files[0].name}, {files[-1].name} and the others"
    # Words tell no order: Jan, Feb; neither do 1.5 and 1.25, which may be 1.50 or chapters.
    kinds = {re.sub("[0-9]+", "0", path.stem.lower()) for path in files}
    stamps = [stamp_in(path) for path in files]
    decimals = {tuple(map(len, re.findall(r"\d\.(\d+)", path.stem))) for path in files}
    if len(kinds) > 1 or (None in stamps and (any(stamps) or len(decimals) > 1)):
        found = f"{names} differ in more than their numbers, or in how these are written"
        raise DataError(f"{found}, which tells no order: number the images as they were recorded")
    for numbers in np.array([_numbers_in(path) for path in files]).T:
        steps = np.diff(numbers)
        is_counter = len(set(numbers.tolist())) == len(files) and np.ptp(numbers) < 2 * len(files)
        if is_counter and (steps < 0).any():
            raise DataError(f"{names} have numbers that order them in two ways: keep one of both")
        usual, last = np.median(steps) if len(steps) else 0, numbers[-1]
        for end in (10 ** len(str(last)), 2**8, 2**16, 2**32):
            if 0 < numbers[0] + end - last <= 2 * usual and steps.max() > _LEAP * usual:
                i = steps.argmax()
                found = f"{names} have the numbers {numbers[0]} to {numbers[i]} and "
                found += f"{numbers[i + 1]} to {last}: a counter that went back to 0 at {end}?"
                raise DataError(f"{found} Then add {end} to the first; else leave {last} out")
