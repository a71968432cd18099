"""What may be a little off in how a recording is read, fitted to its own surfaces.

Each cause is what happens: depth that comes after the poses, a camera beside what its poses are
of. Its few numbers are those under which surfaces of pairs of frames lie least apart (Gauss-Newton
with the weights of Geman and McClure). Their interval comes from drawing pairs anew (bootstrap).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbtrack.checks.readings import AREA_SCALE, FramePairs, Gaps, Reading, cost_of, mean_apart

_STEPS = 12  # of Gauss-Newton, at most
_FACTORS = (4.0, 2.0, 1.0, 0.5, 0.2)  # of a step; the best is taken
_WIDE = 5.0  # medians of the gaps: the scale of the weights in a step
_ENOUGH = 0.02  # of what is negligible: such a step is none
# Shares of the cost as declared that a cause may leave: a usual sensor's error, and another.
_USUAL_GAIN, _GAIN = 0.9, 0.75  # our choice
_ALIKE = 0.95  # ratio of two costs from which on they count as equal
_WHOLE = 0.8  # of the cost of a cause: where all numbers together leave less, it is not the whole
_RESAMPLED = 200  # draws of a bootstrap


class Number(NamedTuple):
    """How a number of a `Reading` is printed, and how large it may be."""

    label: str
    form: str  # format specification
    unit: str
    limit: float  # beyond which it is not looked for
    negligible: float  # our choice: more than right recordings show
    usual: float = 0.0  # up to this it is a note and no fault: usual sensors have such errors


_LENGTH, _ANGLE = ("+.3f", " m", 1.0, 0.02), ("+.1f", " deg", 30.0, 1.0)
_NUMBERS = {
    "late": Number("by ", "+.1f", " frames", 10.0, 0.3),
    "focal_share": Number("by ", "+.1%", "", 0.5, 0.01),
    "depth_share": Number("by ", "+.1%", "", 0.5, 0.01),
    # Structured light's; that of the paper's dataset is 0.0012, and is estimated as up to 0.0035.
    "depth_error_per_m": Number("of ", "+.5f", " per metre", 0.05, 5e-4, usual=4e-3),
    "depth_offset": Number("", "+.3f", " m", 0.5, 0.02),
    "right": Number("right by ", "+.1%", " of the width", 0.25, 0.005),
    "down": Number("down by ", "+.1%", " of the height", 0.25, 0.005),
    "aspect": Number("the vertical one more by ", "+.1%", "", 0.3, 0.01),
    **{axis: Number(f"{axis} ", *_LENGTH) for axis in "xyz"},
    **{f"turn_{axis}": Number(f"turned {axis} ", *_ANGLE) for axis in "xyz"},
}
# What may be off, and the numbers that say by how much. Those of fewer numbers first: of several
# that fit alike the first is named.
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
    """The estimate of a cause's numbers, with its interval of 95 %, and how surfaces then agree."""

    name: str
    reading: Reading  # with the estimate
    numbers: dict[str, tuple[float, float, float]]  # by key: estimate and ends of its interval
    apart: float  # by how much surfaces then lie apart in the mean, as a share of the depth
    # The cost, as a share of that without the numbers, or of that with the opposite numbers; the
    # larger share.
    gain: float

    @property
    def is_significant(self) -> bool:
        """Whether an interval is more than negligible, and surfaces agree better, within limits."""
        rows = [(_NUMBERS[key], *estimate) for key, estimate in self.numbers.items()]
        is_off = any(max(low, -high) > number.negligible for number, _, low, high in rows)
        is_within = all(abs(value) < number.limit for number, value, _, _ in rows)
        return is_off and is_within and self.gain < (_USUAL_GAIN if self.is_usual else _GAIN)

    @property
    def is_usual(self) -> bool:
        """Whether usual sensors have errors so large."""
        return all(abs(ends[0]) <= _NUMBERS[key].usual for key, ends in self.numbers.items())

    def __str__(self) -> str:
        texts = []
        for key, estimate in self.numbers.items():
            label, form, unit, *_ = _NUMBERS[key]
            value, low, high = (format(number, form) for number in estimate)
            texts.append(f"{label}{value} ({low} to {high}){unit}")
        return f"{self.name} {', '.join(texts)}"


def main_misfits(pairs: FramePairs, own: Reading, misfits: list[Misfit]) -> list[Misfit]:
    """The significant misfits that fit best, about equally well; the one of fewest numbers first.

    A misfit that only adds numbers to those of the first is left out. The list is empty where none
    is significant. It is empty too where all numbers together fit clearly better: then the cause is
    none of those that were tried.
    """
    significant = [misfit for misfit in misfits if misfit.is_significant]
    lowest = min((misfit.gain for misfit in significant), default=0.0)
    alike = [misfit for misfit in significant if _ALIKE * misfit.gain <= lowest]
    if not alike:
        return []
    first, *others = alike
    if fit(pairs, own, "all", list(_NUMBERS), first.reading).gain < _WHOLE * lowest:
        return []
    return [first, *(other for other in others if not first.numbers.keys() <= other.numbers.keys())]


def fit(
    pairs: FramePairs, own: Reading, name: str, keys: list[str], start: Reading | None = None
) -> Misfit:
    """Fit numbers of a reading, from those of `start`, by default from what is declared."""
    limit, small = np.array([(_NUMBERS[key].limit, _NUMBERS[key].negligible) for key in keys]).T

    def read(values: np.ndarray) -> Reading:
        return replace(own, **dict(zip(keys, values.tolist(), strict=True)))

    def gaps_at(values: np.ndarray) -> Gaps:
        return pairs.compare(read(values)).areas

    values = np.array([getattr(start or own, key) for key in keys])
    gaps = gaps_at(values)
    for _ in range(_STEPS):
        scale = _WIDE * float(np.nanmedian(np.abs(gaps)))
        # Steps are in units of what is negligible, so that all numbers are alike.
        H, g = _normal_equations(gaps, [gaps_at(values + unit) for unit in np.diag(small)], scale)
        step = _solution(H.sum(axis=0), g.sum(axis=0))
        tried = [(values + factor * small * step).clip(-limit, limit) for factor in _FACTORS]
        tried_gaps = [gaps_at(new) for new in tried]
        best = int(np.argmin([cost_of(new, scale) for new in tried_gaps]))
        is_small_step = (np.abs(tried[best] - values) < _ENOUGH * small).all()
        if is_small_step or cost_of(tried_gaps[best], scale) >= cost_of(gaps, scale):
            break
        values, gaps = tried[best], tried_gaps[best]
    H, g = _normal_equations(gaps, [gaps_at(values + unit) for unit in np.diag(small)], AREA_SCALE)
    # A fixed seed, so that a recording always has the same interval.
    drawn = np.random.default_rng(0).integers(len(H), size=(_RESAMPLED, len(H)))
    step = _solution(H.sum(axis=0), g.sum(axis=0))  # of all pairs; not quite 0
    deviations = _solution(H[drawn].sum(axis=1), g[drawn].sum(axis=1)) - step
    low, high = values + small * np.quantile(deviations, [0.025, 0.975], axis=0)
    # Where the opposite numbers fit as well, the cause is another one: a `late` of either sign
    # interpolates the poses, for example, which may help by itself.
    gain = max(_ratio(gaps, gaps_at(0 * values)), _ratio(gaps, gaps_at(-values)))
    estimates = np.stack([values, low, high], axis=1)
    numbers = dict(zip(keys, map(tuple, estimates.tolist()), strict=True))
    return Misfit(name, read(values), numbers, mean_apart(gaps), gain)


def _solution(
    H: Float[np.ndarray, "... k k"], g: Float[np.ndarray, "... k"]
) -> Float[np.ndarray, "... k"]:
    """The k numbers that solve normal equations; those that no equation determines are 0."""
    return -(np.linalg.pinv(H, rcond=1e-6, hermitian=True) @ g[..., None])[..., 0]


def _normal_equations(
    gaps: Gaps, moved: list[Gaps], scale: float
) -> tuple[Float[np.ndarray, "pairs k k"], Float[np.ndarray, "pairs k"]]:
    """The weighted J J^T and J gaps of each pair of frames.

    `moved` are k gaps: in each, another one of the k numbers is larger by a unit.
    """
    J = np.stack(moved) - gaps  # (k, pairs, areas)
    is_known = np.isfinite(J).all(axis=0) & np.isfinite(gaps)
    weights = np.where(is_known, 1 / (1 + (gaps / scale) ** 2) ** 2, 0)
    J, gaps = np.nan_to_num(J), np.nan_to_num(gaps)
    H = np.einsum("ipa,jpa,pa->pij", J, J, weights)
    return H, np.einsum("ipa,pa,pa->pi", J, gaps, weights)


def _ratio(gaps: Gaps, others: Gaps) -> float:
    """The cost of some gaps as a share of that of others, over areas that are known in both."""
    is_known = np.isfinite(gaps) & np.isfinite(others)
    return cost_of(gaps[is_known]) / cost_of(others[is_known])
