"""One look for all figures: colours by label, axes, figures without global state."""

import contextlib
import io
import textwrap
import warnings
from collections.abc import Iterable, Iterator
from itertools import cycle, product
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from matplotlib.transforms import Bbox
from PIL import Image

PALETTE = "#3b6fb6", "#e08214", "#7b3294", "#17a2a2", "#8c510a", "#c51b7d", "#4d4d4d", "#a6911a"
_LABELS = (  # those of each colour of the palette
    ("iMAP with VR", "iMAP", "VR"),
    ("NeuS with SDF", "NeuS", "SDF", "NeuS+ with SDF (Adam)"),
    ("NeuS+ baked (LM)", "NeuS+", "LM"),
    ("NeuS+ corrected (LM)", "NeuS+ corrected", "LM, corrected map"),
    # Of rates, too: a method's colour would say which method it is.
    ("ICP", "at 5 Hz"),
    ("NeuS+ grid", "at 10 Hz"),
    ("five rooms of the paper",),
    ("nine rooms of ours", "at 2 Hz"),
)
_FIXED = {label: color for color, labels in zip(PALETTE, _LABELS, strict=True) for label in labels}
# Green and red as in the paper's first figure, of tones that colour-blind readers tell apart (Okabe
# and Ito). The reference are the poses that came with a recording: no method of ours.
_FIXED |= {"true": "#009e73", "tracked": "#d55e00", "reference": "#7f7f7f"}
WIDTH = 9.0  # inches of every figure: a notebook's text width
DASHED = {"color": "0.3", "linestyle": "--", "linewidth": 1}
DOTTED = {"color": "0.3", "linestyle": ":", "linewidth": 1.5}


@contextlib.contextmanager
def in_house_style() -> Iterator[None]:
    """Draw in the house style and leave matplotlib's own settings as they were.

    Letters that the font lacks, as in the name of a recording, become boxes without a warning.
    """
    with matplotlib.style.context("nbtrack.plots.house"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")
        yield


styled = in_house_style()
"""The same as a decorator of functions; each call enters the style anew."""


class NotebookFigure(Figure):
    """A figure that a notebook shows once, where a cell ends with it.

    It is not registered with pyplot, which would show it a second time.
    """

    def _repr_mimebundle_(self, **chosen: object) -> tuple[dict, dict]:
        """The metadata of the picture that `_repr_png_` draws; no picture of its own.

        They are the title as alternative text, and the size (pixels) at which it is shown: the
        figure's own, half of the picture's.
        """
        from IPython import get_ipython  # only IPython calls this; it may not be installed

        if shell := get_ipython():
            # Sliders load pyplot's inline backend, which would draw it instead, cropped and small.
            pictures = shell.display_formatter.formatters["image/png"]
            pictures.for_type(NotebookFigure, NotebookFigure._repr_png_)
        width, height = (round(pixels) for pixels in self.bbox.size)
        alt = self.get_suptitle().replace("\n", " ")
        return {}, {"image/png": {"alt": alt, "width": width, "height": height}}

    def _repr_png_(self) -> bytes:
        """A PNG of twice the figure's resolution, for dense screens.

        It has no transparency and is packed tightly, so that notebooks stay small.
        """
        drawn = io.BytesIO()
        self.savefig(drawn, dpi=2 * self.dpi)
        picture = io.BytesIO()
        Image.open(drawn).convert("RGB").save(picture, "PNG", optimize=True)
        return picture.getvalue()

    @styled
    def legend_below(self) -> "NotebookFigure":
        """Draw the first panel's legend below all panels, for which it holds; returns the figure.

        It has one row, or three columns if its labels are long.
        """
        handles, labels = self.axes[0].get_legend_handles_labels()
        ncols = 3 if len("".join(labels)) > 100 else len(labels)
        self.legend(handles, labels, loc="outside lower center", ncols=ncols, handlelength=3)
        return self


def new_axes(title: str, height: float, rows: int = 1, columns: int = 1, **more: Any) -> np.ndarray:
    """A grid of axes, an array (rows, columns), in a new figure `WIDTH` by `height` (inches).

    A dollar sign of the title, as in the name of a recording, begins no formula. More options are
    those of `Figure.subplots`.
    """
    figure = NotebookFigure(figsize=(WIDTH, height), layout="compressed")
    if title:
        title = title.encode(errors="replace").decode()  # letters that the system's encoding lacks
        figure.suptitle(textwrap.fill(title, 100).replace("$", r"\$"), x=0.01, ha="left")
    return figure.subplots(rows, columns, squeeze=False, **more)


def method_colors(labels: Iterable[str]) -> dict[str, str]:
    """One colour a label: that of its method, if it has one in all figures, else a free one.

    The method is the label, or what it says before its first comma. Free are the colours of the
    palette that no other label has, without the first four, which stand for the paper's methods and
    for LM.
    """
    known = {label: _FIXED.get(label, _FIXED.get(label.split(",")[0])) for label in labels}
    free = cycle([color for color in PALETTE[4:] if color not in known.values()])
    return {label: next(free) if color is None else color for label, color in known.items()}


def label_points(axes: Axes, x: Iterable, y: Iterable, colors: dict[str, str]) -> None:
    """Beside every point its label in its colour, on the right or on the left.

    Colours are by label, in the order of the points. A label that would cover another or leave the
    axes is moved up or down.
    """
    axes.margins(x=0.4, y=0.1)
    axes.figure.draw_without_rendering()  # else the axes have no place in the figure yet
    points = sorted(zip(x, y, colors, strict=True), key=lambda point: point[1])
    pixels = axes.transData.transform([point[:2] for point in points])
    # The points' own marks, in squares of 10 pixels.
    taken = [Bbox.from_bounds(left - 5, bottom - 5, 10, 10) for left, bottom in pixels]
    shifts = sorted(range(-60, 61, 3), key=abs)  # points, up
    for x_point, y_point, label in points:
        text = axes.annotate(label, (x_point, y_point), (0, 0), textcoords="offset points")
        for shift, (aside, align) in product(shifts, [(6, "left"), (-6, "right")]):
            # 3 points lower, half a letter's height: unshifted texts are level with their points.
            text.set(position=(aside, shift - 3), horizontalalignment=align, color=colors[label])
            box = text.get_window_extent()
            is_inside = (box.min > axes.bbox.min).all() and (box.max < axes.bbox.max).all()
            if is_inside and not any(box.overlaps(other) for other in taken):
                break  # else it stays at the farthest
        taken.append(box)


def log_axes(axes: Axes, names: str) -> None:
    """Make the axes that `names` has as letters, "x", "y" or "xy", logarithmic.

    Ticks have plain numbers at 1, 2 and 5; an axis that spans less than a factor of ten has more.
    There are no others, also where a caller sets its own.
    """
    for name in names:
        axes.set(**{f"{name}scale": "log"})
        axis = getattr(axes, f"{name}axis")
        low, high = axis.get_view_interval()
        ticks = LogLocator(subs=(1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 6, 8))
        axis.set(major_locator=ticks, major_formatter="{x:g}", minor_locator=NullLocator())
