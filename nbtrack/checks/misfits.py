"""Small misfits of a recording, estimated: how late, how much too long, how far off.

One number at a time is varied. Under each of its values the surfaces that pairs of frames see lie
so far apart, and the intensities of their common points are so unlike. The value where they agree
best is the estimate; its interval comes from drawing the pairs anew (bootstrap).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbtrack.checks.readings import Costs, FramePairs, Reading

MAX_SHIFT = 3  # frames by which depth or colours may be late or early (our choice)
SHARES = np.linspace(-0.15, 0.15, 13)  # by which lengths may be off
_METRES = np.linspace(-0.6, 0.6, 13)  # by which poses may drift along an axis, over the recording
_PIXELS = np.linspace(-0.06, 0.06, 13)  # by which colours may be off, as a share of the width
_FRAMES = np.arange(-MAX_SHIFT, MAX_SHIFT + 1)
_NO_YES = np.array([0, 1])
# m, by which positions may scatter. Values below 0 have no meaning: they are there so that 0 lies
# between others, as in the other ranges.
_SCATTER = np.linspace(-0.02, 0.04, 13)
_GAIN = 0.98  # share of the cost as declared, above which an estimate tells nothing (our choice)
_MIN_PAIRS = 8  # that an estimate needs
MIN_CORRELATION = 0.75  # of intensities that pairs of a right recording have (our choice)
_RESAMPLED = 200  # draws of a bootstrap
_INTERVAL = [0.025, 0.975]  # its quantiles


class Parameter(NamedTuple):
    """A number that is varied; 0 is as declared."""

    key: str  # of `Reading`
    name: str
    form: str  # format specification of its estimate; empty for yes or no
    unit: str
    values: Float[np.ndarray, "values"]
    negligible: float  # as the values; our choice: more than right recordings show
    advice: str  # with {factor}, 1 + estimate


_POSES = "record or register the poses anew"
_DEPTH_PARAMETERS = [
    Parameter("depth_shift", "depth comes after the poses by", "+.1f", " frames", _FRAMES, 0.3,
              "shift one of them against the other"),
    Parameter("focal_share", "focal lengths should change by", "+.1%", "", SHARES, 0.01,
              "calibrate anew, or multiply them by {factor:.3f}"),
    Parameter("depth_share", "depths should change against the poses by", "+.1%", "", SHARES, 0.01,
              "divide depth_scale, or the positions, by {factor:.3f}"),
    Parameter("depth_growth", "depths grow over the recording by", "+.1%", "", SHARES, 0.02,
              "let the camera warm up before recording"),
    *(Parameter(f"drift_{axis}", f"poses drift along {axis} by", "+.2f", " m", _METRES, 0.1, _POSES)
      for axis in "xyz"),
    Parameter("scatter", "positions scatter by", ".3f", " m", _SCATTER, 5e-3, _POSES),
]  # fmt: skip
_COLOR_PARAMETERS = [
    Parameter("color_shift", "colours come after depth by", "+.1f", " frames", _FRAMES, 0.5,
              "shift one against the other"),
    Parameter("color_right", "colours lie too far right by", "+.1%", " of the width", _PIXELS, 0.01,
              "register colour and depth anew"),
    Parameter("is_mirrored", "colours alone are mirrored", "", "", _NO_YES, 0.5,
              "mirror them back"),
]  # fmt: skip


@dataclass(frozen=True)
class Misfit:
    """The estimate of a parameter, with its interval of 95 %."""

    parameter: Parameter
    estimate: float
    low: float
    high: float
    gain: float  # the cost at the estimate, as a share of that as declared

    @property
    def is_significant(self) -> bool:
        """Whether all of the interval is more than negligible, and frames agree better there."""
        negligible = self.parameter.negligible
        return (self.low > negligible or self.high < -negligible) and self.gain < _GAIN

    def __str__(self) -> str:
        name, form, unit = self.parameter.name, self.parameter.form, self.parameter.unit
        if not form:
            return f"{name}: {'yes' if self.is_significant else 'no'}"
        return f"{name} {self.estimate:{form}} ({self.low:{form}} to {self.high:{form}}){unit}"


def find_misfits(pairs: FramePairs, own: Reading) -> tuple[list[Misfit], float]:
    """Estimates of all misfits that pairs of frames can tell, also of those that are not
    significant, and the correlation of intensities of points that both frames of a pair see.

    The correlation is as declared, NaN without contrast. `pairs` must also hold the frames up to
    MAX_SHIFT around those of the pairs. Misfits of colours are looked for if none of depth is
    significant. One is left out if even at its best value colours correlate by less than
    MIN_CORRELATION: such colours are of another place.
    """
    found = list(_estimates(_DEPTH_PARAMETERS, own, pairs.depth_costs))
    # Colours are compared at the points whose depths agree as declared.
    color_costs = partial(pairs.color_costs, pairs.compare(own))
    unlikeness = color_costs(own)
    correlation = float(1 - np.nanmedian(unlikeness)) if np.isfinite(unlikeness).any() else np.nan
    if not any(misfit.is_significant for misfit in found):
        # The cost of colours is 1 - correlation; at a misfit's best value the share `gain` is left.
        of_colors = _estimates(_COLOR_PARAMETERS, own, color_costs)
        found += [m for m in of_colors if m.gain * (1 - correlation) < 1 - MIN_CORRELATION]
    return found, correlation


def main_misfit(misfits: list[Misfit]) -> str:
    """A sentence on the significant misfit that explains the most; empty if none is significant."""
    main = min((m for m in misfits if m.is_significant), key=lambda m: m.gain, default=None)
    if not main:
        return ""
    advice = main.parameter.advice.format(factor=1 + main.estimate)
    return f"{main}; without it frames differ {main.gain:.0%} as much: {advice}"


def _estimates(
    parameters: list[Parameter], own: Reading, cost: Callable[[Reading], Costs]
) -> Iterator[Misfit]:
    """An estimate of each parameter, by the pairs that have a cost at all of its values.

    A parameter for which these are fewer than `_MIN_PAIRS` is passed over.
    """
    for parameter in parameters:
        readings = [replace(own, **{parameter.key: value}) for value in parameter.values]
        costs = np.stack([cost(reading) for reading in readings], axis=1)
        costs = costs[np.isfinite(costs).all(axis=1)]
        if len(costs) >= _MIN_PAIRS:
            yield estimate(parameter, costs)


def estimate(parameter: Parameter, costs: Float[np.ndarray, "n values"]) -> Misfit:
    """The value of a parameter at which `n` observations agree best; its interval is a bootstrap's,
    which draws the observations anew."""
    values, mean = parameter.values, costs.mean(axis=0)
    # A fixed seed, so that a recording always has the same interval.
    drawn = np.random.default_rng(0).integers(len(costs), size=(_RESAMPLED, len(costs)))
    low, high = np.quantile(_lowest(values, costs[drawn].mean(axis=1)), _INTERVAL)
    gain = float(mean.min() / mean[np.abs(values).argmin()])  # by the mean at 0, as declared
    return Misfit(parameter, float(_lowest(values, mean)), low, high, gain)


def _lowest(
    values: Float[np.ndarray, "values"], costs: Float[np.ndarray, "*n values"]
) -> Float[np.ndarray, "*n"]:
    """The value at which costs are lowest, for each row of costs; values have equal steps.

    It is the minimum of the parabola through the lowest cost and those on both sides of it. If the
    lowest cost is the first or the last, it is the value itself.
    """
    at, last = costs.argmin(axis=-1), len(values) - 1
    around = np.clip(at[..., None] + [-1, 0, 1], 0, last)
    before, middle, after = np.moveaxis(np.take_along_axis(costs, around, axis=-1), -1, 0)
    bend = before - 2 * middle + after  # 0 where all three are equal: no parabola
    is_inside = (at > 0) & (at < last) & (bend > 0)
    offset = np.where(is_inside, (before - after) / 2 / np.where(is_inside, bend, 1), 0)
    return values[at] + offset * (values[1] - values[0])
