"""Which image, depth map and pose belong together: by the numbers in file names, or by time.

A file's name tells the number of its frame or the time when it was taken. A list, a text file with
a line for each image or pose, tells times.
"""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import interp1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Frames, Poses
from nbtrack.machinery.errors import DataError, MissingError
from nbtrack.machinery.files import naming_damaged
from nbtrack.machinery.inputs import read_lines
from nbtrack.recordings.pose_files import Times, check_order, check_rising, frame_keys, in_seconds

TIMES_FILE = "timestamps.txt"  # a time (s) in each line, for a folder of numbered images (ours)
_TOLERANCE = 0.02  # s at most between images and poses of a frame, as in TUM's associate.py
# Poses are interpolated over at most so many seconds (20 Hz, and 1 % more). A hand that accelerates
# by 2 m/s² is then off by 0.6 mm.
_GAP = 0.0505


def check_paired(colors: list[Path], others: list[Path]) -> None:
    """Check the files of images and of their depth maps or poses, which are sorted by number.

    Raises DataError unless every image has one other file of the same number, and if the numbers
    may not give the order in which the frames were recorded.
    """
    color_keys, other_keys = frame_keys(colors), frame_keys(others)
    if color_keys != other_keys or len(set(color_keys)) < len(color_keys):
        keys = color_keys + other_keys
        count = Counter(keys)  # a key that each list has once occurs twice
        odd = [p.name for p, key in zip(colors + others, keys, strict=True) if count[key] != 2]
        raise DataError(
            f"{colors[0].parent} has {len(colors)} images but {others[0].parent.name}/ has "
            f"{len(others)} {others[0].suffix} files: every image needs one of its number, and a "
            f"folder one session; rename the {len(odd)} that have none, or two, so that equal "
            f"numbers belong together, or remove them: {', '.join(odd[:4])}"
        )
    check_order(colors)


def nearest(times: Times, others: Times, tolerance: float) -> Frames:
    """For each of the times (s) the index of the nearest of the others.

    The index is -1 if that one is farther away than the tolerance (s), or if there are no others.
    """
    # In one dimension p=1 is the absolute difference, without the rounding of a square and a root.
    distances, closest = cKDTree(others[:, None]).query(times[:, None], p=1)
    return np.where(distances <= tolerance, closest, -1)


def _in_unit_of(times: Times, stamps: Times) -> Times:
    """Stamps (s), converted to the unit in which many of them are near times (s) of the same clock.

    `in_seconds` reads each list by itself, and so may take a fast or sparse count for one of
    another unit. A unit fits if more of the times than one, and than half the length of the shorter
    list, have a stamp near them. If no unit fits, the stamps are returned as they are.
    """
    for scale in (1.0, 1e-3, 1e-6, 1e-9, 1e3, 1e6, 1e9):  # 1 first: most units are right
        n_near = (nearest(times, scale * stamps, _TOLERANCE) >= 0).sum()
        if n_near > max(1, min(len(times), len(stamps)) / 2):
            return scale * stamps
    return stamps


def pair_lists(color_list: Path, depth_list: Path) -> tuple[list[Path], list[Path], Times, str]:
    """Pair the images of one list with the depth maps of another by their times.

    An image and a depth map are a pair if each is the nearest of the other, within `_TOLERANCE`.
    Returns the paired images, their depth maps, the images' times (s), and a note that says how
    many images are left out; it is empty if none is. Raises DataError if all are left out.
    """
    color_times, colors = _read_list(color_list)
    depth_times, depths = _read_list(depth_list)
    depth_times = _in_unit_of(color_times, depth_times)
    depth_of_color = nearest(color_times, depth_times, _TOLERANCE)
    color_of_depth = nearest(depth_times, color_times, _TOLERANCE)
    # An image without a depth map has the index -1, which is the last depth map's in this line. The
    # next line leaves such images out.
    is_mutual = color_of_depth[depth_of_color] == np.arange(len(colors))
    paired = np.flatnonzero((depth_of_color >= 0) & is_mutual)  # indices of images
    of_all = f"{len(colors) - len(paired)} of the {len(colors)} images in {color_list.name}"
    why = f"no depth map of {depth_list.name} has them nearest within {_TOLERANCE} s"
    left_out = f"{of_all} are left out: {why}"
    if not len(paired):
        raise DataError(f"{color_list.parent}: {left_out}; both lists need the same clock")
    note = left_out if len(paired) < len(colors) else ""
    paired_depths = [depths[i] for i in depth_of_color[paired]]
    return [colors[i] for i in paired], paired_depths, color_times[paired], note


def _read_list(path: Path) -> tuple[Times, list[Path]]:
    """Read a list with `timestamp file` in each line; returns the times (s) and the files.

    Raises DataError for other lines and for times that do not rise, and MissingError if a file is
    not there.
    """
    # A list that was written on Windows may separate folders by a backslash.
    words = [line.replace("\\", "/").strip().split(maxsplit=1) for line in read_lines(path)]
    advice = "every line holds 'timestamp file', such as '1305031102.175 rgb/1305031102.175.png'"
    with naming_damaged(path, "list", advice):
        times = in_seconds(np.array([float(time) for time, _ in words]))
        if not np.isfinite(times).all():
            raise ValueError("a time is not finite")
    check_rising(times, path)
    files = [path.parent / name for _, name in words]
    for file in files:
        if not os.path.isfile(file):  # pathlib's raises an error for names that no file can have
            found = f"{path} names {str(file)[:200]!r}, which is not there"
            raise MissingError(f"{found}: add it, or take it out")
    return times, files


@dataclass(frozen=True, eq=False)
class Moments:
    """The times and numbers of a recording's frames, and the poses that belong to them."""

    images: list[Path]  # one for each frame, in order
    # Times (s) from a list, from a file of times, or from the names of the images; None without.
    recorded_times: Times | None
    rate_hz: float  # frames a second: two frames whose numbers differ by 1 are 1/rate apart
    counts_from_0: bool  # the format's: a frame's number is the place of its pose in a list

    @cached_property
    def numbers(self) -> Frames | None:
        """The frames' numbers, from the names of their images.

        None unless `frame_keys` has one number for each image: else it is not clear which is meant.
        """
        keys = frame_keys(self.images)
        return np.array(keys).ravel() if set(map(len, keys)) == {1} else None

    @cached_property
    def times(self) -> Times:
        """Times (s) of the frames: the recorded ones, or without them number / rate from 0 on."""
        if self.recorded_times is not None:
            return self.recorded_times
        numbers = np.arange(len(self.images)) if self.numbers is None else self.numbers
        return (numbers - numbers[0]) / self.rate_hz

    def poses_of(
        self, path: Path, poses: Poses, stamps: Times, flip: Callable[[Poses], Poses]
    ) -> tuple[Poses, str]:
        """Find the pose of each frame in a list of poses; returns them and a note for the user.

        `stamps` are the times (s) of the list's poses, NaN without. A frame that has no pose gets
        NaN. The first of these rules that applies gives poses to frames:
        1. Each stamp is exactly the time of a frame, as in lists that nbtrack wrote.
        2. Frames have recorded times, and some stamp is near one of them. Then stamps and times are
           of the same clock, and poses are interpolated.
        3. Frames and poses have the same numbers, or are equally many: see `_by_number`. If frames
           have recorded times and no stamp is near one, this rule applies only to stamps at even
           steps, which may just count the lines. Other stamps are of another clock than the times,
           and equal counts prove nothing.

        `flip` converts the list's poses to camera-to-world ones, and back, for rule 2. `path` names
        the list in messages. Raises DataError if no rule applies.
        """
        has_both = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(stamps)
        known_poses, known_stamps = poses[has_both], stamps[has_both]
        if self.recorded_times is not None:
            known_stamps = _in_unit_of(self.recorded_times, known_stamps)
        same_time = nearest(self.times, known_stamps, tolerance=0.0)
        if len(known_stamps) > 0 and (same_time >= 0).sum() == len(known_stamps):  # rule 1
            return _at(known_poses, same_time), ""
        is_near = nearest(self.times, known_stamps, _TOLERANCE) >= 0
        if self.recorded_times is not None and is_near.any():  # rule 2
            return _interpolated(self.times, known_poses, known_stamps, flip)
        if self.recorded_times is None or _are_even(known_stamps):  # rule 3
            all_stamped = has_both.any() and np.isfinite(stamps).all()
            if found := self._by_number(poses, stamps if all_stamped else None):
                return found
        raise DataError(
            f"{path} has {len(poses)} poses but there are {len(self.images)} images; nothing tells "
            f"whose each is: write one an image ('nan': none), or {TIMES_FILE}, on the poses' clock"
        )

    def _by_number(self, poses: Poses, stamps: Times | None) -> tuple[Poses, str] | None:
        """The pose of each frame by the frames' numbers, and a note; None if neither rule applies.

        Rule 1: equal numbers are paired. The number of a pose is its stamp (s) times the rate, or
        its place in the list if it has no stamp. The numbers of the frames may be counted in
        several ways, see `_counted`; exactly one way must pair all frames or all poses. Without
        stamps there must also be more poses than frames.

        Rule 2: equally many poses and frames are paired in order. This rule does not apply if the
        stamps are times at which more than three quarters of the frames have a pose: such a list
        lacks the poses of some frames, and has poses of no frame.
        """
        n_frames, n_poses = len(self.images), len(poses)
        has_more_poses = n_poses > n_frames
        # Rule 1.
        pose_numbers = np.arange(n_poses) if stamps is None else stamps * self.rate_hz
        tolerance = min(1e-3 * self.rate_hz, 0.25)  # 1 ms, in numbers, which are 1 apart
        # A row for each way to count: the place of each frame's pose in the list, -1 without one.
        ways = [nearest(numbers, pose_numbers, tolerance) for numbers in self._counted()]
        places = np.unique(np.reshape(ways, (-1, n_frames)), axis=0)  # equal rows are one way
        n_paired = (places >= 0).sum(axis=1)
        complete = places[n_paired == min(n_frames, n_poses)]
        if len(complete) == 1 and (has_more_poses or stamps is not None):
            note = f"of {n_poses} poses those of the images' numbers" if has_more_poses else ""
            return _at(poses, complete[0]), note
        # Rule 2. Stamps at even steps are not taken for times: they may just count the poses.
        are_times = stamps is not None and not _are_even(stamps)
        lacks_some = are_times and (n_paired > 0.75 * n_frames).any()
        if n_poses != n_frames or lacks_some:
            return None
        counts_up = np.array_equal(self.numbers, np.arange(n_frames))
        return poses, "" if counts_up else "images have the poses one after another"

    def _counted(self) -> list[Frames]:
        """The places in a list of poses that the frames' numbers may mean; an array for each way.

        The list's first pose may have the number 0, the number 1 (unless there is a frame 0), or
        the number of the first frame. In a format that counts from 0 it has the number 0, unless
        the frames' numbers are 1 to n.
        """
        if self.numbers is None:
            return []
        first = self.numbers[0]
        is_1_to_n = first == 1 and np.ptp(self.numbers) == len(self.numbers) - 1
        # With a frame 0, the minimum is 0, which repeats the first way.
        first_of_list = [0] if self.counts_from_0 and not is_1_to_n else [0, min(first, 1), first]
        return [self.numbers - number for number in first_of_list]


def _interpolated(
    times: Times, poses: Poses, stamps: Times, flip: Callable[[Poses], Poses]
) -> tuple[Poses, str]:
    """The pose at each time (s), from poses at stamps (s), and a note on how many are interpolated.

    A pose is interpolated between two stamps that are at most `_GAP` apart. At other times it is
    that of the nearest stamp, or NaN if no stamp is within `_TOLERANCE`. An interpolated camera
    moves along a straight line in the world and turns at a constant rate. This holds only for
    camera-to-world poses, so `flip` converts the list's poses to these, and back.
    """
    found = _at(poses, nearest(times, stamps, _TOLERANCE))
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)  # index of the stamp after
    # s from each time back to the stamp before it, and on to the stamp after it.
    before, after = times - stamps[later - 1], stamps[later] - times
    to_nearest = np.minimum(before, after)  # s; negative for times outside of the list
    # A stamp within 1e-6 s is the time itself, rounded: its pose is taken as it is.
    is_between = (before + after <= _GAP) & (to_nearest > 1e-6)
    if not is_between.any():
        return found, ""
    T_knots = flip(poses)  # camera-to-world poses at the stamps
    wanted = times[is_between]  # s
    T_wanted = np.tile(np.eye(4), (len(wanted), 1, 1))
    T_wanted[:, :3, 3] = interp1d(stamps, T_knots[:, :3, 3], axis=0)(wanted)
    turning = Slerp(stamps, Rotation.from_matrix(T_knots[:, :3, :3]))
    T_wanted[:, :3, :3] = turning(wanted).as_matrix()
    found[is_between] = flip(T_wanted)
    note = f"{len(wanted)} of {len(found)} poses are interpolated, the nearest up to"
    return found, f"{note} {1e3 * to_nearest[is_between].max():.1f} ms away"


def _are_even(stamps: Times) -> bool:
    """Whether the steps between stamps (s) differ by no more than a tenth of the median step."""
    steps = np.diff(stamps)
    return len(steps) == 0 or np.ptp(steps) <= 0.1 * np.median(np.abs(steps))


def _at(poses: Poses, places: Frames) -> Poses:
    """The poses at some places of a list; NaN for the place -1."""
    return np.where(places[:, None, None] >= 0, poses[places], np.nan)
