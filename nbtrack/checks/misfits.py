"""Small errors in how a recording is read, estimated from its own depth maps.

A cause is something that may be off, such as depth that comes after its poses, or a camera that
lies beside the body whose poses are given. It has one to six numbers. They are fitted so that the
surfaces of pairs of frames have the smallest gaps, by Gauss-Newton with the weights of Geman and
McClure. A bootstrap over the pairs gives an interval of each number.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbtrack.checks.readings import AREA_SCALE, FramePairs, Gaps, Reading, cost_of, mean_apart
from nbtrack.machinery.progress import ProgressBar

_STEPS = 12  # of Gauss-Newton, at most
# A fit of one number may begin at these shares of its limit, if more than _MORE times as many areas
# agree there as at the declared number. An area agrees by half at the gap _NEAR, a share of the
# depth (our choice).
_STARTS = np.linspace(-0.9, 0.9, 8)
_MORE = 1.2
_NEAR = 0.02
_FACTORS = (4.0, 2.0, 1.0, 0.5, 0.2)  # a step is tried at these lengths, and the best is taken
_WIDE = 5.0  # in a step the weights' scale is so many medians of the absolute gaps
_ENOUGH = 0.02  # a step ends the fit if it changes each number by less than this x negligible
# A cause is significant if it leaves less than this share of the declared reading's cost.
_MAX_COST_LEFT = 0.75  # our choice
_MAX_COST_LEFT_USUAL = 0.9  # our choice, for errors that usual sensors have
_ALIKE = 0.95  # two costs count as equal if their ratio is at least this
# No single cause explains the recording if a fit of all numbers at once leaves clearly less cost
# than the best cause: less than _WHOLE times as much, and less by more than _CLEARLY (our choice).
# The second condition is for costs near 0, of which a share says nothing.
_WHOLE, _CLEARLY = 0.8, 0.05
_RESAMPLED = 200  # draws of the bootstrap
Hessians = Float[np.ndarray, "... k k"]
Gradients = Float[np.ndarray, "... k"]


class Number(NamedTuple):
    """How a number of a `Reading` is printed, and how large it may be."""

    label: str
    form: str  # format specification
    unit: str
    limit: float  # the fit clips the number to -limit and limit; an estimate there says nothing
    negligible: float  # right recordings show estimates below this (our choice)
    usual: float = 0.0  # usual sensors have errors up to this size: they are a note, not a fault


_LENGTH, _ANGLE = ("+.3f", " m", 1.0, 0.02), ("+.1f", " deg", 30.0, 1.0)
_NUMBERS = {
    "late": Number("by ", "+.1f", " frames", 10.0, 0.3),
    "focal_share": Number("by ", "+.1%", "", 0.5, 0.01),
    "depth_share": Number("by ", "+.1%", "", 0.8, 0.01),
    # Sensors with structured light have this error. In the paper's dataset it is 0.0012, and the
    # estimates are up to 0.0038 (docs/tried.md).
    "depth_error_per_m": Number("of ", "+.5f", " per metre", 0.015, 5e-4, usual=4e-3),
    "depth_offset": Number("", "+.3f", " m", 0.5, 0.02),
    "right": Number("right by ", "+.1%", " of the width", 0.25, 0.005),
    "down": Number("down by ", "+.1%", " of the height", 0.25, 0.005),
    "aspect": Number("the vertical one more by ", "+.1%", "", 0.3, 0.01),
    **{axis: Number(f"{axis} ", *_LENGTH) for axis in "xyz"},
    **{f"turn_{axis}": Number(f"turned {axis} ", *_ANGLE) for axis in "xyz"},
}
# What may be off, and the numbers of a `Reading` that say by how much. Causes with fewer numbers
# come first: `main_misfits` relies on this order, since it names the first of those that fit alike.
CAUSES = {
    "depth comes after the poses": ["late"],
    "focal lengths should change": ["focal_share"],
    "depths should change against the poses": ["depth_share"],
    "depths are short by a quadratic error": ["depth_error_per_m"],
    "depths are short by one length": ["depth_offset"],
    "the principal point should move": ["right", "down"],
    "the calibration is another camera's: focal lengths should change":
        ["focal_share", "aspect", "right", "down"],
    "the camera lies beside what the poses are of,": ["x", "y", "z", "turn_x", "turn_y", "turn_z"],
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Misfit:
    """A fitted cause: its numbers with intervals of 95 %, and how surfaces then agree."""

    name: str
    reading: Reading  # with the estimated numbers
    numbers: dict[str, tuple[float, float, float]]  # by key: estimate, low and high end of interval
    apart: float  # the mean absolute gap under `reading`, as a share of the depth
    # Smaller is better: the cost under `reading`, divided by the smaller one of two other costs.
    # These are the costs with the numbers at 0, and with the opposite numbers.
    cost_left: float

    @property
    def is_significant(self) -> bool:
        """Whether the cause is surely there, and explains much of the cost.

        It is surely there if the whole interval of any number is farther from 0 than what is
        negligible. All estimates must be within their limits.
        """
        rows = [(_NUMBERS[key], *estimate) for key, estimate in self.numbers.items()]
        # An interval above 0 begins at `low`; one below 0 begins at `high`, which is negative.
        is_off = any(max(low, -high) > number.negligible for number, _, low, high in rows)
        is_within = all(abs(value) < number.limit for number, value, _, _ in rows)
        max_cost_left = _MAX_COST_LEFT_USUAL if self.is_usual else _MAX_COST_LEFT
        return is_off and is_within and self.cost_left < max_cost_left

    @property
    def is_usual(self) -> bool:
        """Whether usual sensors have errors as large as the estimates."""
        return all(abs(value) <= _NUMBERS[key].usual for key, (value, _, _) in self.numbers.items())

    def __str__(self) -> str:
        texts = []
        for key, estimate in self.numbers.items():
            label, form, unit, *_ = _NUMBERS[key]
            value, low, high = (format(number, form) for number in estimate)
            texts.append(f"{label}{value} ({low} to {high}){unit}")
        return f"{self.name} {', '.join(texts)}"


def main_misfits(pairs: FramePairs, as_declared: Reading, misfits: list[Misfit]) -> list[Misfit]:
    """The misfits that explain the recording about equally well: significant, with the least cost.

    They are in the order of `misfits`, which must be that of `CAUSES`, so that the first one has
    the fewest numbers. Misfits that only add numbers to those of the first are left out.

    The list is empty if no misfit is significant. It is also empty if all numbers, fitted at once,
    leave clearly less cost: then none of the causes explains the recording.
    """
    significant = [misfit for misfit in misfits if misfit.is_significant]
    if not significant:
        return []
    lowest = min(misfit.cost_left for misfit in significant)
    first, *others = (m for m in significant if _ALIKE * m.cost_left <= lowest)
    all_numbers = fit(pairs, as_declared, "all", list(_NUMBERS), start=first.reading)
    if all_numbers.cost_left < min(_WHOLE * lowest, lowest - _CLEARLY):
        return []
    return [first, *(other for other in others if not first.numbers.keys() <= other.numbers.keys())]


def fit_causes(pairs: FramePairs, as_declared: Reading) -> list[Misfit]:
    """Fit each of `CAUSES` alone, beginning at the declared numbers."""
    causes = ProgressBar("fitting", CAUSES.items())
    return [fit(pairs, as_declared, name, keys, start=as_declared) for name, keys in causes]


def fit(
    pairs: FramePairs, as_declared: Reading, name: str, keys: list[str], start: Reading
) -> Misfit:
    """Fit the numbers `keys` of the cause `name`, while all others stay as declared.

    `keys` are names of attributes of a `Reading`. The fit begins at the numbers that the reading
    `start` has. Each Gauss-Newton step is tried at several lengths, and the scale of its weights
    follows the gaps.
    """
    # The unit of a number is what is negligible of it, so that all steps are of similar size.
    limit, unit = np.array([(_NUMBERS[key].limit, _NUMBERS[key].negligible) for key in keys]).T

    def read(values: np.ndarray) -> Reading:
        return replace(as_declared, **dict(zip(keys, values.tolist(), strict=True)))

    def gaps_at(values: np.ndarray) -> Gaps:
        return pairs.compare(read(values)).area_gaps

    values = _best_start(np.array([getattr(start, key) for key in keys]), limit, gaps_at)
    gaps = gaps_at(values)
    for _ in range(_STEPS):
        scale = max(1e-6, _WIDE * float(np.nanmedian(np.abs(gaps))))  # equal frames have no gaps
        H, g = _normal_equations(gaps, [gaps_at(values + move) for move in np.diag(unit)], scale)
        step = _solution(H.sum(axis=0), g.sum(axis=0))
        tried = [(values + factor * unit * step).clip(-limit, limit) for factor in _FACTORS]
        tried_gaps = [gaps_at(new) for new in tried]
        best = int(np.argmin([cost_of(new, scale) for new in tried_gaps]))
        is_small_step = (np.abs(tried[best] - values) < _ENOUGH * unit).all()
        if is_small_step or cost_of(tried_gaps[best], scale) >= cost_of(gaps, scale):
            break
        values, gaps = tried[best], tried_gaps[best]
    H, g = _normal_equations(gaps, [gaps_at(values + move) for move in np.diag(unit)], AREA_SCALE)
    low, high = values + unit * _interval(H, g)
    # If the opposite numbers fit as well, the cause is another one. For example `late` interpolates
    # poses, which smooths them, whatever its sign is.
    without, opposite = gaps_at(0 * values), gaps_at(-values)
    cost_left = max(_cost_ratio(gaps, without), _cost_ratio(gaps, opposite))
    intervals = zip(values.tolist(), low.tolist(), high.tolist(), strict=True)
    numbers = dict(zip(keys, intervals, strict=True))
    return Misfit(name, read(values), numbers, mean_apart(gaps), cost_left)


def _best_start(values: np.ndarray, limit: np.ndarray, gaps_at: Callable) -> np.ndarray:
    """The numbers at which a fit begins: `values`, or the best of `_STARTS` if clearly better.

    Gauss-Newton finds nothing if it begins far off. `_STARTS` are tried only if `values` is a
    single number, and are clearly better if more than `_MORE` times as many areas agree.
    """
    starts = [values, *_STARTS[:, None] * limit] if len(values) == 1 else [values]
    # Unknown gaps are NaN, and so `nansum` takes their areas for areas that do not agree.
    agreeing = [np.nansum(1 / (1 + (gaps_at(tried) / _NEAR) ** 2)) for tried in starts]
    most = int(np.argmax(agreeing))
    return starts[most] if agreeing[most] > _MORE * agreeing[0] else values


def _interval(H: Hessians, g: Gradients) -> Float[np.ndarray, "2 k"]:
    """Ends of the interval of 95 %, less the estimate, by a bootstrap over pairs of frames.

    Both are in the units of the fit. `H` and `g` are the normal equations of each pair at the
    estimate.
    """
    # The seed is fixed, so that a recording always has the same interval.
    drawn = np.random.default_rng(0).integers(len(H), size=(_RESAMPLED, len(H)))
    deviations = _solution(H[drawn].sum(axis=1), g[drawn].sum(axis=1))
    deviations -= _solution(H.sum(axis=0), g.sum(axis=0))  # the step of all pairs is not quite 0
    return np.quantile(deviations, [0.025, 0.975], axis=0)


def _solution(H: Hessians, g: Gradients) -> Gradients:
    """The steps (... x k) that solve H step = -g. They are 0 along undetermined directions."""
    return -(np.linalg.pinv(H, rcond=1e-6, hermitian=True) @ g[..., None])[..., 0]


def _normal_equations(gaps: Gaps, moved: list[Gaps], scale: float) -> tuple[Hessians, Gradients]:
    """H = J W J' and g = J W gaps of each pair of frames, with Geman-McClure weights W at `scale`.

    The Jacobian J is by finite differences: `moved` holds the gaps after each of the k numbers, one
    at a time, has grown by its unit.
    """
    J = np.stack(moved) - gaps  # (k, pairs, areas)
    is_known = np.isfinite(J).all(axis=0) & np.isfinite(gaps)
    weights = np.where(is_known, 1 / (1 + (gaps / scale) ** 2) ** 2, 0)
    J, gaps = np.nan_to_num(J), np.nan_to_num(gaps)
    H = np.einsum("ipa,jpa,pa->pij", J, J, weights)
    return H, np.einsum("ipa,pa,pa->pi", J, gaps, weights)


def _cost_ratio(gaps: Gaps, others: Gaps) -> float:
    """The cost of `gaps` divided by that of `others`, over the areas that are known in both."""
    is_known = np.isfinite(gaps) & np.isfinite(others)
    return cost_of(gaps[is_known]) / cost_of(others[is_known])
