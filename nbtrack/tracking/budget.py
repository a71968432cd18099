"""How many optimization steps a frame may take: by the clock, or by a fixed count.

`for step in budget.frame(): ...` lasts as long as the frame may. `memory` is what the frames so far
leave to the next one, so every trajectory needs a budget of its own.
"""

import time
from collections.abc import Callable, Generator
from fractions import Fraction
from math import floor

import torch

from nbtrack.machinery.device import synchronize
from nbtrack.machinery.errors import ConfigError, look_up
from nbtrack.machinery.inputs import number

_HOST = torch.device("cpu")
# Steps, or Hz: beyond, no step is taken, or all without end.
_FEWEST, _MOST = 1e-3, 1e6
Number = float | int


class ClockBudget:
    """1/rate seconds per frame; a frame ends when the mean step no longer fits in what is left.

    The mean is over the current frame's own steps. Before its first step the previous frame's mean
    stands in, and a frame may then take no step at all. After such a frame, as at the very first,
    the next one starts with a step whatever it costs; else one slow step (a first call that
    compiles or allocates) would stop tracking for good.

    Time runs from the call of `frame`: a tracker that prepares its frame before the first step pays
    for it, though not as part of a step. Before every reading of the clock the tracker's device is
    waited for: steps that are only queued would look free. Unused time is lost. Source: paper,
    evaluation protocol; for the first step of a frame, our choice.
    """

    def __init__(self, rate_hz: Number, clock: Callable[[], float] = time.perf_counter) -> None:
        """Take frames a second and a clock (s); ConfigError if the rate is not 0.001 to 1e6."""
        self.rate_hz = number("rate_hz", rate_hz, _FEWEST, _MOST)
        self._clock = clock
        self.memory: float | None = None  # mean seconds of a step in the last frame

    def __str__(self) -> str:
        return f"wall clock, {1000 / self.rate_hz:g} ms per frame"

    def frame(self, device: torch.device = _HOST) -> Generator[int, None, None]:
        """Starts the clock of the next frame, of a tracker on a device.

        Yields 0, 1, 2, ... as long as another step is allowed. A caller that stops earlier calls
        `close`, so that its last step is counted.
        """
        return self._steps(self._now(device), device)

    def _now(self, device: torch.device) -> float:
        """The clock (s) when all that is queued on the device is done."""
        synchronize(device)
        return self._clock()

    def _steps(self, start: float, device: torch.device) -> Generator[int, None, None]:
        """The steps of a frame begun at `start` (s). It is prepared when the first is asked for."""
        prepared = now = self._now(device)
        mean, step = self.memory, 0
        self.memory = None  # it stays so after a frame without any step
        while mean is None or start + 1 / self.rate_hz - now >= mean:
            try:
                yield step
            finally:  # also where the caller closes the frame, as a search does that has converged
                step += 1
                now = self._now(device)
                mean = (now - prepared) / step
                self.memory = mean


class StepBudget:
    """A fixed, possibly fractional number of steps per frame; the same on every machine.

    After k frames exactly floor(k * steps_per_frame) steps were allowed: with 6.8 the frames take
    6, 7, 7, 7, 7, 6, ... Our choice, to repeat the paper's tables at its hardware's speed.
    """

    def __init__(self, steps_per_frame: Number) -> None:
        """Raises ConfigError if the count is not 0.001 to 1e6."""
        self.steps_per_frame = number("steps_per_frame", steps_per_frame, _FEWEST, _MOST)
        # The nearest short fraction: 6.8 becomes 34/5, so that ten frames take 68 steps, not 67.
        self._exact = Fraction(self.steps_per_frame).limit_denominator(1_000_000)
        self.memory = 0  # frames so far

    def __str__(self) -> str:
        return f"{self.steps_per_frame:g} steps per frame"

    def frame(self, device: torch.device = _HOST) -> Generator[int, None, None]:
        """Yields 0, 1, ... while another step is allowed in the next frame, on any device.

        A frame counts once its first step is asked for, whether it may take one or not.
        """
        steps_before = floor(self.memory * self._exact)
        self.memory += 1
        steps_after = floor(self.memory * self._exact)
        yield from range(steps_after - steps_before)


Budget = ClockBudget | StepBudget


def make_budget(steps: Number | None, rate_hz: Number | None) -> Budget:
    """A budget by the clock if there is a rate (Hz), else of so many steps a frame.

    Raises ConfigError if there are both or neither, or the number is far out.
    """
    if (steps is None) == (rate_hz is None):
        raise ConfigError(f"steps={steps} and rate_hz={rate_hz}: a frame has one budget, give one")
    return StepBudget(steps) if rate_hz is None else ClockBudget(rate_hz)


_MEASURED_STEPS = {"vr": (6.8, 36.1), "sdf": (15.3, 79.3)}
"""Steps within 100 and 500 ms for the default n (VR 512, SDF 4096). Source: paper, Table II."""


def paper_steps(tracker: str, rate_hz: Number) -> float:
    """Steps a frame of "vr" or "sdf" on the paper's hardware, with its n.

    Raises ConfigError for a rate that is not 0.001 to 1e6, or at which no step is left.

    On the line through its 100 and 500 ms figures: time per step and fixed cost of a frame are then
    the same at every rate. Table II has no 200 ms column although Table I has 5 Hz (our choice).
    """
    budget_ms = 1000 / number("rate_hz", rate_hz, _FEWEST, _MOST)
    at_100, at_500 = look_up("tracker of the paper", tracker, _MEASURED_STEPS)
    steps = round(at_100 + (at_500 - at_100) * (budget_ms - 100) / 400, 6)
    if steps < _FEWEST:
        raise ConfigError(f"rate_hz is {rate_hz:g}, at which no step of {tracker} fits: lower it")
    return steps
