"""When the frames of a recording were taken, and which pose of a list is whose."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.core.arrays import Frames, Poses
from nbtrack.data.text_files import Times

TOLERANCE = 0.02  # s between what belongs together: that of the TUM benchmark's associate.py
_SAME_TIME = 1e-6  # s: the last digit of lists
_ON_TIME = 1e-3  # s between a stamp and the number, over the rate, of the same frame
_GAP = 0.0505  # s between poses that are interpolated, 20 Hz: at a hand's 2 m/s² 0.6 mm off


def nearest(times: Times, others: Times, tolerance: float) -> Frames:
    """For every time the index of the nearest other one; -1 if none is within the tolerance (s)."""
    apart, closest = cKDTree(others[:, None]).query(times[:, None], p=1)
    return np.where(apart <= tolerance, closest, -1)


@dataclass(frozen=True, eq=False)
class Moments:
    """What files tell of the time of frames."""

    n_frames: int
    own: Times | None  # s: of a list, a file of times, or the names of images
    numbers: Frames | None  # in the names of images
    rate_hz: float  # of the numbers
    counts_from_0: bool  # as the format says

    @cached_property
    def times(self) -> Times:
        """Times (s) of frames: their own, else by their numbers and the rate."""
        if self.own is not None:
            return self.own
        numbers = np.arange(self.n_frames) if self.numbers is None else self.numbers
        return (numbers - numbers[0]) / self.rate_hz

    def matched(
        self, poses: Poses, stamps: Times | None, flip: Callable[[Poses], Poses]
    ) -> tuple[Poses, str] | None:
        """A pose a frame of a list, NaN without one, and a note; None where nothing tells it.

        Stamps (s) of the list count where they are the very times of frames, or are of the clock
        of their own times; else frames' numbers do. `flip` makes camera-to-world poses of the
        list's, and the other way round.
        """
        is_known = np.isfinite(poses).all(axis=(1, 2))
        if stamps is None or not is_known.any():
            return self._by_number(poses, None)
        own = nearest(self.times, stamps[is_known], 0.0)
        if (own >= 0).sum() == is_known.sum():  # as in trajectories that nbtrack wrote
            return _at(poses[is_known], own), ""
        if self.own is not None:
            near = nearest(self.own, stamps[is_known], TOLERANCE)
            if (near >= 0).any():
                return self._by_time(poses[is_known], stamps[is_known], near, flip)
            steps = np.diff(stamps[is_known])
            if len(steps) and np.ptp(steps) > 0.1 * np.median(np.abs(steps)):
                return None  # two clocks: equal counts alone prove nothing; even steps only count
        return self._by_number(poses, stamps if np.isfinite(stamps).all() else None)

    def _by_time(
        self, poses: Poses, stamps: Times, near: Frames, flip: Callable[[Poses], Poses]
    ) -> tuple[Poses, str]:
        """The nearest poses; between two that are close to each other, the one between them.

        The camera goes straight there, and turns about one axis. A pose of a frame's very time
        stays as it is.
        """
        found = _at(poses, near)
        stamps, first = np.unique(stamps, return_index=True)
        later = np.searchsorted(stamps, self.times).clip(1, len(stamps) - 1)
        before = self.times - stamps[later - 1]
        after = stamps[later] - self.times
        apart = np.minimum(before, after)
        is_between = (before + after <= _GAP) & (apart > _SAME_TIME)
        if not is_between.any():
            return found, ""
        later = later[is_between]
        share = (before / (before + after))[is_between]
        T = flip(poses[first])
        between = T[later - 1]
        between[:, :3, 3] += share[:, None] * (T[later] - T[later - 1])[:, :3, 3]
        turns = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))
        between[:, :3, :3] = turns(self.times[is_between]).as_matrix()
        found[is_between] = flip(between)
        far_ms = 1e3 * apart[is_between].max()
        note = f"{is_between.sum()} of {self.n_frames} poses are interpolated, the nearest"
        return found, f"{note} up to {far_ms:.1f} ms away"

    def _by_number(self, poses: Poses, stamps: Times | None) -> tuple[Poses, str] | None:
        """Poses whose stamps (s), or places in a longer list, are frames' numbers over the rate.

        That must be so in just one way to count. Else poses follow one another, if there are as
        many as frames.
        """
        n_frames = self.n_frames
        n_poses = len(poses)
        clock = np.arange(n_poses) / self.rate_hz if stamps is None else stamps
        near = min(_ON_TIME, 0.25 / self.rate_hz)
        ways = np.array([nearest(times, clock, near) for times in self._counted()], dtype=int)
        ways = ways.reshape(-1, n_frames)
        n_found = (ways >= 0).sum(axis=1)
        whole = np.unique(ways[n_found == min(n_frames, n_poses)], axis=0)
        if len(whole) == 1 and n_poses > n_frames:
            return _at(poses, whole[0]), f"of {n_poses} poses those of the images' numbers"
        if len(whole) == 1 and stamps is not None:
            return _at(poses, whole[0]), ""
        # Stamps of most frames leave out others than the frames do; even ones only count the lines.
        is_odd = stamps is not None and n_found.max(initial=0) > 0.75 * n_frames
        if n_poses != n_frames or (is_odd and np.ptp(np.diff(stamps)) > 0.1 / self.rate_hz):
            return None
        is_plain = np.array_equal(self.numbers, np.arange(n_frames))
        return poses, "" if is_plain else "images have the poses one after another"

    def _counted(self) -> list[Times]:
        """Times (s) of frames by their numbers, for each number that the count may begin with."""
        if self.numbers is None:
            return []
        first = self.numbers[0]
        is_cut = first != 1 or np.ptp(self.numbers) != self.n_frames - 1
        starts = {0} if self.counts_from_0 and is_cut else {0, min(first, 1), first}
        return [(self.numbers - start) / self.rate_hz for start in starts]


def _at(poses: Poses, places: Frames) -> Poses:
    """The poses at places in a list; NaN at -1."""
    return np.where(places[:, None, None] >= 0, poses[places], np.nan)
