"""The open questions as pictures: what more and larger steps do, and how fast maps get good."""

import pandas as pd
from matplotlib.figure import Figure

from nbtrack.fields import field_class
from nbtrack.plots.style import label_few, method_colors, new_figure, styled
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

_LINES = {"more steps": ("-", "o"), "larger steps": (":", "s")}


@styled
def plot_reach(table: pd.DataFrame, title: str = "") -> Figure:
    """ATE (cm) against how far Adam can move the camera in a frame (mm), a panel a method.

    Args:
        table: from `nbtrack.experiments.ablations.learning_rate_and_steps`.
    """
    methods = list(table["method"].unique())
    colors = method_colors(methods)
    figure = new_figure(title, 3.4)
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    for axes, method in zip(panels, methods, strict=True):
        rows = table[table["method"] == method]
        for how, (line, marker) in _LINES.items():
            curve = rows[rows["how"] == how].sort_values("reach_mm")
            axes.plot(
                curve["reach_mm"], 100 * curve["ate_m"], line, color=colors[method], marker=marker,
                markerfacecolor="white" if line == ":" else colors[method], label=how,
            )  # fmt: skip
        axes.axhline(100 * LOST_THRESHOLD_M, color="0.3", linestyle="--", linewidth=1)
        axes.set(title=method, xscale="log", yscale="log")
        axes.set_xlabel("reach of a frame: steps × learning rate (mm)")
        label_few(axes)
        axes.legend(loc="lower left")
    panels[0].set_ylabel("ATE (cm)")
    return figure


@styled
def plot_quality_over_time(curves: pd.DataFrame, target_m: float, title: str = "") -> Figure:
    """Error of held-out depth (cm) against mapping time (s), a line a field.

    Args:
        curves: from `nbtrack.experiments.ablations.quality_over_time`.
        target_m: error (m) to mark: the best that all fields reach.
    """
    figure = new_figure(title, 3.4)
    axes = figure.subplots()
    labels = {name: field_class(name).label for name in curves["field"].unique()}
    colors = method_colors(labels.values())
    for name, label in labels.items():
        curve = curves[curves["field"] == name].sort_values("seconds")
        axes.plot(
            curve["seconds"], 100 * curve["depth_l1_m"], "o-", color=colors[label], label=label
        )
        last = curve.iloc[-1]
        axes.annotate(
            f"{last['iterations']:.0f} iterations", (last["seconds"], 100 * last["depth_l1_m"]),
            xytext=(6, 4), textcoords="offset points", fontsize=8, color=colors[label],
        )  # fmt: skip
    axes.axhline(100 * target_m, color="0.3", linestyle="--", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="mapping time (s)")
    axes.set_ylabel("mean error of held-out depth (cm)")
    label_few(axes)
    axes.margins(x=0.15)
    axes.legend(loc="upper right")
    return figure
