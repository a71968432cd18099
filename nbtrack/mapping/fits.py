"""Whether a map belongs to what a camera sees: its surface against measured depths."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nbtrack.core.camera import backproject
from nbtrack.core.errors import DataError
from nbtrack.core.geometry import transform_points
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField
from nbtrack.fields.views import render_rays
from nbtrack.mapping.seen_volume import SeenVolume

INLIER_ERROR = 0.1  # m: maps of a few minutes are off by some centimetres, other rooms by metres
_PIXELS = 1000
_FRAMES = 10
# Against what is usual in a map's own frames, a share of inliers below the first is refused, below
# the second told. Measured on six maps: frames of the same room, half of them looking where nothing
# was mapped, kept 0.69 of it and more; those of other rooms 0.50 and less.
_LEAST_SHARE, _GOOD_SHARE = 0.55, 0.8
# With less of the frame than this on surfaces that the map has seen, nothing holds the camera.
_LEAST_KNOWN = 0.05
# A map that shows its own frames less than this of what they saw is too poor to judge by.
_JUDGES = 0.2


@dataclass(frozen=True)
class MapFit:
    """How far the depths that a map predicts are from measured ones, where it has seen any."""

    known_ratio: float  # share of the pixels where the map's surface is one that was seen
    inlier_ratio: float  # share of these that are off by less than 10 cm
    median_error_m: float  # over these; infinite where there are none

    def __str__(self) -> str:
        if not self.known_ratio:
            return "nothing in view that the map has seen"
        return (
            f"median {self.median_error_m:.3f} m, {100 * self.inlier_ratio:.0f} % within "
            f"{100 * INLIER_ERROR:.0f} cm"
        )

    def to_dict(self) -> dict[str, float]:
        """The fields by name, for JSON."""
        return asdict(self)


def frame_fit(field: Field, seen: SeenVolume, sequence: RgbdSequence, index: int) -> MapFit | None:
    """How a map fits one frame at its given pose; None where nothing was measured.

    Depths of random pixels are compared with rendered ones wherever the rendered point lies where
    the map's own frames have seen a surface: an unmapped part of the room tells nothing. In a field
    that cannot be rendered all points count, by their distance to its surface.
    """
    errors, is_known = _errors(field, seen, sequence, index)
    if not len(errors):
        return None
    known = errors[is_known]
    if not len(known):
        return MapFit(0.0, 0.0, float("inf"))
    is_inlier = (known < INLIER_ERROR).float().mean()
    return MapFit(float(is_known.float().mean()), float(is_inlier), float(known.median()))


def usual_fit(
    field: Field, seen: SeenVolume, sequence: RgbdSequence, frames: Int[np.ndarray, "frames"]
) -> MapFit | None:
    """The median fit of some of the frames, evenly spread; None where the map shows nothing."""
    spread = np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames))).round().astype(int)
    found = [frame_fit(field, seen, sequence, i) for i in frames[spread].tolist()]
    fits = [list(fit.to_dict().values()) for fit in found if fit and fit.known_ratio]
    return MapFit(*np.median(fits, axis=0).tolist()) if fits else None


def warn_of_misfit(found: MapFit | None, usual: MapFit, map_name: str, frame: str) -> str | None:
    """One line about a map that fits a frame worse than it should; None where all is well.

    Raises:
        DataError: it fits so badly that tracking in it would be meaningless.
    """
    if found is None:
        return f"{frame} has no depth: whether {map_name} belongs to it cannot be told"
    if usual.known_ratio < _JUDGES:
        return f"{map_name} is too poor to tell whether it belongs to {frame}: map for longer"
    what = f"at its given pose {frame} is off {map_name} by: {found}; usual in this map: {usual}"
    share = found.inlier_ratio / max(usual.inlier_ratio, 1e-9)
    if share < _LEAST_SHARE or found.known_ratio < _LEAST_KNOWN * usual.known_ratio:
        raise DataError(
            f"{what}; it is a map of another scene, or the poses are in another world frame: give "
            "the room's own map, or poses in the map's frame"
        )
    return f"{what}; the room may have changed" if share < _GOOD_SHARE else None


def _errors(
    field: Field, seen: SeenVolume, sequence: RgbdSequence, index: int
) -> tuple[Float[Tensor, "n"], Tensor]:
    """How far (m) measured depths of random pixels are from the map's, and where it knows."""
    device = next(field.parameters()).device
    sampler = PixelSampler(sequence.select(slice(index, index + 1)), device)
    rows, columns = sampler.measured_pixels(0)
    drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:_PIXELS]
    rows, columns = rows[drawn], columns[drawn]
    rays = sampler.rays(torch.zeros_like(rows), rows, columns)
    if isinstance(field, LearnedField):
        depth = render_rays(field, rays.origins_world, rays.directions_world)[1]
        is_known = seen.contains(rays.points(depth[:, None])[:, 0].cpu())
        return (depth - rays.depth).abs().cpu(), is_known
    points_camera = backproject(sampler.intrinsics, columns, rows, rays.depth)
    with torch.no_grad():
        error = field(transform_points(sampler.T_world_camera[0], points_camera))[1].abs().cpu()
    return error, torch.ones(len(error), dtype=torch.bool)
