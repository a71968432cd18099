"""Small misfits of a recording, estimated: how late, how much too long, how far off.

One number at a time is varied. Under each of its values the surfaces that pairs of frames see lie
so far apart, and the intensities of their common points are so unlike. The value where they agree
best is the estimate; its interval comes from drawing the pairs anew (bootstrap).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter1d
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.core.arrays import Poses
from nbtrack.data.sequence import RgbdSequence
from nbtrack.recordings.conventions import Convention, Pairs, depth_differences, read_pairs

MAX_SHIFT = 3  # frames by which depth or colours may be late or early (our choice)
_SHARES = np.linspace(-0.15, 0.15, 13)  # by which lengths may be off
_METRES = np.linspace(-0.6, 0.6, 13)  # by which poses may drift along an axis, over the recording
_PIXELS = np.linspace(-0.06, 0.06, 13)  # by which colours may be off, as a share of the width
_FRAMES = np.arange(-MAX_SHIFT, MAX_SHIFT + 1)
_SCATTER = np.linspace(-0.02, 0.04, 13)  # m, by which positions may scatter; below 0 for symmetry
_SMOOTHED = 5  # frames, over which positions are averaged
_GAIN = 0.98  # share of the cost as declared, above which an estimate tells nothing (our choice)
_MIN_OVERLAP, _MIN_PAIRS = 0.1, 8  # a share of points, and pairs with as many, as an estimate needs
MIN_CORRELATION = 0.75  # of intensities that pairs of a right recording have (our choice)
_MIN_CONTRAST = 0.02  # standard deviation of intensities in [0, 1], below which nothing is seen
_RESAMPLED, _INTERVAL = 200, [0.025, 0.975]


class Reading(NamedTuple):
    """How the frames of a recording are read."""

    convention: Convention
    T_world_camera: Poses  # of all frames that have one
    depth_shift: int = 0  # frames by which depth is late
    depth_growth: float = 0.0  # share by which they are longer in the end than at first
    color_shift: int = 0  # frames by which colours are late
    color_right: float = 0.0  # by which colours are too far right, as a share of the width
    is_mirrored: bool = False  # colours alone


class Parameter(NamedTuple):
    """A number that is varied; 0 is as declared."""

    name: str
    form: str  # how its estimate is written, and in which unit; empty for yes or no
    unit: str
    advice: str  # with {factor}, 1 + estimate
    values: Float[np.ndarray, "values"]
    negligible: float  # our choice: more than right recordings show
    reading: Callable[[Reading, float], Reading]


@dataclass(frozen=True)
class Misfit:
    """The estimate of a parameter, with its interval of 95 %."""

    parameter: Parameter
    estimate: float
    low: float
    high: float
    gain: float  # the cost at the estimate, as a share of that as declared

    @property
    def is_told(self) -> bool:
        """Whether all of the interval is more than negligible, and frames agree better there."""
        negligible = self.parameter.negligible
        return (self.low > negligible or self.high < -negligible) and self.gain < _GAIN

    def __str__(self) -> str:
        name, form, unit, *_ = self.parameter
        if not form:
            return f"{name}: {'yes' if self.is_told else 'no'}"
        estimate, low, high = (form.format(x) for x in (self.estimate, self.low, self.high))
        return f"{name} {estimate} ({low} to {high}) {unit}".rstrip()


def _with_scale(reading: Reading, share: float) -> Reading:
    declared = reading.convention.declared
    declared = replace(declared, depth_scale=declared.depth_scale / (1 + share))
    return reading._replace(convention=replace(reading.convention, declared=declared))


def _with_focal(reading: Reading, share: float) -> Reading:
    camera = reading.convention.camera
    camera = replace(camera, fx=camera.fx * (1 + share), fy=camera.fy * (1 + share))
    return reading._replace(convention=replace(reading.convention, camera=camera))


def _without_drift(reading: Reading, metres: float, axis: int) -> Reading:
    T = reading.T_world_camera.copy()
    T[:, axis, 3] -= metres * np.linspace(0, 1, len(T))
    return reading._replace(T_world_camera=T)


def _without_scatter(reading: Reading, metres: float) -> Reading:
    """Positions moved towards their averages over neighbours, by so much in the mean square."""
    T = reading.T_world_camera.copy()
    off = T[:, :3, 3] - uniform_filter1d(T[:, :3, 3], _SMOOTHED, axis=0, mode="nearest")
    T[:, :3, 3] -= metres * off / np.maximum(1e-9, np.sqrt((off**2).sum(axis=1).mean()))
    return reading._replace(T_world_camera=T)


_POSES = "record or register the poses anew"
DEPTH_PARAMETERS = [
    Parameter(
        "depth comes after the poses by", "{:+.1f}", "frames",
        "shift one of them against the other", _FRAMES, 0.3,
        lambda reading, frames: reading._replace(depth_shift=int(frames)),
    ),
    Parameter(
        "focal lengths should change by", "{:+.1%}", "",
        "calibrate anew, or multiply them by {factor:.3f}", _SHARES, 0.01, _with_focal,
    ),
    Parameter(
        "depths should change against the poses by", "{:+.1%}", "",
        "divide depth_scale, or the positions, by {factor:.3f}", _SHARES, 0.01, _with_scale,
    ),
    Parameter(
        "depths grow over the recording by", "{:+.1%}", "",
        "let the camera warm up before recording", _SHARES, 0.02,
        lambda reading, share: reading._replace(depth_growth=share),
    ),
    *(
        Parameter(
            f"poses drift along {'xyz'[axis]} by", "{:+.2f}", "m", _POSES, _METRES, 0.1,
            lambda reading, metres, axis=axis: _without_drift(reading, metres, axis),
        )
        for axis in range(3)
    ),
    Parameter(
        "positions scatter by", "{:.3f}", "m", _POSES, _SCATTER, 5e-3, _without_scatter
    ),
]  # fmt: skip
COLOR_PARAMETERS = [
    Parameter(
        "colours come after depth by", "{:+.1f}", "frames",
        "shift one against the other", _FRAMES, 0.5,
        lambda reading, frames: reading._replace(color_shift=int(frames)),
    ),
    Parameter(
        "colours lie too far right by", "{:+.1%}", "of the width",
        "register colour and depth anew", _PIXELS, 0.01,
        lambda reading, share: reading._replace(color_right=share),
    ),
    Parameter(
        "colours alone are mirrored", "", "", "mirror them back", np.arange(2.0), 0.5,
        lambda reading, value: reading._replace(is_mirrored=bool(value)),
    ),
]  # fmt: skip


def find_misfits(
    sequence: RgbdSequence,
    T_world_camera: Poses,
    numbers: Int[np.ndarray, "2 pairs"],
    places: Int[np.ndarray, "2 pairs"],
    own: Convention,
) -> tuple[list[Misfit], float]:
    """Misfits that pairs of frames can tell, whether there or not, and how alike their colours are:
    the correlation of intensities of points that both see, NaN without contrast.

    Pairs are numbers of poses, and the places of their frames in a sequence with depth as in the
    files; it holds the frames up to MAX_SHIFT around them too. Misfits of colours are looked for
    where depth is right.
    """
    if not numbers.size:
        return [], math.nan
    frames = _PairedFrames(sequence, T_world_camera, numbers, places, own)
    found = [_estimate(p, frames.declared, frames.depth_cost) for p in DEPTH_PARAMETERS]
    correlation = frames.correlation()
    if not any(misfit.is_told for misfit in found if misfit):
        colors = [_estimate(p, frames.declared, frames.color_cost) for p in COLOR_PARAMETERS]
        # What leaves them unlike is none: they are of another place.
        least = (1 - MIN_CORRELATION) / max(1e-9, 1 - correlation)
        found += [misfit for misfit in colors if misfit and misfit.gain < least]
    return [misfit for misfit in found if misfit], correlation


def told_misfit(misfits: list[Misfit]) -> str:
    """A sentence on the one that explains the most; empty where none is told."""
    told = min((m for m in misfits if m.is_told), key=lambda m: m.gain, default=None)
    if not told:
        return ""
    advice = told.parameter.advice.format(factor=1 + told.estimate)
    return f"{told}; without it frames differ {told.gain:.0%} as much: {advice}"


class _PairedFrames:
    """Pairs of frames that see much the same, and how well they agree as a recording is read."""

    def __init__(self, sequence, T_world_camera, numbers, places, own) -> None:
        """See `find_misfits`."""
        self.colors, self.numbers, self.places = sequence.colors, numbers, places
        self.declared = Reading(own, T_world_camera)
        self.pairs: Pairs = read_pairs(sequence.depths_mm[places])
        relative, counts, self.seen_at = self._relative(self.declared)
        self.scale = 3 * relative[counts].abs().median()
        self.agree = counts & (relative.abs() < self.scale)

    def correlation(self) -> float:
        """The median over pairs of the correlation of intensities; NaN without contrast."""
        costs = self.color_cost(self.declared)
        return float(1 - np.nanmedian(costs)) if np.isfinite(costs).any() else math.nan

    def _relative(self, reading: Reading) -> tuple[Tensor, Tensor, Tensor]:
        """Differences of depth as a share of it, whether points count, and where they are seen."""
        growth = reading.depth_growth * (self.numbers / len(reading.T_world_camera) - 0.5)
        growth_a, growth_b = torch.from_numpy(1 + growth).float()
        pairs = self.pairs._replace(
            values=self.pairs.values / growth_a[:, None],
            inverse=self.pairs.inverse * growth_b[:, None, None, None],
        )
        T = reading.T_world_camera[self.numbers - reading.depth_shift]
        apart, measured, counts, at = depth_differences(pairs, reading.convention, *T)
        return apart / measured, counts, at

    def depth_cost(self, reading: Reading) -> Float[np.ndarray, "pairs"]:
        """Geman-McClure's of the differences; NaN of pairs that see little of the same."""
        relative, counts, _ = self._relative(reading)
        square = (relative / self.scale) ** 2
        total = torch.where(counts, square / (1 + square), 0.0).sum(dim=1)
        enough = counts.sum(dim=1) >= _MIN_OVERLAP * counts.shape[1]
        return torch.where(enough, total / counts.sum(dim=1), torch.nan).numpy()

    def color_cost(self, reading: Reading) -> Float[np.ndarray, "pairs"]:
        """1 - the correlation of intensities of points whose depths agree; exposures may differ."""
        width = self.colors.shape[2]
        columns = self.pairs.columns + reading.color_right * width
        rows, last, at = self.pairs.rows, width - 1, self.seen_at.clone()
        at[..., 0] += 2 * reading.color_right
        if reading.is_mirrored:
            columns = last - columns
            at[..., 0] *= -1
        first, second = torch.from_numpy(self._intensities(reading.color_shift))
        seen = grid_sample(second[:, None], at, "bilinear", align_corners=True)[:, 0, 0]
        own = first[:, rows, columns.round().long().clamp(0, last)]
        mask = self.agree & (at.abs() <= 1).all(dim=-1)[:, 0]
        return 1 - _correlations(own, seen, mask)

    def _intensities(self, shift: int) -> Float[np.ndarray, "2 pairs height width"]:
        """Intensities of both frames of pairs, in [0, 1], or of those that come so much later."""
        gray = [
            cv2.cvtColor(self.colors[i], cv2.COLOR_RGB2GRAY) for i in self.places.ravel() + shift
        ]
        return np.stack(gray).reshape(*self.numbers.shape, *gray[0].shape).astype(np.float32) / 255


def _correlations(a: Tensor, b: Tensor, mask: Tensor) -> Float[np.ndarray, "pairs"]:
    """A correlation a row of the values where the mask is; NaN of few, or without contrast."""
    n = mask.sum(dim=1, keepdim=True)
    a, b = (torch.where(mask, x - torch.where(mask, x, 0.0).sum(1, True) / n, 0.0) for x in (a, b))
    variances = torch.stack([(x**2).sum(dim=1) for x in (a, b)]) / n[:, 0]
    enough = (n[:, 0] >= _MIN_OVERLAP * mask.shape[1]) & (variances > _MIN_CONTRAST**2).all(dim=0)
    correlation = (a * b).sum(dim=1) / n[:, 0] / variances.prod(dim=0).sqrt()
    return torch.where(enough, correlation, torch.nan).numpy()


def _estimate(
    parameter: Parameter,
    declared: Reading,
    cost: Callable[[Reading], Float[np.ndarray, "pairs"]],
) -> Misfit | None:
    """The value where pairs agree best; None if too few see enough of the same at all values."""
    values = parameter.values
    costs = np.stack([cost(parameter.reading(declared, value)) for value in values], axis=1)
    costs = costs[np.isfinite(costs).all(axis=1)]
    if len(costs) < _MIN_PAIRS:
        return None
    drawn = np.random.default_rng(0).integers(len(costs), size=(_RESAMPLED, len(costs)))
    low, high = np.quantile(_lowest(values, costs[drawn].mean(axis=1)), _INTERVAL)
    mean = costs.mean(axis=0)
    estimate = float(_lowest(values, mean))
    gain = float(mean.min() / mean[np.abs(values).argmin()])
    return Misfit(parameter, estimate, low, high, gain)


def _lowest(
    values: Float[np.ndarray, "values"], costs: Float[np.ndarray, "*n values"]
) -> Float[np.ndarray, "*n"]:
    """The place of the lowest of costs at equal steps, by a parabola through three of them."""
    at = costs.argmin(axis=-1)
    inner = at.clip(1, max(1, len(values) - 2))
    around = np.stack([inner - 1, inner, inner + 1], axis=-1).clip(0, len(values) - 1)
    before, middle, after = np.moveaxis(np.take_along_axis(costs, around, axis=-1), -1, 0)
    bend = before - 2 * middle + after
    is_inside = (at == inner) & (len(values) > 2) & (bend > 0)
    offset = np.where(is_inside, (before - after) / 2 / np.where(is_inside, bend, 1), 0)
    return values[at] + offset * (values[1] - values[0])
