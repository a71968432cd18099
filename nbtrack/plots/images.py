"""What a camera saw beside what a field renders."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from nbtrack.data.frame import MILLIMETRE
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import View
from nbtrack.plots.style import WIDTH, new_axes, styled


@styled
def plot_frame(sequence: RgbdSequence, index: int = 0, title: str = "") -> Figure:
    """Colour and depth (m) of the frame at a position of a sequence; unmeasured pixels are grey.

    With a slider, where `fixed` is that of ipywidgets: `interact(plot_frame,
    sequence=fixed(sequence), index=(0, len(sequence) - 1), title=fixed("A room"))`.
    """
    some = sequence.depths_mm[:: 1 + len(sequence) // 20, ::4, ::4]  # one scale for all frames
    left, right = new_axes(title, 0.4 + 0.5 * _height(sequence), 1, 2)[0]
    _show(left, sequence.color(index), f"frame {sequence.frame_ids[index]}: colour")
    image = _show(right, _measured(sequence.depth(index)), "depth", MILLIMETRE * _most(some))
    right.figure.colorbar(image, ax=right, label="depth (m)", extend="max", aspect=25, pad=0.02)
    return right.figure


@styled
def plot_views(
    sequence: RgbdSequence, indices: Sequence[int], views: Sequence[View], title: str = ""
) -> Figure:
    """Observed and rendered colour and depth of some frames, one a row; unmeasured pixels grey.

    Depths (m) share one colour scale and errors (cm) another, cut at their 98 % quantiles, so
    that a few wild pixels do not hide the rest. `indices` are positions in the sequence, `views`
    what the field renders from the same poses.
    """
    depths = np.ma.stack([_measured(sequence.depth(index)) for index in indices])
    errors = 100 * np.abs(np.stack([view.depth for view in views]) - depths)
    far, worst = _most(depths), _most(errors)
    height = 0.9 + len(views) * (0.2 + 0.2 * _height(sequence))
    grid = new_axes(title, height, len(views), 5)
    for row, index, view, depth, error in zip(grid, indices, views, depths, errors, strict=True):
        _show(row[0], sequence.color(index), f"frame {sequence.frame_ids[index]}")
        _show(row[1], view.color, "rendered colour")
        _show(row[2], depth, "depth", far)
        depth_image = _show(row[3], view.depth, "rendered depth", far)
        error_image = _show(row[4], error, "|error|", worst, "magma")
    bars = {"location": "bottom", "pad": 0.02, "aspect": 30, "extend": "max"}
    depth_image.figure.colorbar(depth_image, ax=grid[:, 2:4], label="depth (m)", **bars)
    error_image.figure.colorbar(error_image, ax=grid[:, 4:], label="depth error (cm)", **bars)
    return error_image.figure


def _show(
    axes: Axes, image: np.ndarray, title: str, most: float | None = None, colors: str = "viridis"
) -> AxesImage:
    """An image without ticks, grid and frame; unknown pixels are grey."""
    axes.set_title(title)
    axes.set_axis_off()
    cmap = matplotlib.colormaps[colors].with_extremes(bad="#bdbdbd")
    return axes.imshow(image, cmap=cmap, vmin=0, vmax=most)


def _height(sequence: RgbdSequence) -> float:
    """Inches of an image as wide as a figure."""
    return WIDTH * sequence.intrinsics.height / sequence.intrinsics.width


def _measured(depth: np.ndarray) -> np.ma.MaskedArray:
    return np.ma.masked_equal(depth, 0)


def _most(images: np.ndarray) -> float:
    values = _measured(images).compressed()
    return float(np.quantile(values, 0.98)) if len(values) else 1.0
