"""The stop rule with a clock that is moved by hand, and step counts with fractions."""

from itertools import pairwise

import pytest

from nbtrack.core.errors import ConfigError
from nbtrack.tracking.budget import Budget, ClockBudget, StepBudget, paper_steps


class FakeClock:
    """A clock that only moves when told to. Durations are binary fractions, hence exact."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds

    def spend(self, seconds: float) -> None:
        self.seconds += seconds


def count_steps(budget: Budget, clock: FakeClock, durations: list[float]) -> int:
    """Steps of one frame, when its steps last this long; the last duration repeats."""
    steps = 0
    for step in budget.frame():
        assert step == steps
        clock.spend(durations[min(step, len(durations) - 1)])
        steps += 1
    return steps


def test_steps_that_fill_the_frame_exactly() -> None:
    """Catches a stop rule that is off by one: 8 steps of 1/8 s fit into 1 s."""
    clock = FakeClock()
    budget = ClockBudget(1, clock)
    assert [count_steps(budget, clock, [1 / 8]) for _ in range(3)] == [8, 8, 8]


def test_remainder_smaller_than_a_step_is_left() -> None:
    """Catches a rule that overruns: after 2 steps of 3/8 s only 2/8 s are left."""
    clock = FakeClock()
    budget = ClockBudget(1, clock)
    assert [count_steps(budget, clock, [3 / 8]) for _ in range(3)] == [2, 2, 2]


def test_mean_is_over_the_whole_frame() -> None:
    """Catches stopping by the last step's time. Steps of 1/2, 1/8, 1/8, ... s.

    After 1: mean 1/2, left 1/2, go on. After 2: mean 5/16, left 3/8, go on. After 3: mean 1/4,
    left 1/4, go on. After 4: mean 7/32, left 1/8: stop, although a step of 1/8 would fit.
    """
    clock = FakeClock()
    assert count_steps(ClockBudget(1, clock), clock, [1 / 2, 1 / 8]) == 4


def test_slow_first_step_does_not_stop_tracking() -> None:
    """Catches a first call (compilation, allocation) that starves every later frame.

    Frame 1: one step of 2 s. Frame 2: the carried mean of 2 s does not fit, no step. Frame 3 has
    nothing to go by and measures anew: 8 steps of 1/8 s, and so has frame 4.
    """
    clock = FakeClock()
    budget = ClockBudget(1, clock)
    counts = [count_steps(budget, clock, [d]) for d in (2.0, 1 / 8, 1 / 8, 1 / 8)]
    assert counts == [1, 0, 8, 8]


def test_mean_is_carried_to_the_next_frame() -> None:
    """Catches a frame that always starts with a step, and a mean mixed over frames.

    Steps of 5/8 s in frame 1: one (left 3/8). Frame 2 starts as 5/8 fits into 1 s; its own steps
    of 1/4 s then set the mean: four.
    """
    clock = FakeClock()
    budget = ClockBudget(1, clock)
    assert [count_steps(budget, clock, [d]) for d in (5 / 8, 1 / 4, 1 / 4)] == [1, 4, 4]


def test_time_between_frames_is_free() -> None:
    """Catches a clock that runs while the next image is loaded."""
    clock = FakeClock()
    budget = ClockBudget(1, clock)
    for _ in range(3):
        clock.spend(10.0)
        assert count_steps(budget, clock, [1 / 4]) == 4


def test_rate_sets_the_budget() -> None:
    """Catches a rate used as a duration: 2 Hz is half a second."""
    clock = FakeClock()
    budget = ClockBudget(2, clock)
    assert count_steps(budget, clock, [1 / 16]) == 8
    assert str(budget) == "wall clock, 500 ms per frame"


def test_device_is_synchronized_before_each_reading() -> None:
    """Catches GPU steps that look free because they are only queued."""
    events: list[str] = []

    def clock() -> float:
        events.append("clock")
        return len(events) / 64

    budget = ClockBudget(4, clock, synchronize=lambda: events.append("wait"))
    list(budget.frame())
    assert len(events) >= 6
    assert all(pair in [("wait", "clock"), ("clock", "wait")] for pair in pairwise(events))
    assert events[0] == "wait"


def test_real_clock_keeps_the_budget() -> None:
    """Catches a default clock in other units than seconds."""
    assert 1 <= sum(1 for _ in ClockBudget(1000).frame()) < 1_000_000


def step_counts(steps_per_frame: float | int, frames: int) -> list[int]:
    budget = StepBudget(steps_per_frame)
    return [len(list(budget.frame())) for _ in range(frames)]


def test_fractions_accumulate() -> None:
    """Catches rounding of every frame, and 67 steps where 6.8 * 10 is summed in floats."""
    assert step_counts(6.8, 10) == [6, 7, 7, 7, 7, 6, 7, 7, 7, 7]
    assert step_counts(2.5, 4) == [2, 3, 2, 3]
    assert step_counts(3, 3) == [3, 3, 3]


def test_fewer_than_one_step_per_frame() -> None:
    """Catches a hidden minimum of one step: 0.9 leaves out one frame in ten."""
    assert step_counts(0.9, 11) == [0, *[1] * 9, 0]


@pytest.mark.parametrize("steps", [0.1, 6.8, 14.125, 15.3, 31.3, 36.1, 79.3])
def test_a_thousand_frames_sum_exactly(steps: float) -> None:
    """Catches drift of the accumulated fraction."""
    assert sum(step_counts(steps, 1000)) == round(steps * 1000)


def test_steps_are_numbered_from_zero() -> None:
    """Catches a step index that depends on earlier frames."""
    budget = StepBudget(2)
    assert [list(budget.frame()) for _ in range(2)] == [[0, 1], [0, 1]]
    assert str(StepBudget(6.8)) == "6.8 steps per frame"


def test_paper_steps() -> None:
    """Catches wrong figures of Table II. 5 Hz: 6.8 + 29.3 / 4 and 15.3 + 64 / 4."""
    assert [paper_steps("vr", rate_hz) for rate_hz in (10, 5, 2)] == [6.8, 14.125, 36.1]
    assert [paper_steps("sdf", rate_hz) for rate_hz in (10, 5, 2)] == [15.3, 31.3, 79.3]


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf")])
def test_bad_values(value: float) -> None:
    """Catches an endless or empty frame from a value that makes no sense."""
    with pytest.raises(ConfigError, match=r"rate_hz is .*; allowed: .* above 0; take"):
        ClockBudget(value)
    with pytest.raises(ConfigError, match=r"steps_per_frame is .*; allowed: .* above 0; take"):
        StepBudget(value)
