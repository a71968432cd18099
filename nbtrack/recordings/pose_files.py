"""Poses and times from text files, and times and frame numbers from the names of files.

They are checked here in the order in which files have them. So a clock that fell back is found
before anything is sorted or matched by time.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Frames, Poses, Position
from nbtrack.machinery.errors import DataError, MissingError
from nbtrack.machinery.files import absolute
from nbtrack.machinery.inputs import RIGID, checked_poses, read_numbers

Times = Float[np.ndarray, "_"]  # s
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
# What a line of a pose file may hold, for messages.
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_LATEST = 1e11  # s: no timestamp in seconds is later; one in milliseconds since 1970 is larger
_EARLIEST = 9e8  # s: times since 1970 that are later (from July 1998 on) tell their unit
# Frames that are farther apart (s) see too little of the same to be tracked.
_SLOWEST = 5.0
_SLOWEST_SINCE_1970 = 15.0  # where the times themselves tell the unit
# A time since 1970 in a name: seconds with decimals (9 or 10 digits before the point), or milli-,
# micro- or nanoseconds (13, 16 or 19 digits).
_STAMP = re.compile(r"(?a)(?<!\d)(?<!\d\.)([1-9]\d{8,9}\.\d+|1\d{12}(?:\d{3}){0,2})(?!\.?\d)")


def in_seconds(times: Times) -> Times:
    """Convert times in seconds, or in milli-, micro- or nanoseconds, to seconds.

    The unit is the largest of these in which the median of all times is below `_LATEST`, and in
    which frames are less than `_SLOWEST` apart, or `_SLOWEST_SINCE_1970` if the median is one of a
    time since 1970. How far frames are apart counts for whole numbers only: with decimals the unit
    is likely a second. A time that is not below `_LATEST` in this unit becomes NaN.

    >>> in_seconds(np.array([1403636579763555584.0, 1403636579796888917.0])).round(2).tolist()
    [1403636579.76, 1403636579.8]
    >>> in_seconds(np.array([0.5, 0.6, 1e13])).tolist()
    [0.5, 0.6, nan]
    >>> in_seconds(np.array([0.0, 33.0, 67.0])).round(3).tolist()
    [0.0, 0.033, 0.067]
    >>> in_seconds(1e9 * np.array([5000.0, 5000.5, 5001.0])).tolist()  # since the start of a device
    [5000.0, 5000.5, 5001.0]
    >>> in_seconds(np.array([1.4e9, 1.4e9 + 10])).tolist()  # a picture every ten seconds
    [1400000000.0, 1400000010.0]
    """
    known = times[np.isfinite(times)]
    median = np.median(np.abs(known)) if len(known) else 0.0
    step = 0.0  # fits every unit
    if len(known) > 1 and (known % 1 == 0).all():
        step = np.quantile(np.abs(np.diff(known)), 0.5, method="lower")
    units_s = np.array([1.0, 1e-3, 1e-6, 1e-9])
    slowest = np.where(median * units_s > _EARLIEST, _SLOWEST_SINCE_1970, _SLOWEST)
    # `argmax` finds the first unit that fits. If none fits, it is 0: the unit is a second.
    unit_s = units_s[((median * units_s < _LATEST) & (step * units_s < slowest)).argmax()]
    return np.where(np.abs(times * unit_s) < _LATEST, times * unit_s, np.nan)


def stamp_in(path: Path) -> float | None:
    """The time (s since 1970) in a file's name, as 1305031102.175304.png; None if there is none.

    Milli-, micro- and nanoseconds are read, too.

    >>> [stamp_in(Path(name)) for name in ("1305031102.5.png", "rgb_1305031102500000000.png")]
    [1305031102.5, 1305031102.5]
    >>> [stamp_in(Path(name)) for name in ("000017.png", "img17.5.png", "0000000000000017.png")]
    [None, None, None]
    """
    match = _STAMP.search(path.stem)
    return _seconds(match[0]) if match else None


def _seconds(stamp: str) -> float:
    """The time (s) of a text that matches `_STAMP`; an integer's first ten digits are seconds."""
    return float(stamp) if "." in stamp else int(stamp) / 10 ** (len(stamp) - 10)


def _numbers_in(path: Path) -> tuple[int, ...]:
    """The numbers in a file's name; a time in it gives one number, in microseconds.

    >>> _numbers_in(Path("cam0_1305031102.5.png"))
    (0, 1305031102500000)
    """
    stem = _STAMP.sub(lambda match: str(round(1e6 * _seconds(match[0]))), path.stem)
    # Of longer numbers the last 18 digits, which fit into 64 bits.
    return tuple(int(digits[-18:]) for digits in re.findall(r"[0-9]+", stem))


def frame_keys(files: list[Path]) -> list[tuple[int, ...]]:
    """For each file, the numbers in its name that vary from file to file.

    If no number varies, or if names hold different counts of numbers, these are all numbers.

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
    """Raises DataError if times (s; NaN: none), in the order of their source, fall or repeat.

    Sorting them instead would mix up the frames of a recording whose clock fell back.
    """
    rows = np.flatnonzero(np.isfinite(times))
    steps = np.diff(times[rows])
    if (steps <= 0).any():
        i = (steps <= 0).argmax()
        before, here = times[rows[i : i + 2]]
        found = f"{source}, row {rows[i + 1] + 1}: {here:.6f} s comes after {before:.6f} s"
        why = "the clock fell back, or it has two rows of one time, or times of too few digits"
        raise DataError(f"{found}, so {why}: write rising times, or cut it there")


def check_order(files: list[Path]) -> None:
    """Raises DataError if the names leave open in which order the frames were recorded.

    `files` are sorted by the numbers in their names.
    """
    names = f"{files[0].parent}/{files[0].name}, {files[-1].name} and the others"
    # The names without their numbers must be equal: sorted words, as Feb and Jan, need not be in
    # the order of frames.
    words = {re.sub("[0-9]+", "0", path.stem.lower()) for path in files}
    # Either all names or none must hold a time since 1970.
    stamps = [stamp_in(path) for path in files]
    are_times = None not in stamps
    some_are_times = any(stamps) and not are_times
    # Decimals must be equally many, unless all names are times: 1.5 may be 1.50, which comes after
    # 1.25, or chapter 1.5, which comes before chapter 1.25.
    decimals = {tuple(map(len, re.findall(r"\d\.(\d+)", path.stem))) for path in files}
    decimals_differ = len(decimals) > 1 and not are_times
    if len(words) > 1 or some_are_times or decimals_differ:
        found = f"{names} differ in more than their numbers, or in how these are written"
        raise DataError(f"{found}, which tells no order: number the images as they were recorded")
    if len(files) > 1:
        # All names have the same form here, so that there is a column for each number in a name.
        for numbers in np.array([_numbers_in(path) for path in files]).T:
            _check_counter(numbers, names)


def _check_counter(numbers: Frames, names: str) -> None:
    """Raises DataError if one of the numbers in the names may have counted in another order.

    `numbers` has an entry for each of several files, in their order; `names` describes the files.
    """
    steps, last = np.diff(numbers), numbers[-1]
    is_counter = len(set(numbers.tolist())) == len(numbers) and np.ptp(numbers) < 2 * len(numbers)
    if is_counter and (steps < 0).any():
        raise DataError(f"{names} have numbers that order them in two ways: keep one of both")
    # Hours, minutes or days repeat, and rise by 1 at a time.
    usual = max(1, np.median(steps))
    # If a counter went back to 0 at `end`, its sorted numbers have a wide gap, and from the last
    # number over `end` to the first one it is about a usual step. A gap of less than half of `end`
    # is more likely of images that were taken out (our choice).
    for end in (10 ** len(str(last)), 12, 24, 31, 60, 2**8, 2**16, 2**32):
        step_over_end = numbers[0] + end - last
        if 0 < step_over_end <= 2 * usual and steps.max() > max(10 * usual, end / 2):
            i = steps.argmax()
            found = f"{names} have the numbers {numbers[0]} to {numbers[i]} and "
            found += f"{numbers[i + 1]} to {last}: a counter that went back to 0 at {end}?"
            raise DataError(f"{found} Then add {end} to the first; else leave {last} out")


def read_poses(path: Path, quaternion: str = "xyzw") -> tuple[Poses, Times]:
    """Read the poses (m) and their timestamps (s) from a text file.

    A line holds `timestamp tx ty tz` and a quaternion in the order `quaternion`, a 4x4 or 3x4
    matrix, or a row of a matrix. Poses are returned as they stand in the file, in its direction and
    axes. A pose is NaN if one of its numbers is; timestamps are NaN if the file has matrices.
    Raises DataError for other lines, and for poses that are no rigid transforms.
    """
    numbers = read_numbers(path, (4, 8, 12, 16), _POSE_LINE)
    if numbers.shape[1] == 8:
        return from_quaternions(numbers, quaternion, path)
    if numbers.shape == (3, 4):  # the rows of a single 3x4 matrix
        numbers = numbers.reshape(1, 12)
    if numbers.shape[1] == 12:
        numbers = np.hstack([numbers, np.tile([0.0, 0, 0, 1], (len(numbers), 1))])
    if numbers.size % 16:
        raise DataError(f"{path} has {len(numbers)} rows: it needs the four of each 4x4 matrix")
    poses = checked_poses(numbers.reshape(-1, 4, 4), path)
    return poses, np.full(len(poses), np.nan)


def from_quaternions(rows: Float[np.ndarray, "n 8"], order: str, path: Path) -> tuple[Poses, Times]:
    """Poses (m) and times (s) of rows with a timestamp, a position and a quaternion.

    `order` names the quaternion's four columns, as "xyzw". A pose is NaN if a number of its row is
    not finite or its quaternion is zero: so tools write a frame in which tracking was lost. Raises
    DataError, which names `path`, if the time of any other pose is not finite, or if its quaternion
    has no unit norm.
    """
    times = in_seconds(rows[:, 0])
    # Clipped numbers are still so large that they are refused below, and overflow nothing.
    q_xyzw = rows[:, [4 + order.index(axis) for axis in "xyzw"]].clip(-1e6, 1e6)
    is_known = np.isfinite(rows[:, 1:]).all(axis=1) & (q_xyzw != 0).any(axis=1)
    q_xyzw[~is_known] = 0.5  # any unit quaternion; these poses become NaN
    norms = np.linalg.norm(q_xyzw, axis=1)
    is_wrong = (np.abs(norms - 1) > RIGID) | (is_known & np.isnan(times))
    if is_wrong.any():
        i = is_wrong.argmax()  # the first wrong row
        raise DataError(
            f"{path} pose {i} has the time {rows[i, 0]:.13g} and a quaternion of norm "
            f"{norms[i]:.3g}: columns must be finite timestamps (s), tx ty tz and a unit "
            f"quaternion ({' '.join('q' + axis for axis in order)})"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(q_xyzw).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    poses[~is_known] = np.nan
    return checked_poses(poses, path), times


def shifted(T_world_camera: Poses, by: Position) -> Poses:
    """Poses (m) whose positions are moved by an offset (m), as in a world with another origin.

    The given poses stay as they are.
    """
    T_world_camera = T_world_camera.copy()
    T_world_camera[:, :3, 3] += by
    return T_world_camera


def tum_text(times: Float[np.ndarray, "n"], T_world_camera: Poses) -> str:
    """The text of a TUM file from times (s) and camera-to-world poses (m, OpenCV camera axes).

    It has a line for each frame whose pose is not NaN, with qw >= 0. Numbers have the digits that
    restore the same double. Source: TUM RGB-D benchmark.
    """
    known = np.isfinite(T_world_camera).all(axis=(1, 2))
    times, T_world_camera = np.asarray(times)[known], T_world_camera[known]
    q_xyzw = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([times, T_world_camera[:, :3, 3], q_xyzw])
    return f"# {_COLUMNS}\n{number_lines(rows)}"


def number_lines(rows: Float[np.ndarray, "n numbers"]) -> str:
    """Rows of numbers as text, with the digits that restore the same double."""
    # Adding zero turns -0.0 into 0.0.
    return "".join(" ".join(map(repr, row)) + "\n" for row in (rows + 0.0).tolist())


def read_tum(path: Path) -> tuple[Float[np.ndarray, "n"], Poses]:
    """Read a TUM file: timestamps (s) and camera-to-world poses (m). Lines with `#` are skipped.

    Raises MissingError if the file is not there, and DataError if any line holds something else or
    a number that is not finite.
    """
    path = absolute(path)
    if not path.is_file():
        raise MissingError(f"no file {path}: give a trajectory in TUM format, as `track` writes it")
    T_world_camera, times = read_poses(path)
    if not (np.isfinite(times).all() and np.isfinite(T_world_camera).all()):
        raise DataError(f"{path}: not a finite pose in every line, `{_COLUMNS}`; write it anew")
    return times, T_world_camera
