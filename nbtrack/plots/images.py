"""Pictures of what a camera saw beside what a field renders, and of a sequence as a whole."""

from collections.abc import Iterable
from collections.abc import Sequence as Many

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from scipy.spatial.transform import Rotation

from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.views import View
from nbtrack.plots.style import NOT_MEASURED, WIDTH, bare, new_figure, styled

_COLUMNS = (
    "observed colour", "rendered colour", "observed depth", "rendered depth", "|depth error|",
)  # fmt: skip
_DEPTH_COLORS, _ERROR_COLORS = "viridis", "magma"
_CENTIMETRES = 100


@styled
def plot_views(
    sequence: RgbdSequence, indices: Many[int], views: Many[View], title: str = ""
) -> Figure:
    """Observed and rendered colour and depth of some frames, one a row; unmeasured pixels grey.

    Depths (m) share one colour scale and errors (cm) another, cut at their 98 % quantiles, so
    that a few wild pixels do not hide the rest.

    Args:
        indices: positions in the sequence.
        views: what the field renders from the same poses.
    """
    depths = [_masked(sequence.depth(index)) for index in indices]
    errors = [
        _CENTIMETRES * np.abs(view.depth - depth) for view, depth in zip(views, depths, strict=True)
    ]
    farthest, worst = _quantile(depths), _quantile(errors)
    shape = sequence.intrinsics.height / sequence.intrinsics.width
    figure = new_figure(title, 1.15 + len(views) * WIDTH / 5.15 * shape, layout="compressed")
    grid = figure.subplots(len(views), 5, squeeze=False)
    for row, index, view, depth, error in zip(grid, indices, views, depths, errors, strict=True):
        _show(row[0], sequence.color(index))
        _show(row[1], view.color)
        _show(row[2], depth, _DEPTH_COLORS, farthest)
        depth_image = _show(row[3], view.depth, _DEPTH_COLORS, farthest)
        error_image = _show(row[4], error, _ERROR_COLORS, worst)
        row[0].set_ylabel(f"frame {sequence.frame_ids[index]}")
    for axes, name in zip(grid[0], _COLUMNS, strict=True):
        axes.set_title(name)
    bars = {"location": "bottom", "pad": 0.02, "aspect": 30, "extend": "max"}
    figure.colorbar(depth_image, ax=grid[:, 2:4], label="depth (m)", shrink=0.6, **bars)
    figure.colorbar(error_image, ax=grid[:, 4:], label="error (cm)", shrink=0.95, **bars)
    return figure


@styled
def plot_room_overview(sequence: RgbdSequence, title: str = "", n_frames: int = 5) -> Figure:
    """Some frames of a sequence, colour over depth, and how far the camera moves between frames.

    Args:
        n_frames: pictures, evenly spread over the sequence.
    """
    indices = np.linspace(0, len(sequence) - 1, min(n_frames, len(sequence))).round()
    indices = indices.astype(int).tolist()
    depths = [_masked(sequence.depth(index)) for index in indices]
    farthest = _quantile(depths)
    shape = sequence.intrinsics.height / sequence.intrinsics.width
    pictures_height = 0.35 + 2 * WIDTH / (len(indices) + 0.45) * shape
    figure = new_figure(title, 2.6 + pictures_height)
    above, below = figure.subfigures(2, 1, height_ratios=[pictures_height, 2.0], hspace=0.04)
    grid = above.subplots(2, len(indices), squeeze=False)
    for column, index, depth in zip(grid.T, indices, depths, strict=True):
        _show(column[0], sequence.color(index)).axes.set_title(f"frame {sequence.frame_ids[index]}")
        depth_image = _show(column[1], depth, _DEPTH_COLORS, farthest)
    grid[0, 0].set_ylabel("colour")
    grid[1, 0].set_ylabel("depth")
    above.colorbar(depth_image, ax=grid, label="depth (m)", aspect=25, pad=0.01, extend="max")
    _plot_motion(below.subplots(1, 2), sequence)
    return figure


def _plot_motion(panels: Iterable[Axes], sequence: RgbdSequence) -> None:
    """Histograms of the motion from each frame to the next."""
    T_between = np.linalg.inv(sequence.T_world_camera[:-1]) @ sequence.T_world_camera[1:]
    moved_cm = _CENTIMETRES * np.linalg.norm(T_between[:, :3, 3], axis=1)
    turned_deg = np.degrees(Rotation.from_matrix(T_between[:, :3, :3]).magnitude())
    named = (("translation", "cm", moved_cm), ("rotation", "degrees", turned_deg))
    for axes, (name, unit, values) in zip(panels, named, strict=True):
        n_bins = min(30, max(5, len(values) // 5))
        # From zero to a little more than the largest, also where all are equal.
        edges = np.linspace(0, 1.02 * float(values.max()) + 1e-3, n_bins + 1)
        axes.hist(values, edges, color="#9aa5b1")
        mean = float(values.mean())
        axes.axvline(mean, color="black", linewidth=1.2)
        axes.annotate(
            f"mean {mean:.2f} {unit}", (mean, 0.97), xycoords=("data", "axes fraction"),
            xytext=(5, 0), textcoords="offset points", va="top",
        )  # fmt: skip
        axes.set(xlabel=f"{name} per frame ({unit})", ylabel="number of frames")
        axes.set_xlim(left=0)


def _show(
    axes: Axes,
    image: Float[np.ndarray, "height width *channels"],
    colors: str | None = None,
    largest: float | None = None,
) -> AxesImage:
    bare(axes)
    if colors is None:
        return axes.imshow(image)
    return axes.imshow(image, cmap=_with_grey(colors), vmin=0, vmax=largest)


def _with_grey(colors: str) -> Colormap:
    """A colour map that shows missing values grey."""
    return matplotlib.colormaps[colors].with_extremes(bad=NOT_MEASURED)


def _masked(depth: Float[np.ndarray, "height width"]) -> np.ma.MaskedArray:
    unmeasured: Bool[np.ndarray, "height width"] = depth == 0
    return np.ma.masked_array(depth, unmeasured)


def _quantile(images: Many[np.ma.MaskedArray]) -> float:
    values = np.concatenate([image.compressed() for image in images])
    return float(np.quantile(values, 0.98)) if len(values) else 1.0
