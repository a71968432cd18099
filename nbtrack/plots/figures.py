"""What a camera saw beside what a field renders; numbers as curves and bars."""

from collections.abc import Mapping, Sequence
from itertools import chain, cycle

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from nbtrack.core.arrays import Values
from nbtrack.data.frame import MILLIMETRE, Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import View
from nbtrack.plots import style
from nbtrack.tables import STANDING_STILL
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

DEPTH, DEPTH_ERROR, DISTANCE = "depth (m)", "depth error (cm)", "|signed distance| (cm)"
# Panels keep their own anchor (panchor): else those with a bar stand lower than those without.
_BAR = {"location": "bottom", "pad": 0.02, "extend": "max", "panchor": False}
_MARKS = "os^Dv"  # matplotlib's markers of up to five methods
# A title, an image (colours or numbers), and the label of the numbers' colour bar; "" for colours.
Panel = tuple[str, np.ndarray, str]
Curves = Mapping[str, Values]  # numbers by label
Ends = Mapping[str, float]  # of colour scales, by label


@style.styled
def plot_frame(sequence: RgbdSequence, index: int = 0, title: str = "") -> Figure:
    """Colour and depth (m) of the frame at a position of a sequence; unmeasured pixels are grey.

    With a slider, where `fixed` is that of ipywidgets: `interact(plot_frame,
    sequence=fixed(sequence), index=(0, len(sequence) - 1), title=fixed("A room"))`.
    """
    # One scale for all frames, from a sixteenth of the pixels of at most 20 of them.
    some_mm = sequence.depths_mm[:: 1 + len(sequence) // 20, ::4, ::4]
    far = MILLIMETRE * _most(np.ma.masked_equal(some_mm, 0), DEPTH)
    depth = np.ma.masked_equal(sequence.depth(index), 0)  # 0 is an unmeasured pixel
    color = (f"frame {sequence.frame_ids[index]}: colour", sequence.color(index), "")
    return plot_images([[color, ("depth", depth, DEPTH)]], title, {DEPTH: far})


@style.styled
def plot_views(
    sequence: RgbdSequence, indices: Sequence[int], views: Sequence[View], title: str = ""
) -> Figure:
    """Observed and rendered colour and depth of some frames, one a row; unmeasured pixels grey.

    Depths (m) share one colour scale; that of errors ends at 10 cm in every figure. `indices` are
    positions in the sequence, `views` what the field renders from the same poses.
    """
    rows = []
    for index, (color, rendered) in zip(indices, views, strict=True):
        depth = np.ma.masked_equal(sequence.depth(index), 0)
        name = f"frame {sequence.frame_ids[index]}"
        colors = [(name, sequence.color(index), ""), ("rendered colour", color, "")]
        depths = [("observed depth", depth, DEPTH), ("rendered depth", rendered, DEPTH)]
        rows.append([*colors, *depths, ("|error|", 100 * np.abs(rendered - depth), DEPTH_ERROR)])
    return plot_images(rows, title, {DEPTH_ERROR: 10.0})


@style.styled
def plot_distances(frame: Frame, distances: Curves, title: str = "") -> Figure:
    """A frame's colour, and by label |d| (cm) of its points in a map; unmeasured pixels are grey.

    `distances` (m) of a label are those at the pixels of `frame.measured_pixels()`, in their order.
    """
    rows, columns = frame.measured_pixels().cpu().numpy()
    panels = [("observed colour", frame.color.cpu().numpy(), "")]
    for label, sdf in distances.items():
        # `masked_all` leaves its memory as it is, of which drawing may warn.
        image_cm = np.ma.array(np.zeros(frame.depth_mm.shape), mask=True)
        image_cm[rows, columns] = 100 * sdf.abs().cpu().numpy()
        panels.append((f"{label}: mean {image_cm.mean():.2f} cm", image_cm, DISTANCE))
    return plot_images([panels], title)


@style.styled
def plot_images(rows: list[list[Panel]], title: str = "", ends: Ends | None = None) -> Figure:
    """Images in rows, each with a title and the label of its colour bar, "" for colours.

    Images of one label share a bar, and a scale from 0 to its end in `ends`, by default to the 98 %
    quantile of their values, of depths to the 99.9 % quantile.
    """
    _, first, _ = rows[0][0]
    height, width = first.shape[:2]
    # The figure's title and bars, and in each row the panels' titles and images.
    inches = 0.75 + len(rows) * (0.2 + style.WIDTH / len(rows[0]) * height / width)
    grid = style.new_axes(title, inches, len(rows), len(rows[0]))
    with_bar: dict[str, list[AxesImage]] = {}
    for axes, (name, image, label) in zip(grid.flat, chain(*rows), strict=True):
        drawn = show_image(axes, image, name, "viridis" if label == DEPTH else "magma")
        if label:
            with_bar.setdefault(label, []).append(drawn)
    figure = grid[0, 0].figure
    for label, images in with_bar.items():
        values = np.ma.stack([drawn.get_array() for drawn in images])
        limit = (ends or {}).get(label) or _most(values, label)
        for drawn in images:
            drawn.set_clim(0, limit)
        # Wide bars are no thicker than narrow ones, whose length is some tens of their thickness.
        aspect = 90 * min(len(images), len(rows[0])) / len(rows[0])
        figure.colorbar(images[0], ax=[i.axes for i in images], label=label, aspect=aspect, **_BAR)
    return figure


def _most(images: np.ndarray, label: str) -> float:
    """A quantile of known values, so that a few wild pixels do not hide the rest.

    Of errors it is that of 98 %; the farthest depths are walls, and that of 99.9 % shows them, too.
    It is 1 where nothing is known: a scale needs an end.
    """
    values = np.ma.compressed(images)
    return float(np.quantile(values, 0.999 if label == DEPTH else 0.98)) if len(values) else 1.0


def show_image(axes: Axes, image: np.ndarray, title: str, colors: str = "viridis") -> AxesImage:
    """An image without ticks, grid and frame; masked pixels are grey. `colors` names a colormap."""
    axes.set_title(title)
    axes.set_axis_off()
    return axes.imshow(image, cmap=matplotlib.colormaps[colors].with_extremes(bad="#bdbdbd"))


@style.styled
def plot_along_ray(
    depths: Values, curves: Curves, marks: Mapping[str, float], title: str, ylabel: str
) -> Figure:
    """Curves of one unit over the z-depths (m) of a ray's samples; that called "true" is dashed.

    A curve may be shorter than `depths`: weights of sections lack the last sample. `marks` are
    further depths (m) by label.
    """
    index = depths.cpu().numpy()
    columns = {k: pd.Series(c.detach().cpu(), index[: len(c)]) for k, c in curves.items()}
    axes = style.new_axes(title, 2.7)[0, 0]
    dashes = ["--" if label == "true" else "-" for label in columns]
    look = {"style": dashes, "color": style.method_colors(columns)}
    pd.DataFrame(columns).plot(ax=axes, xlabel="depth (m)", ylabel=ylabel, **look)
    for label, depth in marks.items():
        axes.axvline(depth, label=label, **style.DASHED)
    axes.legend()
    return axes.figure


@style.styled
def plot_columns(tables: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """A panel for each column of each table: a row for each column, a panel column for each table.

    The name of a table stands above its panels. Tables have the same columns, whose names, with
    units, label y; the name of the index labels x.
    """
    n_rows = len(next(iter(tables.values())).columns)
    height = 0.9 + 1.45 * n_rows  # inches
    grid = style.new_axes(title, height, n_rows, len(tables), sharex="col", sharey="row")
    for column, (heading, table) in zip(grid.T, tables.items(), strict=True):
        column[0].set_title(heading)
        for axes, (name, color) in zip(column, style.method_colors(table).items(), strict=True):
            axes.plot(table[name].dropna(), color=color)
            axes.set(xlabel=table.index.name, ylabel=name)
            axes.label_outer()
    return grid[0, 0].figure


@style.styled
def plot_errors(frames: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """Errors of every frame: position (cm, logarithmic) and orientation (degrees).

    `frames` has by method the rows of a run's frames.csv, of the same frames. The dashed line is
    the ATE of 0.2 m above which the paper prints a sequence in red; the dotted one is a camera that
    stands still. The legend names these two, since curves have their names at their ends.
    """
    above, below = style.new_axes(title, 4.9, 2, sharex=True)[:, 0]
    draw_errors(above, frames)
    for label, color in style.method_colors(frames).items():
        below.plot(frames[label]["frame_id"], frames[label]["rotation_error_deg"], color=color)
    above.margins(x=0)  # labels at the ends of curves stand beside the axes
    above.axhline(100 * LOST_THRESHOLD_M, label="the paper's 0.2 m", **style.DASHED)
    below.set(ylabel="rotation error (degrees)", xlabel="frame")
    return above.figure.legend_below()


def draw_errors(axes: Axes, frames: Mapping[str, pd.DataFrame]) -> None:
    """Errors of the position (cm) by frame and label, and those of a camera standing still.

    Of several curves each has its label at its end; one curve alone has it in the legend.
    """
    alone = len(frames) == 1
    for label, color in style.method_colors(frames).items():
        error_cm = 100 * frames[label]["translation_error_m"]
        index = frames[label]["frame_id"]
        axes.plot(index, error_cm, color=color, label=label if alone else "")
        last = error_cm.last_valid_index()
        if last is not None and not alone:
            end = index[last], error_cm[last]
            axes.annotate(label, end, (5, 0), textcoords="offset points", color=color, va="center")
    still = list(frames.values())[-1]  # the same in every run of these frames
    error_cm = 100 * still["still_error_m"]
    axes.plot(still["frame_id"], error_cm, label=STANDING_STILL, **style.DOTTED)
    axes.set_ylabel("translation error (cm)")
    style.log_axes(axes, "y")


@style.styled
def plot_panels(
    panels: Mapping[str, pd.DataFrame],
    x: str,
    title: str = "",
    same_x: bool = False,
    joined: bool = True,
) -> Figure:
    """A panel for each table, by its title: a column is a method, whose numbers are points along x.

    Tables share the texts of their index, which stand along y from the top; in a table each has one
    row, whose numbers a pale line joins, if they are to be `joined`. x is logarithmic, labelled by
    `x`, and with `same_x` of one range in all panels.
    """
    texts = pd.Index(np.concatenate([table.index for table in panels.values()])).unique()
    grid = style.new_axes(title, 3.4, 1, len(panels), sharex=same_x, sharey=True)[0]
    for axes, (name, values) in zip(grid, panels.items(), strict=True):
        y = texts.get_indexer(values.index)
        if joined:
            ends = values.min(axis=1), values.max(axis=1)
            axes.hlines(y, *ends, color="0.85", linewidth=2, zorder=1)
        for (label, color), mark in zip(style.method_colors(values).items(), _MARKS, strict=False):
            axes.plot(values[label], y, mark, color=color, mfc="none", mew=1.6, label=label)
        axes.set_yticks(range(len(texts)), texts)
        axes.set(title=name, xlabel=x, ylim=(len(texts) - 0.5, -0.5))
        style.log_axes(axes, "x")
    return grid[0].figure.legend_below()


@style.styled
def plot_curves(
    table: pd.DataFrame, x: str, y: str, by: str, title: str = "", log: str = "xy", line: str = "-"
) -> Figure:
    """Column `y` over column `x`, a line for each group of rows with the same value of `by`.

    Groups of one row are points beside their labels. Axes are labelled by the names of the columns,
    as "time a frame (ms)". If x is text, it keeps the order of its first appearance, and points of
    the groups stand side by side, without lines. A method has its own colour; marks tell groups
    apart, too, and a variant, named after a comma, is dashed. Columns `from` and `to` are drawn as
    intervals of y. `log` names the logarithmic axes; `line` is matplotlib's style of all lines, and
    "none" leaves points.
    """
    axes = style.new_axes(title, 3.6)[0, 0]
    is_text = not pd.api.types.is_numeric_dtype(table[x])
    places = _side_by_side(axes, table[x], table[by]) if is_text else table[x]
    colors = style.method_colors(table[by])
    groups = table.assign(**{x: places}).groupby(by, sort=False)
    for (label, rows), mark in zip(groups, cycle(_MARKS), strict=False):
        dash = "--" if ", " in label and line == "-" else line
        look = {"linestyle": "none" if is_text else dash, "color": colors[label], "label": label}
        axes.plot(rows[x], rows[y], mark, **look)
        if "from" in table:
            axes.vlines(rows[x], rows["from"], rows["to"], colors[label], linewidth=0.8)
    axes.set(xlabel=x, ylabel=y)
    style.log_axes(axes, log.replace("x", "") if is_text else log)
    if table[by].is_unique and not is_text:
        style.label_points(axes, table[x], table[y], colors)
    else:
        axes.figure.legend(loc="outside right center")
    return axes.figure


def _side_by_side(axes: Axes, texts: pd.Series, labels: pd.Series) -> np.ndarray:
    """Make texts the ticks of x; returns where each point lies on x.

    Points of a text are shifted by the group that their label names: groups share half the distance
    of two ticks, and fewer than four stand as close as four.
    """
    codes, ticks = pd.factorize(texts)
    axes.set_xticks(range(len(ticks)), ticks)
    groups, names = pd.factorize(labels)
    return codes + (groups - (len(names) - 1) / 2) * 0.5 / max(len(names), 4)
