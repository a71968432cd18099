"""What may be a little off in how a recording is read, fitted to its own surfaces.

Each cause is what happens: depth that comes after the poses, a camera beside what its poses are
of. Its few numbers are those under which surfaces of pairs of frames lie least apart (Gauss-Newton
with the weights of Geman and McClure). Their interval comes from drawing pairs anew (bootstrap).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbtrack.checks.readings import AREA_SCALE, Apart, FramePairs, Reading, cost_of, mean_apart

_STEPS = 12  # of Gauss-Newton, at most
_FACTORS = (4.0, 2.0, 1.0, 0.5, 0.2)  # of a step; the best is taken
_WIDE = 5.0  # medians of what lies apart; so far away half of the weight is left
_ENOUGH = 0.02  # of what is negligible: a last step
# Shares of the cost as declared that a cause may leave: a usual sensor's error, and another.
_USUAL_GAIN, _GAIN = 0.9, 0.75  # our choice
_ALIKE = 0.95  # of two costs: they tell nothing
_WHOLE = 0.8  # of the cost of a cause: where all numbers together leave less, it is not the whole
_RESAMPLED = 200  # draws of a bootstrap
_INTERVAL = [0.025, 0.975]  # its quantiles


class Number(NamedTuple):
    """How a number of a `Reading` is told, and how large it may be."""

    label: str
    form: str  # format specification
    unit: str
    limit: float  # beyond which it is not looked for
    negligible: float  # our choice: more than right recordings show
    usual: float = 0.0  # so much is told, but is no fault: usual sensors have it


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
    gain: float  # the cost, as a share of that as declared, or that of the opposite if it is less

    @property
    def is_significant(self) -> bool:
        """Whether an interval is more than negligible, and surfaces agree better, within limits."""
        told = [(_NUMBERS[key], *ends) for key, ends in self.numbers.items()]
        is_off = any(max(low, -high) > number.negligible for number, _, low, high in told)
        is_within = all(abs(value) < number.limit for number, value, _, _ in told)
        return is_off and is_within and self.gain < (_USUAL_GAIN if self.is_usual else _GAIN)

    @property
    def is_usual(self) -> bool:
        """Whether usual sensors have errors so large."""
        return all(abs(ends[0]) <= _NUMBERS[key].usual for key, ends in self.numbers.items())

    def __str__(self) -> str:
        said = []
        for key, ends in self.numbers.items():
            label, form, unit, *_ = _NUMBERS[key]
            value, low, high = (format(end, form) for end in ends)
            said.append(f"{label}{value} ({low} to {high}){unit}")
        return f"{self.name} {', '.join(said)}"


def main_misfits(pairs: FramePairs, own: Reading, misfits: list[Misfit]) -> list[Misfit]:
    """Of the significant misfits the one that explains what there is, and what fits as well.

    Empty where none is, or where all numbers together leave clearly less: then what happens is
    something else. Of those that fit alike the first stands first, and one whose numbers another
    has among more is left out.
    """
    found = [misfit for misfit in misfits if misfit.is_significant]
    lowest = min((misfit.gain for misfit in found), default=0.0)
    alike = [misfit for misfit in found if _ALIKE * misfit.gain <= lowest]
    if not alike:
        return []
    together = fit(pairs, own, "all", list(_NUMBERS), alike[0].reading)
    if together.gain < _WHOLE * lowest:
        return []
    return [m for m in alike if m is alike[0] or not alike[0].numbers.keys() <= m.numbers.keys()]


def fit(
    pairs: FramePairs, own: Reading, name: str, keys: list[str], start: Reading | None = None
) -> Misfit:
    """Fit numbers of a reading, from those of `start`, by default from what is declared."""
    limit, small = np.array([(_NUMBERS[key].limit, _NUMBERS[key].negligible) for key in keys]).T

    def read(values: np.ndarray) -> Reading:
        return replace(own, **dict(zip(keys, values.tolist(), strict=True)))

    def apart_at(values: np.ndarray) -> Apart:
        return pairs.compare(read(values)).areas

    values = np.array([getattr(start or own, key) for key in keys])
    apart = apart_at(values)
    for _ in range(_STEPS):
        scale = _WIDE * float(np.nanmedian(np.abs(apart)))
        # Steps are in units of what is negligible, so that all numbers are alike.
        moved = [apart_at(values + d) for d in np.diag(small)]
        step = _solution(*(each.sum(axis=0) for each in _normal_equations(apart, moved, scale)))
        tried = [(values + factor * small * step).clip(-limit, limit) for factor in _FACTORS]
        aparts = [apart_at(new) for new in tried]
        best = int(np.argmin([cost_of(a, scale) for a in aparts]))
        if cost_of(aparts[best], scale) >= cost_of(apart, scale):
            break
        is_near = (np.abs(tried[best] - values) < _ENOUGH * small).all()
        values, apart = tried[best], aparts[best]
        if is_near:
            break
    H, g = _normal_equations(apart, [apart_at(values + d) for d in np.diag(small)], AREA_SCALE)
    # A fixed seed, so that a recording always has the same interval.
    drawn = np.random.default_rng(0).integers(len(H), size=(_RESAMPLED, len(H)))
    left = _solution(H.sum(axis=0), g.sum(axis=0))
    steps = _solution(H[drawn].sum(axis=1), g[drawn].sum(axis=1)) - left
    low, high = values + small * np.quantile(steps, _INTERVAL, axis=0)
    # Where the opposite does as well, what helps is something else, as an average of poses.
    others = [apart_at(0 * values), apart_at(-values)]
    gain = max(_ratio(apart, other) for other in others)
    ends = np.stack([values, low, high], axis=1)
    numbers = dict(zip(keys, map(tuple, ends.tolist()), strict=True))
    return Misfit(name, read(values), numbers, mean_apart(apart), gain)


def _solution(
    H: Float[np.ndarray, "... k k"], g: Float[np.ndarray, "... k"]
) -> Float[np.ndarray, "... k"]:
    """The k numbers of normal equations; what nothing tells is 0."""
    return -(np.linalg.pinv(H, rcond=1e-6, hermitian=True) @ g[..., None])[..., 0]


def _normal_equations(
    apart: Apart, moved: list[Apart], scale: float
) -> tuple[Float[np.ndarray, "pairs k k"], Float[np.ndarray, "pairs k"]]:
    """Those of each pair; `moved` is what lies apart where one of k numbers is a unit more."""
    J = np.stack(moved) - apart
    is_known = np.isfinite(J).all(axis=0) & np.isfinite(apart)
    weights = np.where(is_known, 1 / (1 + (apart / scale) ** 2) ** 2, 0)
    J, apart = np.nan_to_num(J), np.nan_to_num(apart)
    H = np.einsum("ipa,jpa,pa->pij", J, J, weights)
    return H, np.einsum("ipa,pa,pa->pi", J, apart, weights)


def _ratio(apart: Apart, other: Apart) -> float:
    """The cost of one as a share of that of another, by areas that both know."""
    is_known = np.isfinite(apart) & np.isfinite(other)
    return cost_of(apart[is_known]) / cost_of(other[is_known])
