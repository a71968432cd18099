"""Both tables as notebooks show them: best bold, lost red, and the same HTML every time."""

from collections.abc import Mapping

import pandas as pd
from pandas.io.formats.style import Styler

from nbtrack.tables.layout import (
    PAPER_PIXELS,
    best_cells,
    error_texts,
    failed_cells,
    is_default,
    step_texts,
)

_RED, _BOLD, _PLAIN = "color: red;", "font-weight: bold;", "font-weight: normal;"


class TableStyler(Styler):
    """A styled table whose plain-text form is the table itself, equal in every run."""

    def __repr__(self) -> str:
        return self.data.to_string()


def style_table_1(
    wide: pd.DataFrame, caption: str = "", deviation: pd.DataFrame | None = None
) -> Styler:
    """Table I for notebooks: three decimals, best bold, above 0.2 m red; equal HTML each time.

    Args:
        wide, deviation: ATE (m) and its deviation over seeds, laid out as `table_1` does.
    """
    red = failed_cells(wide).map(lambda failed: _RED if failed else "")
    css = red + best_cells(wide).map(lambda best: _BOLD if best else "")
    texts = error_texts(wide, deviation)
    styler = TableStyler(texts, uuid="table-1", caption=caption or None)
    styler.format_index("{:g} Hz", level="rate_hz")
    return styler.apply(lambda _: css, axis=None)


def style_table_2(
    wide: pd.DataFrame,
    caption: str = "",
    default_pixels: Mapping[str, int] = PAPER_PIXELS,
    deviation: pd.DataFrame | None = None,
) -> Styler:
    """Table II for notebooks; the n that each tracker uses for Table I is bold.

    Args:
        wide, deviation: mean steps and their deviation over frames, laid out as `table_2` does.
    """
    # Notebooks show every row label in bold, so the others must be told not to be.
    weights = [_BOLD if is_default(row, default_pixels) else _PLAIN for row in wide.index]
    styler = TableStyler(step_texts(wide, deviation), uuid="table-2", caption=caption or None)
    styler.format_index("{:g} ms", axis="columns")
    return styler.apply_index(lambda _: weights, axis="index", level="n_pixels")
