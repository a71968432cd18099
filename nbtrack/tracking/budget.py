"""How many optimization steps a frame may take: by the clock, or by a fixed count.

Both budgets have one method, `frame()`, whose iterator lasts as long as the frame may:

    for step in budget.frame():
        ...  # one optimization step

A budget remembers earlier frames, so every tracked trajectory needs its own.
"""

import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from math import floor, isfinite
from typing import Protocol, runtime_checkable

from nbtrack.core.errors import ConfigError


@runtime_checkable
class Budget(Protocol):
    """What the tracking loop needs to know about a budget."""

    def frame(self) -> Iterator[int]:
        """Starts the next frame; yields 0, 1, 2, ... as long as another step is allowed."""
        ...

    def state(self) -> dict[str, float | int | None]:
        """What the frames so far leave to the next one."""
        ...

    def restore(self, state: dict[str, float | int | None]) -> None:
        """Take up what `state` returned."""
        ...


class ClockBudget:
    """1/rate seconds per frame; a frame ends when the mean step no longer fits in what is left.

    The mean is over the current frame's own steps. Before its first step the previous frame's mean
    stands in, and a frame may then take no step at all. After such a frame there is nothing to go
    by, so the next one starts with a step whatever it costs, as the very first frame does; else one
    slow step (a first call that compiles or allocates) would stop tracking for good.

    Time runs from the first `next` of the iterator: loading the image before the loop is free,
    everything between two steps is part of a step. Unused time is lost, not carried over.

    Source: paper, evaluation protocol. It leaves open what holds before the first step of a frame
    and when a step is longer than the whole frame; both answers are our choice.
    """

    def __init__(
        self,
        rate_hz: float | int,
        clock: Callable[[], float] = time.perf_counter,
        synchronize: Callable[[], object] | None = None,
    ) -> None:
        """
        Args:
            rate_hz: frames per second.
            clock: seconds from any origin, never going back.
            synchronize: called before every reading of the clock; on a GPU pass
                `torch.cuda.synchronize`, else steps that are only queued look free.

        Raises:
            ConfigError: the rate is not a finite number above zero.
        """
        self.rate_hz = _positive("rate_hz", rate_hz, "10, 5 or 2 as in the paper")
        self._clock = clock
        self._synchronize = synchronize
        self._mean_step_seconds: float | None = None

    def __str__(self) -> str:
        return f"wall clock, {1000 / self.rate_hz:g} ms per frame"

    def frame(self) -> Iterator[int]:
        """Starts the next frame; yields 0, 1, 2, ... as long as another step is allowed."""
        start = self._now()
        mean, self._mean_step_seconds = self._mean_step_seconds, None
        elapsed, step = 0.0, 0
        while mean is None or 1 / self.rate_hz - elapsed >= mean:
            yield step
            step += 1
            elapsed = self._now() - start
            mean = self._mean_step_seconds = elapsed / step

    def state(self) -> dict[str, float | int | None]:
        """The mean seconds of a step in the last frame, None before the first."""
        return {"mean_step_seconds": self._mean_step_seconds}

    def restore(self, state: dict[str, float | int | None]) -> None:
        """Take up what `state` returned."""
        self._mean_step_seconds = state["mean_step_seconds"]

    def _now(self) -> float:
        if self._synchronize is not None:
            self._synchronize()
        return self._clock()


class StepBudget:
    """A fixed, possibly fractional number of steps per frame; the same on every machine.

    Fractions accumulate: after k frames exactly floor(k * steps_per_frame) steps were allowed.
    With 6.8 the frames take 6, 7, 7, 7, 7, 6, ... steps; with 0.4 most take none.

    Source: our choice, to repeat the paper's tables with the speed of its hardware (Table II).
    """

    def __init__(self, steps_per_frame: float | int) -> None:
        """
        Raises:
            ConfigError: the count is not a finite number above zero.
        """
        self.steps_per_frame = _positive(
            "steps_per_frame", steps_per_frame, "6.8 for volume rendering at 10 Hz"
        )
        # The nearest short fraction: 6.8 becomes 34/5, so that ten frames take 68 steps, not 67.
        self._exact = Fraction(self.steps_per_frame).limit_denominator(1_000_000)
        self._frames = 0

    def __str__(self) -> str:
        return f"{self.steps_per_frame:g} steps per frame"

    def frame(self) -> Iterator[int]:
        """Starts the next frame; yields 0, 1, 2, ... as long as another step is allowed."""
        done = floor(self._frames * self._exact)
        self._frames += 1
        yield from range(floor(self._frames * self._exact) - done)

    def state(self) -> dict[str, float | int | None]:
        """The number of frames so far."""
        return {"frames": self._frames}

    def restore(self, state: dict[str, float | int | None]) -> None:
        """Take up what `state` returned."""
        self._frames = int(state["frames"])


def _positive(name: str, value: float | int, example: str) -> float:
    if not (isfinite(value) and value > 0):
        raise ConfigError(
            f"{name} is {value:g}; allowed: a finite number above 0; take for example {example}"
        )
    return float(value)


_MEASURED_STEPS = {"vr": {100: 6.8, 500: 36.1}, "sdf": {100: 15.3, 500: 79.3}}
"""Steps within a budget (ms) for the default n (VR 512, SDF 4096). Source: paper, Table II."""


def paper_steps(tracker: str, rate_hz: float | int) -> float:
    """Steps a frame on the paper's hardware, on the line through its 100 and 500 ms figures.

    The time per step is then the same at every rate, and so is the fixed cost of a frame. Table
    II has no 200 ms column although Table I has 5 Hz, so that one is our choice.

    Args:
        tracker: "vr" or "sdf", with the paper's n = 512 and 4096.

    Raises:
        ConfigError: the rate is not a finite number above zero.
    """
    budget_ms = 1000 / _positive("rate_hz", rate_hz, "10, 5 or 2 as in the paper")
    at_100, at_500 = _MEASURED_STEPS[tracker][100], _MEASURED_STEPS[tracker][500]
    return round(at_100 + (at_500 - at_100) * (budget_ms - 100) / 400, 6)
