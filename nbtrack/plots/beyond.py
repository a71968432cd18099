"""Beyond the paper as pictures: speed against accuracy, and the basin of convergence."""

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from nbtrack.plots.style import label_few, method_colors, new_figure, styled
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

_MARKERS = "osD^vPX"


@styled
def plot_speed_accuracy(points: pd.DataFrame, title: str = "") -> Figure:
    """ATE (cm) against time a frame (ms), both logarithmic, a point a method; lower left is better.

    Args:
        points: from `nbtrack.experiments.beyond.speed_and_accuracy`.
    """
    figure = new_figure(title, 3.6)
    axes = figure.subplots()
    colors = method_colors(points["method"])
    for number, row in enumerate(points.itertuples()):
        axes.plot(
            row.ms_per_frame, row.ate_cm, _MARKERS[number % len(_MARKERS)], markersize=9,
            color=colors[row.method], linestyle="none", label=row.method,
        )  # fmt: skip
    axes.axhline(100 * LOST_THRESHOLD_M, color="0.3", linestyle="--", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="time a frame (ms)", ylabel="ATE (cm)")
    label_few(axes)
    axes.margins(0.12)
    figure.legend(loc="outside right center")
    return figure


@styled
def plot_basin(shares: pd.DataFrame, title: str = "") -> Figure:
    """Share of starts that converged against how far off they were, a line a method.

    Args:
        shares: from `nbtrack.experiments.basin.share_recovered`.
    """
    figure = new_figure(title, 3.2)
    axes = figure.subplots()
    names = [f"{method}, {steps} steps" for method, steps in shares.index]
    colors = method_colors([method for method, _ in shares.index])
    places = range(len(shares.columns))
    for number, (name, (method, _)) in enumerate(zip(names, shares.index, strict=True)):
        axes.plot(
            places, shares.iloc[number], marker=_MARKERS[number], color=colors[method], label=name
        )
    axes.set_xticks(places, shares.columns)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel="start off by", ylabel="found to 2 cm and 1°", ylim=(-0.03, 1.05))
    axes.legend(loc="lower left")
    return figure


@styled
def plot_ingredients(table: pd.DataFrame, title: str = "") -> Figure:
    """ATE (cm) of LM with one thing changed at a time, a group of bars a stride.

    Args:
        table: from `nbtrack.experiments.beyond.what_each_ingredient_adds`, of one scene.
    """
    figure = new_figure(title, 3.4)
    strides = list(table["stride"].unique())
    panels = figure.subplots(1, len(strides), sharey=True, squeeze=False)[0]
    for axes, stride in zip(panels, strides, strict=True):
        rows = table[table["stride"] == stride][::-1]
        is_first = rows["ingredient"] == rows["ingredient"].iloc[-1]
        axes.barh(
            rows["ingredient"], 100 * rows["ate_m"],
            color=["#17a2a2" if first else "#9bbfc4" for first in is_first],
        )  # fmt: skip
        axes.set(xlabel="ATE (cm)")
        axes.set_title("every frame" if stride == 1 else f"one frame of {stride}")
        axes.grid(False, axis="y")
    return figure
