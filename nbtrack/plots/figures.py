"""Figures of images, measured and rendered, and figures of numbers as curves and points."""

from collections.abc import Mapping
from itertools import chain

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from nbtrack.core.arrays import Values
from nbtrack.data.frame import MILLIMETRE, Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.plots import style
from nbtrack.tables import STANDING_STILL

DEPTH, DISTANCE = "depth (m)", "|signed distance| (cm)"
# With `panchor` a colour bar does not change its panels' anchor: else panels with a bar would stand
# lower than those without.
_BAR = {"location": "bottom", "pad": 0.02, "extend": "max", "panchor": False}
_MARKS = "os^Dv"  # matplotlib's markers of up to five methods
# A title, an image, and the label of its colour bar. The label is "" for a colour image.
Panel = tuple[str, np.ndarray, str]
Curves = Mapping[str, Values]  # the numbers of each curve, by its label
Ends = Mapping[str, float]  # the upper ends of colour scales, by the labels of their bars


@style.styled
def plot_frame(sequence: RgbdSequence, index: int = 0, title: str = "") -> Figure:
    """The colour and depth (m) images of the frame at an index; unmeasured pixels are grey.

    With ipywidgets, this call lets a slider choose the frame: `interact(plot_frame,
    sequence=fixed(sequence), index=(0, len(sequence) - 1), title=fixed("A room"))`.
    """
    # All frames of a sequence share one depth scale. It is computed from every 16th pixel of at
    # most 20 frames.
    some_mm = sequence.depths_mm[:: 1 + len(sequence) // 20, ::4, ::4]
    far = MILLIMETRE * _scale_end(np.ma.masked_equal(some_mm, 0), DEPTH)
    depth = np.ma.masked_equal(sequence.depth(index), 0)  # 0 is an unmeasured pixel
    color = (f"frame {sequence.frame_ids[index]}: colour", sequence.color(index), "")
    return plot_images([[color, ("depth", depth, DEPTH)]], title, {DEPTH: far})


@style.styled
def plot_distances(frame: Frame, distances: Curves, title: str = "", end_cm: float = 0) -> Figure:
    """A frame's colour image, and an image of |d| (cm) for each label; unmeasured pixels are grey.

    `distances` maps labels to the signed distances d (m) of a map at the frame's measured points,
    in the order of `frame.measured_pixels()`. Colours end at `end_cm`, or as in `plot_images` if it
    is 0.
    """
    rows, columns = frame.measured_pixels().cpu().numpy()
    panels = [("observed colour", frame.color.cpu().numpy(), "")]
    for label, sdf in distances.items():
        # Zeros, since `np.ma.masked_all` has arbitrary values, of which drawing may warn.
        image_cm = np.ma.array(np.zeros(frame.depth_mm.shape), mask=True)
        image_cm[rows, columns] = 100 * sdf.abs().cpu().numpy()
        panels.append((f"{label}: mean {image_cm.mean():.2f} cm", image_cm, DISTANCE))
    return plot_images([panels], title, {DISTANCE: end_cm})


@style.styled
def plot_images(rows: list[list[Panel]], title: str = "", ends: Ends | None = None) -> Figure:
    """Rows of equally large images, each with a title; numbers have a colour bar below them.

    Images with the same label share one colour bar, whose scale begins at 0. It ends at the label's
    value in `ends`, or by default at a high quantile of all values with the label.
    """
    _, first, _ = rows[0][0]
    height, width = first.shape[:2]
    # The figure's title and colour bars, and in each row the titles and the images.
    inches = 0.75 + len(rows) * (0.2 + style.WIDTH / len(rows[0]) * height / width)
    grid = style.new_axes(title, inches, len(rows), len(rows[0]))
    images_of: dict[str, list[AxesImage]] = {}  # by the label of their colour bar
    for axes, (name, image, label) in zip(grid.flat, chain(*rows), strict=True):
        drawn = show_image(axes, image, name, "viridis" if label == DEPTH else "magma")
        if label:
            images_of.setdefault(label, []).append(drawn)
    figure = grid[0, 0].figure
    for label, images in images_of.items():
        values = np.ma.stack([drawn.get_array() for drawn in images])
        end = (ends or {}).get(label) or _scale_end(values, label)
        for drawn in images:
            drawn.set_clim(0, end)
        # All bars are equally thick. One below all columns is 90 times as long as it is thick.
        aspect = 90 * min(len(images), len(rows[0])) / len(rows[0])
        panels = [drawn.axes for drawn in images]
        figure.colorbar(images[0], ax=panels, label=label, aspect=aspect, **_BAR)
    return figure


def _scale_end(images: np.ndarray, label: str) -> float:
    """The end of a colour scale: a quantile of the values that are not masked, or 1 without any.

    With a quantile, a few very large values do not make all others look alike. It is the 98 %
    quantile, but the 99.9 % quantile of depths, whose largest values are distant walls.
    """
    values = np.ma.compressed(images)
    return float(np.quantile(values, 0.999 if label == DEPTH else 0.98)) if len(values) else 1.0


def show_image(axes: Axes, image: np.ndarray, title: str, colors: str = "viridis") -> AxesImage:
    """Draw an image without ticks and frame; masked pixels are grey. `colors` names a colormap."""
    axes.set_title(title)
    axes.set_axis_off()
    return axes.imshow(image, cmap=matplotlib.colormaps[colors].with_extremes(bad="#bdbdbd"))


@style.styled
def plot_along_ray(
    depths: Values, curves: Curves, marks: Mapping[str, float], title: str, ylabel: str
) -> Figure:
    """Curves over the z-depths (m) of a ray's samples, and vertical lines at the depths of `marks`.

    A curve may be shorter than `depths`, as weights of sections, which have one value less. `marks`
    are depths (m) by label.
    """
    index = depths.cpu().numpy()
    columns = {label: pd.Series(c.detach().cpu(), index[: len(c)]) for label, c in curves.items()}
    axes = style.new_axes(title, 2.7)[0, 0]
    colors = style.method_colors(columns)
    pd.DataFrame(columns).plot(ax=axes, xlabel="depth (m)", ylabel=ylabel, color=colors)
    for label, depth in marks.items():
        axes.axvline(depth, label=label, **style.DASHED)
    axes.legend()
    return axes.figure


@style.styled
def plot_columns(tables: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """Every column of every table as a curve in a panel of its own.

    Tables stand side by side below their names. They have the same columns, which stand one below
    the other: names of columns, with units, label y. The name of the index labels x.
    """
    n_rows = max(len(table.columns) for table in tables.values())
    height = 0.9 + 1.45 * n_rows  # inches
    grid = style.new_axes(title, height, n_rows, len(tables), sharex="col", sharey="row")
    for column, (heading, table) in zip(grid.T, tables.items(), strict=True):
        column[0].set_title(heading)
        for axes, name in zip(column, table, strict=True):
            axes.plot(table[name].dropna())
            axes.set(xlabel=table.index.name, ylabel=name)
            axes.label_outer()
    return grid[0, 0].figure


@style.styled
def plot_errors(frames: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """Errors of every frame: position (cm, logarithmic) and orientation (degrees).

    `frames` maps methods to the rows of their runs' frames.csv, all of the same frames. The dotted
    line is the error of a camera that stands still.
    """
    above, below = style.new_axes(title, 4.9, 2, sharex=True)[:, 0]
    draw_errors(above, frames)
    for label, color in style.method_colors(frames).items():
        below.plot(frames[label]["frame_id"], frames[label]["rotation_error_deg"], color=color)
    below.set(ylabel="rotation error (degrees)", xlabel="frame")
    return above.figure.legend_below()


def draw_errors(axes: Axes, frames: Mapping[str, pd.DataFrame]) -> None:
    """Draw the position errors (cm) of runs by frame, and those of a camera that stands still.

    `frames` are as in `plot_errors`.
    """
    for label, color in style.method_colors(frames).items():
        error_cm = 100 * frames[label]["translation_error_m"]
        axes.plot(frames[label]["frame_id"], error_cm, color=color, label=label)
    still = list(frames.values())[-1]  # the same in every run of these frames
    axes.plot(still["frame_id"], 100 * still["still_error_m"], label=STANDING_STILL, **style.DOTTED)
    axes.set_ylabel("position error (cm)")
    style.log_axes(axes, "y")


@style.styled
def plot_panels(
    panels: Mapping[str, pd.DataFrame],
    x: str,
    title: str = "",
    same_x: bool = False,
    limits: Mapping[str, float] | None = None,
) -> Figure:
    """Tables side by side, by their titles: each number is a point on x, in the row of its index.

    Each of up to five columns is a method with its own colour and mark. All panels have the same
    rows, from top to bottom: the texts in the tables' indices, each at most once in a table. A pale
    line connects the points of a row. x is logarithmic and labelled by `x`; with `same_x` it has
    the same range in all panels. `limits` are up to two values of x by their labels, as vertical
    lines in each panel.
    """
    texts = pd.Index(np.concatenate([table.index for table in panels.values()])).unique()
    grid = style.new_axes(title, 3.4, 1, len(panels), sharex=same_x, sharey=True)[0]
    for axes, (name, values) in zip(grid, panels.items(), strict=True):
        y = texts.get_indexer(values.index)  # the rows of these values
        left, right = values.min(axis=1), values.max(axis=1)
        axes.hlines(y, left, right, color="0.85", linewidth=2, zorder=1)
        for (label, color), mark in zip(style.method_colors(values).items(), _MARKS, strict=False):
            axes.plot(values[label], y, mark, color=color, mfc="none", mew=1.6, label=label)
        looks = zip((limits or {}).items(), (style.DASHED, style.DOTTED), strict=False)
        for (label, limit), look in looks:
            axes.axvline(limit, **look, label=label)
        axes.set_yticks(range(len(texts)), texts)
        axes.set(title=name, xlabel=x, ylim=(len(texts) - 0.5, -0.5))
        style.log_axes(axes, "x")
    return grid[0].figure.legend_below()


@style.styled
def plot_curves(
    table: pd.DataFrame, x: str, y: str, by: str, title: str = "", log: str = "xy", line: str = "-"
) -> Figure:
    """Column `y` over column `x`: a curve for each group of rows with the same value of `by`.

    The names of the columns label the axes. If `x` holds texts, these keep the order of their first
    appearance, and points of different groups stand side by side without lines. If it holds numbers
    and every group has a single row, the rows are points beside their labels. A variant of a
    method, which is named after a comma, has the method's mark, hollow, and is dashed. If the table
    has columns `from` and `to`, they are drawn as intervals of y. `log` names the logarithmic axes;
    `line` is matplotlib's style of all lines, where "none" means points only.
    """
    axes = style.new_axes(title, 3.6)[0, 0]
    is_text = not pd.api.types.is_numeric_dtype(table[x])
    places = _side_by_side(axes, table[x], table[by]) if is_text else table[x]
    colors = style.method_colors(table[by])
    groups = table.assign(**{x: places}).groupby(by, sort=False)
    line = "none" if is_text else line
    mark_of: dict[str, str] = {}
    for label, rows in groups:
        method, is_variant, _ = label.partition(", ") if line == "-" else (label, "", "")
        mark = mark_of.setdefault(method, _MARKS[len(mark_of) % len(_MARKS)])
        look = {"linestyle": "--" if is_variant else line, "color": colors[label], "label": label}
        look["markerfacecolor"] = "white" if is_variant else colors[label]
        axes.plot(rows[x], rows[y], mark, **look)
        if "from" in table:
            axes.vlines(rows[x], rows["from"], rows["to"], colors[label], linewidth=0.8)
    axes.set(xlabel=x, ylabel=y)
    style.log_axes(axes, log.replace("x", "") if is_text else log)
    if table[by].is_unique and not is_text:
        axes.margins(x=0.4, y=0.1)  # room for the labels at the right of the points
        for label, rows in groups:
            point = rows[x].item(), rows[y].item()
            axes.annotate(label, point, (6, -3), textcoords="offset points", color=colors[label])
    else:
        axes.figure.legend(loc="outside right center", handlelength=3)
    return axes.figure


@style.styled
def plot_intervals(
    panels: Mapping[str, pd.DataFrame], x: str, title: str = "", log: bool = False
) -> Figure:
    """Column `x` with its interval, by set of runs: a panel for each table, below its name.

    Tables have columns `set` (the rows of a panel), `method` (colours), `from` and `to` (the ends
    of the interval), `text` (one for each set, printed right of the panel) and `shown` (whether the
    mark is filled). With `log` x is logarithmic and a dashed line stands at 1.
    """
    sets = list(dict.fromkeys(chain.from_iterable(table["set"] for table in panels.values())))
    colors = style.method_colors(pd.concat(panels)["method"])
    height = 1.2 + 0.34 * len(sets)
    row = style.new_axes(title, height, 1, len(panels), sharex=True, sharey=True)[0]
    for axes, (name, table) in zip(row, panels.items(), strict=True):
        for k, (method, color) in enumerate(colors.items()):
            of = table[table["method"] == method]
            y = of["set"].map(sets.index) + 0.34 * (k - (len(colors) - 1) / 2)
            axes.hlines(y, of["from"], of["to"], color)
            fill = np.where(of["shown"], color, "white")
            axes.scatter(of[x], y, c=fill, edgecolors=color, zorder=3, label=method)
        axes.scatter([], [], c="0.3", label="filled: shown")
        beside = {"transform": axes.get_yaxis_transform(), "va": "center", "size": 8}
        for at, text in table.groupby("set")["text"].first().items():
            axes.text(1.02, sets.index(at), text, **beside)
        axes.set(ylim=(len(sets) - 0.5, -0.5), xlabel=x, title=name)
        axes.set_yticks(range(len(sets)), sets)
        style.log_axes(axes, "x" if log else "")
        if log:
            axes.axvline(1, **style.DASHED)
    return row[0].figure.legend_below()


def _side_by_side(axes: Axes, texts: pd.Series, labels: pd.Series) -> np.ndarray:
    """Make the different texts ticks at 0, 1, 2, ... on x; returns the x of each point.

    A point lies near the tick of its text. So that points of different labels stand side by side,
    each label has its own shift from the tick. Neighbouring labels are 0.5 / n apart for n labels,
    so that all of them stay within half of the distance between two ticks. With fewer than four
    labels they are as far apart as with four.
    """
    tick_of_point, ticks = pd.factorize(texts)
    axes.set_xticks(range(len(ticks)), ticks)
    label_of_point, names = pd.factorize(labels)
    shift = label_of_point - (len(names) - 1) / 2  # 1 from label to label, about 0
    return tick_of_point + shift * 0.5 / max(len(names), 4)
