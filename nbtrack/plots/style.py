"""One look for all figures: colours by method, a clean style, and figures without global state."""

import io
import textwrap
from collections.abc import Callable, Iterable
from functools import wraps
from typing import ParamSpec

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from nbtrack.tracking.trackers import TRACKERS

TRUE_COLOR, TRACKED_COLOR = "#1a9641", "#d7191c"
"""Green and red of the true and the tracked trajectory, as in the paper's first figure."""

_IMAP, _NEUS = "#3b6fb6", "#e08214"
METHOD_COLORS = {
    "iMAP with VR": _IMAP, "iMAP": _IMAP, "VR": _IMAP,
    "NeuS with SDF": _NEUS, "NeuS": _NEUS, "SDF": _NEUS,
}  # fmt: skip
"""The paper's methods, and their fields and trackers alone; other methods: `method_colors`."""
_OTHER_COLORS = ("#7b3294", "#17a2a2", "#8c510a", "#c51b7d", "#4d4d4d", "#6a6acd", "#a6911a")
TRUE_LABEL = "true"

WIDTH = 9.0  # inches of every figure: a notebook's text width
NOT_MEASURED = "#bdbdbd"  # grey of pixels without a value
_TITLE_CHARACTERS = 100
STYLE = {
    "figure.dpi": 90, "figure.facecolor": "white", "figure.titlesize": 11,
    "figure.titleweight": "bold", "font.size": 9, "axes.titlesize": 9.5, "axes.labelsize": 9,
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#555555", "axes.grid": True, "axes.axisbelow": True, "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6, "xtick.labelsize": 8, "ytick.labelsize": 8, "xtick.color": "#333333",
    "ytick.color": "#333333", "legend.frameon": False, "legend.fontsize": 8.5,
    "lines.linewidth": 1.6, "lines.solid_capstyle": "round", "image.interpolation": "nearest",
}  # fmt: skip

P = ParamSpec("P")


class NotebookFigure(Figure):
    """A figure that shows itself once where a cell ends with it; pyplot knows nothing of it."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        # Notebooks are committed with their figures: worth the time that small files take.
        self.savefig(buffer, format="png", pil_kwargs={"optimize": True})
        return buffer.getvalue()


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: draw in the house style and leave matplotlib's own settings as they were."""

    @wraps(draw)
    def draw_in_style(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return draw_in_style


def new_figure(title: str, height: float, layout: str = "constrained") -> Figure:
    """An empty figure of the usual width with its finding as title.

    Args:
        height: inches.
        layout: matplotlib's layout engine; "compressed" suits grids of images.
    """
    figure = NotebookFigure(figsize=(WIDTH, height), layout=layout)
    if title:
        figure.suptitle(textwrap.fill(title, _TITLE_CHARACTERS), x=0.01, ha="left")
    return figure


def method_colors(labels: Iterable[str]) -> dict[str, str]:
    """One colour a method, the same in every figure.

    The paper's methods have theirs in `METHOD_COLORS`. Registered trackers follow in the order of
    registration, then whatever else is among the labels, in the order given.
    """
    labels = list(labels)
    names = dict.fromkeys([*(tracker.label for tracker in TRACKERS.values()), *labels])
    others = [name for name in names if name not in METHOD_COLORS]
    taken = {name: _OTHER_COLORS[i % len(_OTHER_COLORS)] for i, name in enumerate(others)}
    return {label: METHOD_COLORS.get(label) or taken[label] for label in labels}


def path_colors(labels: Iterable[str]) -> dict[str, str]:
    """Colours of trajectories: "true" green; one estimate red, several by method."""
    estimates = [label for label in labels if label != TRUE_LABEL]
    colors = dict.fromkeys(estimates, TRACKED_COLOR)
    if len(estimates) > 1:
        colors = method_colors(estimates)
    return {TRUE_LABEL: TRUE_COLOR} | colors


def camera_positions(T_world_camera: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3"]:
    """Camera centres (m, world frame) of camera-to-world poses."""
    return T_world_camera[:, :3, 3]


def bare(axes: Axes) -> None:
    """Take ticks, grid and frame off an image's axes: pixels speak for themselves."""
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def label_few(axes: Axes) -> None:
    """Plain numbers at 1, 2 and 5 of each decade of two logarithmic axes."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
