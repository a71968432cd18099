"""Budgets: how many optimization steps a frame may take, by the clock or by a fixed count.

The loop `for step in budget.frame(): ...` ends when the frame's budget is spent. A budget remembers
earlier frames in `memory`, so that every trajectory needs its own budget.
"""

import time
from collections.abc import Callable, Generator
from fractions import Fraction
from math import floor

import torch

from nbtrack.machinery.device import synchronize
from nbtrack.machinery.errors import ConfigError, look_up, typed
from nbtrack.machinery.inputs import number

_HOST = torch.device("cpu")
# Limits of steps per frame and of rates (Hz): beyond them a frame would take none, or far too many.
_FEWEST, _MOST = 1e-3, 1e6
Number = float | int


class ClockBudget:
    """A budget of 1/rate seconds per frame.

    A frame ends when the time left is shorter than its mean step. Before the first step the mean of
    the previous frame is used instead, so that a frame may take no step at all. After such a frame,
    and in the very first frame, the first step is always allowed. Otherwise a single slow step,
    such as a first call that compiles, would end tracking for good.

    Time runs from the call of `frame`. What a tracker does before its first step takes from the
    budget, but does not count as a step. The clock is read only when all work queued on the
    tracker's device is done. Unused time is lost. Source: paper, evaluation protocol; the rule for
    the first step is our choice.
    """

    @typed
    def __init__(self, rate_hz: Number, clock: Callable[[], float] = time.perf_counter) -> None:
        """Take a rate (Hz) and a clock (s). Raises ConfigError for a rate beyond 0.001 to 1e6."""
        self.rate_hz = number("rate_hz", rate_hz, _FEWEST, _MOST)
        self._clock = clock
        self.memory: float | None = None  # mean seconds of a step in the last frame

    def __str__(self) -> str:
        return f"wall clock, {1000 / self.rate_hz:g} ms per frame"

    def frame(self, device: torch.device = _HOST) -> Generator[int, None, None]:
        """Starts the clock for the next frame; yields 0, 1, 2, ... while another step is allowed.

        `device` is that of the tracker. A caller that stops earlier must call `close`, so that its
        last step is counted.
        """
        # The clock starts here. The body of a generator, as `_steps` is one, runs only when the
        # first step is asked for.
        return self._steps(self._now(device), device)

    def _now(self, device: torch.device) -> float:
        """The time (s) when all work queued on the device is done."""
        synchronize(device)
        return self._clock()

    def _steps(self, start: float, device: torch.device) -> Generator[int, None, None]:
        """The steps of a frame that began at `start` (s)."""
        prepared = now = self._now(device)  # the first step begins: the tracker has prepared it
        mean, step = self.memory, 0  # mean seconds of a step, and the number of steps so far
        self.memory = None  # stays None if the frame takes no step
        while mean is None or start + 1 / self.rate_hz - now >= mean:
            try:
                yield step
            finally:  # a caller whose search has converged closes the frame, and `yield` raises
                step += 1
                now = self._now(device)
                self.memory = mean = (now - prepared) / step


class StepBudget:
    """A budget with a fixed number of steps per frame, which is the same on every machine.

    The number may be fractional: after k frames exactly floor(k * steps_per_frame) steps were
    allowed. With 6.8 steps per frame the frames take 6, 7, 7, 7, 7, 6, ... steps. Our choice, to
    reproduce the paper's tables at the speed of its hardware.
    """

    def __init__(self, steps_per_frame: Number) -> None:
        """Take the number of steps. Raises ConfigError if it is not 0.001 to 1e6."""
        self.steps_per_frame = number("steps_per_frame", steps_per_frame, _FEWEST, _MOST)
        # The nearest fraction with a small denominator: 6.8, which floating point cannot hold
        # exactly, becomes 34/5, so that ten frames take 68 steps and not 67.
        self._exact = Fraction(self.steps_per_frame).limit_denominator(1_000_000)
        self.memory = 0  # frames so far

    def __str__(self) -> str:
        return f"{self.steps_per_frame:g} steps per frame"

    def frame(self, device: torch.device = _HOST) -> Generator[int, None, None]:
        """Yields 0, 1, ... while another step is allowed in the next frame, on any device.

        A frame counts as soon as its first step is requested, even if it may take none.
        """
        steps_before = floor(self.memory * self._exact)
        self.memory += 1
        steps_after = floor(self.memory * self._exact)
        yield from range(steps_after - steps_before)


Budget = ClockBudget | StepBudget


def make_budget(steps: Number | None, rate_hz: Number | None) -> Budget:
    """A `StepBudget` of some steps per frame, or a `ClockBudget` for a rate (Hz).

    Raises ConfigError unless exactly one of them is given, between 0.001 and 1e6.
    """
    if (steps is None) == (rate_hz is None):
        raise ConfigError(f"steps={steps} and rate_hz={rate_hz}: a frame has one budget, give one")
    return StepBudget(steps) if rate_hz is None else ClockBudget(rate_hz)


_MEASURED_STEPS = {"vr": (6.8, 36.1), "sdf": (15.3, 79.3)}
"""Steps within 100 ms and within 500 ms, with VR's n of 512 and SDF's of 4096 (paper, Table II)."""


def paper_steps(tracker: str, rate_hz: Number) -> float:
    """Steps per frame that "vr" or "sdf" takes on the paper's hardware at a rate (Hz).

    The paper gives steps for 100 and 500 ms per frame (Table II), but not for 5 Hz of Table I. The
    steps at other rates lie on the line through both, as if a step and the rest of a frame cost the
    same at every rate (our choice).

    Raises ConfigError for another tracker, a rate beyond 0.001 to 1e6, or a rate so high that no
    step fits into a frame.
    """
    budget_ms = 1000 / number("rate_hz", rate_hz, _FEWEST, _MOST)
    at_100, at_500 = look_up("tracker of the paper", tracker, _MEASURED_STEPS)
    steps = round(at_100 + (at_500 - at_100) * (budget_ms - 100) / 400, 6)
    if steps < _FEWEST:
        raise ConfigError(f"rate_hz is {rate_hz:g}, at which no step of {tracker} fits: lower it")
    return steps
