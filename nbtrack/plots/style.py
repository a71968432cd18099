"""The style of all figures: colours by label, axes, and figures without global state."""

import contextlib
import io
import textwrap
import warnings
from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from PIL import Image

PALETTE = "#3b6fb6", "#e08214", "#7b3294", "#17a2a2", "#8c510a", "#c51b7d", "#4d4d4d", "#a6911a"
# The labels that have each colour of the palette in all figures. Rates and sensors have colours
# that belong to no method of the same figure.
_LABELS = (
    ("iMAP with VR", "iMAP", "VR", "at 2 Hz"),
    ("NeuS with SDF", "NeuS", "SDF", "NeuS+ with SDF (Adam)"),
    ("NeuS+ baked (LM)", "NeuS+ (LM)", "NeuS+", "LM"),
    ("NeuS+ corrected (LM)", "NeuS+ corrected", "LM, corrected map", "greedy"),
    ("ICP", "at 5 Hz"),
    ("NeuS+ grid", "at 10 Hz", "most of the bias taken out"),
    ("dataset's sensor",),
)
_FIXED = {label: color for color, labels in zip(PALETTE, _LABELS, strict=False) for label in labels}
# Green and red as in the paper's first figure, in tones that colour-blind readers can tell apart
# (Okabe and Ito). "reference" stands for the poses that came with a recording.
_FIXED |= {"true": "#009e73", "tracked": "#d55e00", "reference": "#7f7f7f"}
WIDTH = 9.0  # inches, the width of every figure: that of a notebook's text
DASHED = {"color": "0.3", "linestyle": "--", "linewidth": 1}
DOTTED = {"color": "0.3", "linestyle": ":", "linewidth": 1.5}


@contextlib.contextmanager
def in_house_style() -> Iterator[None]:
    """A context in which figures have the house style; matplotlib's settings stay unchanged.

    Characters that the font lacks, as in the name of a recording, become boxes without a warning.
    """
    with matplotlib.style.context("nbtrack.plots.house"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")
        yield


styled = in_house_style()
"""`in_house_style` as a decorator: the function draws in the house style."""


class NotebookFigure(Figure):
    """A figure that a notebook shows once, as the last value of a cell.

    It is not registered with pyplot, which would show it a second time.
    """

    def _repr_mimebundle_(self, **chosen: object) -> tuple[dict, dict]:
        """Returns no picture, but the metadata of the picture that `_repr_png_` draws.

        These are the title as alternative text, and the width and height (pixels) at which the
        picture is shown: half of those that it has.
        """
        from IPython import get_ipython  # only IPython calls this method; it may not be installed

        if shell := get_ipython():
            # Sliders load pyplot's inline backend, which registers a cropped, small PNG for every
            # Figure. One that is registered for this class takes precedence.
            pictures = shell.display_formatter.formatters["image/png"]
            pictures.for_type(NotebookFigure, NotebookFigure._repr_png_)
        width, height = (round(pixels) for pixels in self.bbox.size)
        alt = self.get_suptitle().replace("\n", " ").replace(r"\$", "$")
        return {}, {"image/png": {"alt": alt, "width": width, "height": height}}

    def _repr_png_(self) -> bytes:
        """The figure as PNG, with twice its resolution for dense screens.

        The file has no transparency and is compressed well, so that notebooks stay small.
        """
        drawn = io.BytesIO()
        self.savefig(drawn, dpi=2 * self.dpi, format="png")  # whatever a user's rcParams say
        picture = io.BytesIO()
        Image.open(drawn).convert("RGB").save(picture, "PNG", optimize=True)
        return picture.getvalue()

    @styled
    def legend_below(self, panel: int = 0) -> "NotebookFigure":
        """Draw a legend below all panels, from the labels of one of them; returns the figure.

        The legend has one row, or three columns if its labels are long.
        """
        handles, labels = self.axes[panel].get_legend_handles_labels()
        ncols = 3 if len("".join(labels)) > 100 else len(labels)
        self.legend(handles, labels, loc="outside lower center", ncols=ncols, handlelength=3)
        return self


def new_axes(title: str, height: float, rows: int = 1, columns: int = 1, **more: Any) -> np.ndarray:
    """A grid of axes (an array of rows and columns) in a new figure of `WIDTH` by `height` inches.

    `more` are options of `Figure.subplots`. Dollar signs in the title, as in the name of a
    recording, do not mark formulas.
    """
    figure = NotebookFigure(figsize=(WIDTH, height), layout="compressed")
    if title:
        title = title.encode(errors="replace").decode()  # a file's name may be no valid Unicode
        figure.suptitle(textwrap.fill(title, 100).replace("$", r"\$"), x=0.01, ha="left")
    return figure.subplots(rows, columns, squeeze=False, **more)


def method_colors(labels: Iterable[str]) -> dict[str, str]:
    """A colour for each label: that of its method, which is the same in all figures, or a free one.

    The method is the whole label, or the part before its first comma. Free are colours of the
    palette that no given label has, except for the first four, which stand for the paper's methods
    and for LM.
    """
    # None for a label whose method has no colour of its own.
    fixed = {label: _FIXED.get(label, _FIXED.get(label.split(",")[0])) for label in labels}
    free = cycle([color for color in PALETTE[4:] if color not in fixed.values()])
    return {label: next(free) if color is None else color for label, color in fixed.items()}


def log_axes(axes: Axes, names: str) -> None:
    """Make axes logarithmic: those named in `names`, which is "x", "y", "xy" or empty.

    Ticks are at 1, 2 and 5 times powers of ten, with plain numbers. An axis that spans less than a
    factor of ten has more ticks. There are no minor ticks, even if a caller replaces the others.
    """
    for name in names:
        axes.set(**{f"{name}scale": "log"})
        axis = getattr(axes, f"{name}axis")
        low, high = axis.get_view_interval()
        ticks = LogLocator(subs=(1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 6, 8))
        axis.set(major_locator=ticks, major_formatter="{x:g}", minor_locator=NullLocator())
