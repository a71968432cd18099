"""Both tables as pictures: errors by rate and scene, steps by budget and number of pixels."""

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from nbtrack.plots.style import method_colors, new_figure, styled
from nbtrack.tables.layout import PAPER_SCENE_LABELS
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

_PANELS_A_ROW = 5
_STEP_PANELS_A_ROW = 2  # each holds a legend of two columns
_PANELS_WITH_VALUES = 2  # with more, bars are too narrow for their numbers
_GROUP_WIDTH = 0.8  # of the distance between two rates
_LEAST_ATE_M = 0.002  # where bars begin, unless an error is smaller still
_LEGEND_CHARACTERS = 80  # that one line of a legend holds
_MARKERS = "os^Dv"


@styled
def plot_ate_bars(cells: pd.DataFrame, title: str = "") -> Figure:
    """Table I as bars: ATE (m, logarithmic) by rate and method, a panel a scene.

    A bar that crosses the dashed line at 0.2 m is a lost camera, which the table prints red; a
    cross on the axis is a run without result. Thin lines span a deviation over seeds either way,
    where there were several.

    Args:
        cells: long form with columns `rate_hz`, `method`, `scene`, `ate_m` (see `tables`).
    """
    scenes, methods = list(cells["scene"].unique()), list(cells["method"].unique())
    n_columns = min(len(scenes), _PANELS_A_ROW)
    n_rows = -(-len(scenes) // n_columns)
    figure = new_figure(title, 0.9 + 2.1 * n_rows)
    grid = figure.subplots(n_rows, n_columns, sharey=True, squeeze=False)
    colors = method_colors(methods)
    rates = sorted(map(float, cells["rate_hz"].unique()), reverse=True)
    low, high = _ate_limits(cells["ate_m"])
    for axes, scene in zip(grid.flat, scenes, strict=False):
        _draw_bars(
            axes, cells[cells["scene"] == scene], rates, colors, len(scenes) <= _PANELS_WITH_VALUES
        )
        axes.set(title=PAPER_SCENE_LABELS.get(scene, scene.replace("_", " ")))
        axes.set(yscale="log", ylim=(low, high), xlabel="rate (Hz)")
        axes.set_xticks(range(len(rates)), [f"{rate:g}" for rate in rates])
        axes.yaxis.set_major_formatter(_plain_numbers())
        axes.grid(False, axis="x")
        axes.axhline(LOST_THRESHOLD_M, color="0.3", linestyle="--", linewidth=1)
    for axes in grid.flat[len(scenes) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("ATE (m)")
    lost = Line2D([], [], color="0.3", linestyle="--", linewidth=1, label="lost above 0.2 m")
    handles, _ = grid[0, 0].get_legend_handles_labels()
    wide = sum(map(len, methods)) > _LEGEND_CHARACTERS
    n_columns = 3 if wide else len(methods) + 1
    figure.legend(handles=[*handles, lost], loc="outside lower center", ncols=n_columns)
    return figure


@styled
def plot_steps(
    cells: pd.DataFrame, published: pd.DataFrame | None = None, title: str = ""
) -> Figure:
    """Table II as curves: steps that fit into a budget, a panel a tracker, a line a number n.

    Darker is more pixels n. Filled points are this machine's, hollow ones the paper's.

    Args:
        cells: long form with columns `tracker`, `n_pixels`, `budget_ms`, `steps` (see `tables`).
        published: the paper's values in the same form, shown beside.
    """
    trackers = list(cells["tracker"].unique())
    n_rows = -(-len(trackers) // _STEP_PANELS_A_ROW)
    figure = new_figure(title, 3.6 * n_rows)
    n_columns = min(len(trackers), _STEP_PANELS_A_ROW)
    grid = figure.subplots(n_rows, n_columns, sharey=True, squeeze=False)
    panels = grid.flat
    for axes in panels[len(trackers) :]:
        axes.set_visible(False)
    colors = method_colors(trackers)
    for axes, tracker in zip(panels, trackers, strict=False):
        _draw_steps(axes, cells[cells["tracker"] == tracker], colors[tracker], "-", "this machine")
        if published is not None:
            # Rows of the engine stand beside the paper's of the same tracker.
            paper = published[published["tracker"] == tracker.partition(",")[0]]
            _draw_steps(axes, paper, colors[tracker], ":", "paper")
        budgets = sorted(cells["budget_ms"].unique())
        axes.set(title=tracker, xscale="log", yscale="log", xlabel="budget a frame (ms)")
        axes.xaxis.set_major_locator(FixedLocator(budgets))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(_plain_numbers())
        axes.yaxis.set_major_formatter(_plain_numbers())
        axes.legend(loc="upper left", ncols=1 if published is None else 2)
    for axes in grid[:, 0]:
        axes.set_ylabel("optimization steps (number)")
    low, high = panels[0].get_ylim()
    panels[0].set_ylim(low, 6 * high)  # room for the legends
    return figure


def _draw_bars(
    axes: Axes,
    cells: pd.DataFrame,
    rates: list[float],
    colors: dict[str, str],
    with_values: bool,
) -> None:
    width = _GROUP_WIDTH / len(colors)
    for number, (method, color) in enumerate(colors.items()):
        rows = cells[cells["method"] == method].set_index("rate_hz").reindex(rates)
        ate = rows["ate_m"]
        places = np.arange(len(rates)) + (number - (len(colors) - 1) / 2) * width
        bars = axes.bar(places, ate, 0.92 * width, color=color, label=method)
        if "ate_deviation_m" in rows and rows["ate_deviation_m"].notna().any():
            axes.errorbar(places, ate, rows["ate_deviation_m"], fmt="none", ecolor="0.2", capsize=2)
        if with_values:
            axes.bar_label(bars, fmt="{:.3f}", fontsize=7, padding=1)
        missing = places[ate.isna()]
        across = axes.get_xaxis_transform()
        axes.plot(missing, np.full(len(missing), 0.03), "x", color=color, transform=across)


def _ate_limits(ate_m: pd.Series) -> tuple[float, float]:
    low = min(_LEAST_ATE_M, 0.7 * ate_m.min()) if ate_m.notna().any() else _LEAST_ATE_M
    return float(low), float(1.5 * np.nanmax([LOST_THRESHOLD_M * 2, ate_m.max()]))


def _draw_steps(axes: Axes, cells: pd.DataFrame, color: str, line: str, source: str) -> None:
    numbers = sorted(cells["n_pixels"].unique())
    for index, n_pixels in enumerate(numbers):
        rows = cells[cells["n_pixels"] == n_pixels].sort_values("budget_ms")
        shade = _shade(color, (index + 1) / len(numbers))
        axes.plot(
            rows["budget_ms"], rows["steps"], line, color=shade, marker=_MARKERS[index % 5],
            markerfacecolor=shade if line == "-" else "white", markersize=5.5, linewidth=1.3,
            label=f"n = {n_pixels}, {source}",
        )  # fmt: skip


def _shade(color: str, strength: float) -> tuple[float, ...]:
    """From a pale tone of a colour (strength 0) over the colour (0.5) to a dark one (1)."""
    rgb = np.array(matplotlib.colors.to_rgb(color))
    other = np.ones(3) if strength < 0.5 else np.zeros(3)
    share = 0.9 * abs(strength - 0.5)
    return tuple((1 - share) * rgb + share * other)


def _plain_numbers() -> FuncFormatter:
    return FuncFormatter(lambda value, _: f"{value:g}")
