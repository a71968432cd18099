"""The stop rule with a clock that is moved by hand, and step counts with fractions.

What is refused: `test_faults.py`.
"""

import pytest

from nbtrack import METHODS
from nbtrack.tracking import ClockBudget, StepBudget, paper_steps


class FakeClock:
    """A clock that only moves when told to. Durations are binary fractions, hence exact."""

    def __init__(self, rate_hz: float | int = 1) -> None:
        self.seconds = 1000.0
        self.budget = ClockBudget(rate_hz, lambda: self.seconds)

    def steps(self, *durations: float, last: int = 99) -> int:
        """Steps of the next frame, when its steps last this long, of which the last repeats; after
        `last` steps it has converged."""
        count = 0
        self.seconds += 10.0  # what the next image takes to load is free
        frame = self.budget.frame()
        for count, step in enumerate(frame, start=1):
            assert step == count - 1
            self.seconds += durations[min(step, len(durations) - 1)]
            if count == last:
                break
        frame.close()
        return count


FRAMES = {
    "off by one: 8 steps of 1/8 s fit into 1 s": ([1 / 8] * 3, [8, 8, 8]),
    "overrun: after 2 steps of 3/8 s only 2/8 s are left": ([3 / 8] * 3, [2, 2, 2]),
    # A mean of 2 s does not fit into frame 2; frame 3 has nothing to go by and measures anew.
    "a slow first call that starves every later frame": ([2.0, 1 / 8, 1 / 8, 1 / 8], [1, 0, 8, 8]),
    # Frame 1: one step, left 3/8 s. Frame 2 starts as 5/8 s fit; its own steps set the mean.
    "a mean that is not carried on, or mixed over frames": ([5 / 8, 1 / 4, 1 / 4], [1, 4, 4]),
}


@pytest.mark.parametrize("fault", FRAMES)
def test_frames_of_equal_steps(fault: str) -> None:
    """Catches a wrong stop rule; how, says the table."""
    clock, (durations, counts) = FakeClock(), FRAMES[fault]
    assert [clock.steps(duration) for duration in durations] == counts


def test_a_converged_step_counts() -> None:
    """Catches a search that ends in its first step, as ICP's does, and is never charged for it: of
    50 ms a step at 1,000 Hz every other frame has none, as where nothing converges."""
    clock = FakeClock(1000)
    assert [clock.steps(1 / 16, last=1) for _ in range(5)] == [1, 0, 1, 0, 1]


def test_mean_is_over_the_whole_frame() -> None:
    """Catches stopping by the last step's time, and a resumed frame that starts although the mean
    does not fit. Steps of 1/2, 1/8, 1/8, ... s.

    After 1: mean 1/2, left 1/2, go on. After 2: mean 5/16, left 3/8, go on. After 3: mean 1/4,
    left 1/4, go on. After 4: mean 7/32, left 1/8: stop, although a step of 1/8 would fit.
    """
    assert FakeClock().steps(1 / 2, 1 / 8) == 4
    assert FakeClock(2).steps(1 / 16) == 8  # 2 Hz is half a second, not two
    assert str(FakeClock(2).budget) == "wall clock, 500 ms per frame"
    clock, resumed = FakeClock(), FakeClock()
    assert clock.steps(2.0) == 1
    resumed.budget.memory = clock.budget.memory
    assert clock.steps(1 / 8) == resumed.steps(1 / 8) == 0


COUNTS = {
    6.8: [6, 7, 7, 7, 7, 6, 7, 7, 7, 7],  # not 67 in all, as where 6.8 is summed in floats
    2.5: [2, 3, 2, 3],
    3: [3, 3, 3],
    0.9: [0, *[1] * 9, 0],  # no hidden minimum of one step
}


@pytest.mark.parametrize("steps", COUNTS)
def test_fractions_accumulate(steps: float | int) -> None:
    """Catches rounding of every frame, drift of the sum, and numbers that go by other frames."""
    budget = StepBudget(steps)
    assert [list(budget.frame()) for _ in COUNTS[steps]] == [[*range(n)] for n in COUNTS[steps]]
    budget = StepBudget(steps)
    assert sum(1 for _ in range(1000) for _ in budget.frame()) == round(steps * 1000)


def test_paper_steps() -> None:
    """Catches wrong figures of Table II, and steps of another tracker or rate where nobody says how
    many. 5 Hz: 6.8 + 29.3 / 4 and 15.3 + 64 / 4."""
    assert [paper_steps("vr", rate_hz) for rate_hz in (10, 5, 2)] == [6.8, 14.125, 36.1]
    assert [paper_steps("sdf", rate_hz) for rate_hz in (10, 5, 2)] == [15.3, 31.3, 79.3]
    usual = [METHODS[name].usual_steps for name in ("vr_neus", "sdf", "icp", "corrected")]
    assert usual == [36.1, 79.3, 30, 30]
