"""Which image, depth map and pose belong together: by numbers in their names, or by time.

The name of a file says which frame it belongs to, or when it was taken; lists say times.
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

TIMES_FILE = "timestamps.txt"  # one a line (s); ours, in folders of numbered images
_TOLERANCE = 0.02  # s between what belongs together: that of the TUM benchmark's associate.py
_GAP = 0.0505  # s between poses that are interpolated, 20 Hz: at a hand's 2 m/s² 0.6 mm off


def check_paired(colors: list[Path], others: list[Path]) -> None:
    """Raises DataError unless every image has a depth map or pose of the same frame number.

    Also raises it where the numbers may not give the order of the frames.
    """
    color_keys, other_keys = frame_keys(colors), frame_keys(others)
    if color_keys != other_keys or len(set(color_keys)) < len(color_keys):
        keys = color_keys + other_keys
        count = Counter(keys)  # 2 of a key that each list has once
        odd = [p.name for p, key in zip(colors + others, keys, strict=True) if count[key] != 2]
        raise DataError(
            f"{colors[0].parent} has {len(colors)} images but {others[0].parent.name}/ has "
            f"{len(others)} {others[0].suffix} files: every image needs one of its number, and a "
            f"folder one session; rename or remove the {len(odd)} that have none, or two: "
            f"{', '.join(odd[:4])}"
        )
    check_order(colors)


def nearest(times: Times, others: Times, tolerance: float) -> Frames:
    """For every time the index of the nearest other one; -1 if none is within the tolerance (s)."""
    # In one dimension p=1 is the plain difference, which no square and root round.
    distances, closest = cKDTree(others[:, None]).query(times[:, None], p=1)
    return np.where(distances <= tolerance, closest, -1)


def pair_lists(color_list: Path, depth_list: Path) -> tuple[list[Path], list[Path], Times, str]:
    """Images and depth maps of two lists that are each other's nearest in time.

    Also returns the images' times (s), and a note, which is empty unless images are left out.
    Raises DataError if all are left out.
    """
    color_times, colors = _read_list(color_list)
    depth_times, depths = _read_list(depth_list)
    depth_of_color = nearest(color_times, depth_times, _TOLERANCE)
    color_of_depth = nearest(depth_times, color_times, _TOLERANCE)
    # An image without a depth map has -1, which indexes the last one: the next line leaves it out.
    is_mutual = color_of_depth[depth_of_color] == np.arange(len(colors))
    kept = np.flatnonzero((depth_of_color >= 0) & is_mutual)
    of_all = f"{len(colors) - len(kept)} of the {len(colors)} images in {color_list.name}"
    why = f"no depth map of {depth_list.name} has them nearest within {_TOLERANCE} s"
    left_out = f"{of_all} are left out: {why}"
    if not len(kept):
        raise DataError(f"{color_list.parent}: {left_out}; both lists need the same clock")
    note = left_out if len(kept) < len(colors) else ""
    paired_depths = [depths[i] for i in depth_of_color[kept]]
    return [colors[i] for i in kept], paired_depths, color_times[kept], note


def _read_list(path: Path) -> tuple[Times, list[Path]]:
    """Times (s), which rise, and files of a list with `timestamp file` a line."""
    # Windows separates folders by a backslash.
    words = [line.replace("\\", "/").strip().split(maxsplit=1) for line in read_lines(path)]
    advice = "every line holds 'timestamp file', such as '1305031102.175 rgb/1305031102.175.png'"
    with naming_damaged(path, "list", advice):
        times = in_seconds(np.array([float(time) for time, _ in words]))
        if not np.isfinite(times).all():
            raise ValueError("a time is not finite")
    check_rising(times, path)
    files = [path.parent / name for _, name in words]
    for file in files:
        if not os.path.isfile(file):  # unlike pathlib's, it takes names that no file can have
            found = f"{path} names {str(file)[:200]!r}, which is not there"
            raise MissingError(f"{found}: add it, or take it out")
    return times, files


@dataclass(frozen=True, eq=False)
class Moments:
    """What is known of the times of frames from files and their names."""

    images: list[Path]
    own: Times | None  # s: of a list, a file of times, or the names of images
    rate_hz: float  # of the numbers in names
    counts_from_0: bool  # a number is the place of the frame's pose in a list

    @cached_property
    def numbers(self) -> Frames | None:
        """The frames' numbers, where just one in the names varies."""
        keys = frame_keys(self.images)
        return np.array(keys).ravel() if set(map(len, keys)) == {1} else None

    @cached_property
    def times(self) -> Times:
        """Times (s) of frames: their own, else by their numbers and the rate."""
        if self.own is not None:
            return self.own
        numbers = np.arange(len(self.images)) if self.numbers is None else self.numbers
        return (numbers - numbers[0]) / self.rate_hz

    def poses_of(
        self, path: Path, poses: Poses, stamps: Times, flip: Callable[[Poses], Poses]
    ) -> tuple[Poses, str]:
        """A pose for each frame from those of a list, NaN where a frame has none, and a note.

        The first of these rules that applies gives poses to frames:
        1. Each stamp (s; NaN: none) is exactly the time of a frame, as in lists that nbtrack wrote.
        2. Frames have times of their own, and some stamp is near one of them. Then both are on the
           same clock, and poses are interpolated.
        3. Frames take poses by their numbers, see `_by_number`. Where frames have times of their
           own and no stamp is near one, the clocks differ, and equal counts prove nothing. The rule
           then applies only to stamps at even steps, which may just count the lines.

        `flip` converts the list's poses to camera-to-world ones, and back, for rule 2. `path` names
        the list in messages. Raises DataError if no rule applies.
        """
        has_both = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(stamps)
        known_poses, known_stamps = poses[has_both], stamps[has_both]
        same_time = nearest(self.times, known_stamps, tolerance=0.0)
        if len(known_stamps) > 0 and (same_time >= 0).sum() == len(known_stamps):
            return _at(known_poses, same_time), ""
        if self.own is not None and (nearest(self.times, known_stamps, _TOLERANCE) >= 0).any():
            return _interpolated(self.times, known_poses, known_stamps, flip)
        if self.own is None or _are_even(known_stamps):
            all_stamped = has_both.any() and np.isfinite(stamps).all()
            if found := self._by_number(poses, stamps if all_stamped else None):
                return found
        raise DataError(
            f"{path} has {len(poses)} poses but there are {len(self.images)} images; nothing tells "
            f"whose each is: write one an image ('nan': none), or {TIMES_FILE}, on the poses' clock"
        )

    def _by_number(self, poses: Poses, stamps: Times | None) -> tuple[Poses, str] | None:
        """A pose for each frame by the frames' numbers, and a note; None if no rule applies.

        The number of a pose is its stamp (s) times the rate. Without stamps it is the pose's place
        in the list. There are two rules:
        1. Equal numbers are paired. The frames' numbers may be counted in the ways of `_counted`.
           Exactly one way must give a complete pairing, in which all frames have a pose or all
           poses have a frame. Without stamps there must also be more poses than frames.
        2. Equally many poses and frames are paired in order. The rule does not apply where stamps
           are times and most frames have a pose at their time: then the list lacks the poses of
           some frames and has others.
        """
        n_frames, n_poses = len(self.images), len(poses)
        pose_numbers = np.arange(n_poses) if stamps is None else stamps * self.rate_hz
        tolerance = min(1e-3 * self.rate_hz, 0.25)  # 1 ms, in numbers, which are 1 apart
        # A row for each way to count: the place of every frame's pose, -1 without one.
        ways = [nearest(numbers, pose_numbers, tolerance) for numbers in self._counted()]
        places = np.unique(np.reshape(ways, (-1, n_frames)), axis=0)
        n_paired = (places >= 0).sum(axis=1)
        complete = places[n_paired == min(n_frames, n_poses)]
        if len(complete) == 1 and (n_poses > n_frames or stamps is not None):
            note = f"of {n_poses} poses those of the images' numbers" if n_poses > n_frames else ""
            return _at(poses, complete[0]), note
        are_times = stamps is not None and not _are_even(stamps)  # even ones may count the poses
        most_have_pose = (n_paired > 0.75 * n_frames).any()
        if n_poses != n_frames or (are_times and most_have_pose):
            return None
        counts_up = np.array_equal(self.numbers, np.arange(n_frames))
        return poses, "" if counts_up else "images have the poses one after another"

    def _counted(self) -> list[Frames]:
        """Places in the list that the frames' numbers may mean, an array for each way to count.

        The list may begin with number 0 (the numbers as they stand), with 1, or with the first
        frame's. In a format that counts from 0 it begins with 0, unless the numbers are 1 to n.
        """
        if self.numbers is None:
            return []
        first = self.numbers[0]
        is_1_to_n = first == 1 and np.ptp(self.numbers) == len(self.numbers) - 1
        # The second entry is 1, or 0 where there is a frame 0.
        of_place_0 = [0] if self.counts_from_0 and not is_1_to_n else [0, min(first, 1), first]
        return [self.numbers - number for number in of_place_0]


def _interpolated(
    times: Times, poses: Poses, stamps: Times, flip: Callable[[Poses], Poses]
) -> tuple[Poses, str]:
    """The pose at each time, and a note on how many are interpolated.

    Between two stamps that are close to each other the pose is interpolated. Elsewhere it is that
    of the nearest stamp, or NaN. An interpolated camera moves along a straight line in the world
    and turns at a constant rate. Only camera-to-world poses do so: `flip` converts the list's poses
    to these, and back.
    """
    found = _at(poses, nearest(times, stamps, _TOLERANCE))
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    # s from each time back to the stamp before it, and on to the stamp after it.
    before, after = times - stamps[later - 1], stamps[later] - times
    to_nearest = np.minimum(before, after)  # s; negative outside of the list
    # Elsewhere the nearest pose stays. A stamp within 1e-6 s is that of the time itself, rounded.
    is_between = (before + after <= _GAP) & (to_nearest > 1e-6)
    if not is_between.any():
        return found, ""
    T_knots, wanted = flip(poses), times[is_between]
    T_wanted = np.tile(np.eye(4), (len(wanted), 1, 1))
    T_wanted[:, :3, 3] = interp1d(stamps, T_knots[:, :3, 3], axis=0)(wanted)
    turning = Slerp(stamps, Rotation.from_matrix(T_knots[:, :3, :3]))
    T_wanted[:, :3, :3] = turning(wanted).as_matrix()
    found[is_between] = flip(T_wanted)
    note = f"{len(wanted)} of {len(found)} poses are interpolated, the nearest up to"
    return found, f"{note} {1e3 * to_nearest[is_between].max():.1f} ms away"


def _are_even(stamps: Times) -> bool:
    """Whether steps between stamps differ by no more than a tenth of the median step."""
    steps = np.diff(stamps)
    return len(steps) == 0 or np.ptp(steps) <= 0.1 * np.median(np.abs(steps))


def _at(poses: Poses, places: Frames) -> Poses:
    """The poses at places in a list; NaN at -1."""
    return np.where(places[:, None, None] >= 0, poses[places], np.nan)
