"""How a map came to be: its losses, and how sharp its surfaces grew."""

from collections.abc import Mapping

import pandas as pd
from matplotlib.figure import Figure

from nbtrack.core.errors import DataError
from nbtrack.plots.style import METHOD_COLORS, method_colors, new_figure, styled

_CENTIMETRES = 100


@styled
def plot_losses(histories: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """Every loss term over mapping: each iteration pale, the running median on top.

    Args:
        histories: `FittedMap.history` by label; a term that several maps share is one panel,
            though its unit may differ: iMAP divides depth errors by their deviation.
    """
    terms = list(dict.fromkeys(t for history in histories.values() for t in loss_terms(history)))
    colors = method_colors(histories)
    figure = new_figure(title, 3.0)
    panels = figure.subplots(1, len(terms), sharex=True, squeeze=False)[0]
    for axes, term in zip(panels, terms, strict=True):
        for label, history in histories.items():
            if term not in loss_terms(history):
                continue
            values = history[term]
            axes.plot(values, color=colors[label], alpha=0.22, linewidth=0.6)
            axes.plot(running_median(values), color=colors[label], label=label)
        axes.set(yscale="log", xlabel="mapping iteration")
        axes.set_ylabel(f"weighted {term} loss (no unit)")
        axes.set_xlim(left=0)
        axes.legend(loc="upper right")
    return figure


@styled
def plot_deviation(history: pd.DataFrame, title: str = "", label: str = "NeuS") -> Figure:
    """The standard deviation 1/s of NeuS's s-density (cm) over mapping.

    Args:
        history: `FittedMap.history` with a column `deviation_m`.

    Raises:
        DataError: there is no such column.
    """
    if "deviation_m" not in history:
        raise DataError(
            f"a history with columns {', '.join(history.columns)} has no deviation_m: "
            "only fields with an s-density have one; pass the history of a NeuS map"
        )
    deviation_cm = _CENTIMETRES * history["deviation_m"]
    figure = new_figure(title, 2.9)
    axes = figure.subplots()
    axes.plot(deviation_cm, color=METHOD_COLORS.get(label, METHOD_COLORS["NeuS"]), label=label)
    last = float(deviation_cm.iloc[-1])
    axes.annotate(
        f"{last:.2g} cm", (deviation_cm.index[-1], last), xytext=(0, 6),
        textcoords="offset points", ha="right",
    )  # fmt: skip
    for height, va, text in ((0.96, "top", "wide: light ends gradually, surfaces are blurred"),
                             (0.04, "bottom", "narrow: light ends at the zero level")):  # fmt: skip
        axes.text(0.02, height, text, transform=axes.transAxes, va=va, style="italic", color="0.4")
    axes.set(xlabel="mapping iteration", ylabel="standard deviation 1/s (cm)")
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.15 * float(deviation_cm.max()))
    axes.legend(loc="upper right")
    return figure


def loss_terms(history: pd.DataFrame) -> list[str]:
    """Names of the loss terms of a history: the columns in front of their sum."""
    columns = list(history.columns)
    return columns[: columns.index("total")]


def running_median(values: pd.Series) -> pd.Series:
    """Median over a window of a twentieth of the series, centred, cut short at the ends."""
    window = max(5, len(values) // 20)
    return values.rolling(window, center=True, min_periods=1).median()
