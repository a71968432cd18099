"""The paper's tables: long DataFrames in; wide DataFrames, styled HTML, LaTeX and CSV out.

Long form has a row a result and is what experiments and CSV files hold; wide form is the printed
table. Rows follow the data: a new tracker is a new row and nothing here names a method.
"""

import html
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.io.formats.style import Styler

from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.latex import OUR_WORDING, Wording, latex_file
from nbtrack.machinery.errors import DataError, look_up
from nbtrack.machinery.files import fingerprint, write_atomic
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

PAPER_PIXELS = {"VR": 512, "SDF": 4096}
"""The n that the paper's Table II prints in bold: the one used for Table I."""
STANDING_STILL = "standing still"
"""The row of a camera that stays at its first pose, the dullest alternative to any tracker."""
CONVERGED = "‡"  # in Table II: a tracker needed no more steps
_CELL_1 = ["rate_hz", "method", "scene"]
_CELL_2 = ["tracker", "n_pixels", "budget_ms"]
_MISSING = "–"
_BOLD = "font-weight: bold;"
_LEGEND = f"bold: best at this rate; † and red: above {LOST_THRESHOLD_M:g} m"
_UNITS = {"m": (1, "{:.3f}"), "mm": (1000, "{:.1f}")}  # of an ATE, and how it is printed


def published_table_1() -> pd.DataFrame:
    """The paper's Table I in long form: rate_hz, method, scene, ate_m; 54 rows."""
    return pd.read_csv(files(__package__) / "published/table_1.csv")


def published_table_2() -> pd.DataFrame:
    """The paper's Table II in long form: tracker, n_pixels, budget_ms, steps; 18 rows."""
    return pd.read_csv(files(__package__) / "published/table_2.csv")


def naming_points(results: pd.DataFrame) -> pd.DataFrame:
    """The results with n (points or pixels) in their methods' names, as "LM, n = 4096"."""
    both = zip(results["method"], results["n_pixels"], strict=True)
    return results.assign(method=[f"{m.removesuffix(f', {n}')}, n = {n}" for m, n in both])


def average_over_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Table I in long form, from results with a row for each cell and seed: means over the seeds.

    Columns are rate_hz (falling), method, scene (the dataset's by their printed names), ate_m, and
    with several seeds ate_std_m, their sample std (m). A cell with a failed seed is NaN: a mean of
    the others would hide the failure. A column still_ate_m in the results adds the method
    `STANDING_STILL`. Raises DataError where two rows are of one cell and seed.
    """
    keys = [*_CELL_1, "seed"] if "seed" in results else _CELL_1
    _refuse_doubles(results, keys)
    if "still_ate_m" in results:
        still = results.dropna(subset="still_ate_m").assign(method=STANDING_STILL)
        still = still.assign(ate_m=still["still_ate_m"]).drop_duplicates(keys)
        results = pd.concat([results, still], ignore_index=True)
    results = results.replace({"scene": DATASET_SCENES})
    groups = results.groupby(_CELL_1, sort=False)["ate_m"]
    averaged = groups.mean(skipna=False).reset_index()
    if groups.size().max() > 1:
        spread = groups.std(skipna=False).to_numpy()  # standing still does not depend on a seed
        averaged["ate_std_m"] = np.where(averaged["method"] == STANDING_STILL, np.nan, spread)
    return averaged.sort_values("rate_hz", ascending=False, kind="stable", ignore_index=True)


def table_1(results: pd.DataFrame, value: str = "ate_m") -> pd.DataFrame:
    """Table I as printed: ATE (m), a row per rate and method, a column per scene.

    Results and errors are those of `average_over_seeds`. With the value "ate_std_m" the table holds
    the std over seeds. Methods and scenes keep the order of their first appearance. Every method
    gets a row at every rate; what has no result is NaN.
    """
    cells = average_over_seeds(results)
    rates, methods = cells["rate_hz"].unique(), cells["method"].unique()
    index = pd.MultiIndex.from_product([rates, methods], names=_CELL_1[:2])
    return _wide(cells, _CELL_1, value).reindex(index=index, columns=cells["scene"].unique())


def table_2(steps: pd.DataFrame, value: str = "steps") -> pd.DataFrame:
    """Table II as printed: mean steps, a row per tracker and n (pixels), a column per budget (ms).

    `steps` has a row for each cell, with columns tracker, n_pixels, budget_ms, steps. With the
    value "steps_std" the table holds the std over frames. Raises DataError for two rows of a cell.
    """
    _refuse_doubles(steps, _CELL_2)
    return _wide(steps, _CELL_2, value).reindex(steps["tracker"].unique(), level="tracker")


def beside_published(results: pd.DataFrame) -> pd.DataFrame:
    """Our Table I beside the paper's: scene by scene where ours has scenes of the paper.

    Errors in different rooms say nothing about each other. Of our own rooms a summary is compared:
    the median ATE (m), and the share of scenes where it is above 0.2 m, or there is no result. That
    follows the digits printed, as the marks of `style_table_1` do.
    """
    ours, paper = table_1(results), table_1(published_table_1())
    common = [scene for scene in ours if scene in paper]
    if common:
        return beside(ours[common], paper)
    sides = {"ours": ours, "paper": paper}
    summary = {("median ATE (m)", side): table.median(axis=1) for side, table in sides.items()}
    for side, table in sides.items():
        is_followed = table.round(3) <= LOST_THRESHOLD_M
        summary["lost (share of scenes)", side] = 1 - is_followed.mean(axis=1)
    return pd.DataFrame(summary).reindex(ours.index)


def beside(ours: pd.DataFrame, paper: pd.DataFrame) -> pd.DataFrame:
    """Two wide tables in one: below each row of ours the paper's, and ours less the paper's."""
    same = paper.reindex(index=ours.index, columns=ours.columns)
    sources = {"ours": ours, "paper": same, "difference": ours - same}
    both = pd.concat(sources, names=["source"]).reorder_levels([1, 2, 0])
    rows = []
    for row in ours.index:  # ours stands alone where the paper has no such row
        rows += [(*row, source) for source in (sources if row in paper.index else ["ours"])]
    return both.loc[rows]


def _wide(cells: pd.DataFrame, keys: list[str], value: str) -> pd.DataFrame:
    """Long to wide form: columns by the third key, rows by the first two, gaps NaN."""
    cells = cells.reindex(columns=[*keys, value])  # a value such as ate_std_m may be missing
    return cells.pivot(index=keys[:2], columns=keys[2], values=value).astype(float)


def _refuse_doubles(cells: pd.DataFrame, keys: list[str]) -> None:
    """Raises DataError where these columns are not all there, or two rows have the same of them."""
    if not {*keys} <= {*cells}:
        raise DataError(f"a table has the columns {[*cells]}: it needs {', '.join(keys)}")
    twice = cells[cells.duplicated(keys)]
    if len(twice):
        cell = ", ".join(str(key) for key in twice[keys].iloc[0])
        raise DataError(f"two rows for ({cell}); allowed: one per cell; remove one of them")


@dataclass(frozen=True)
class Cell:
    """A number as it is printed, perhaps with a std, and its marks.

    The marks are in its text too: pages that do not trust a notebook drop its style sheets.
    """

    value: str
    std: str = ""
    is_best: bool = False
    is_lost: bool = False

    def __str__(self) -> str:
        return f"{self.value} ± {self.std}" if self.std else self.value

    def css(self) -> str:
        """Its declarations in a style sheet."""
        return ("color: red;" if self.is_lost else "") + (_BOLD if self.is_best else "")

    def html(self) -> str:
        """Its content as HTML, with a dagger and bold type as marks."""
        text = f"{self} †" if self.is_lost else str(self)
        return f"<b>{text}</b>" if self.is_best else text


class TableStyler(Styler):
    """A styled table of cells; its plain-text form is the table itself, equal in every run."""

    unit = "m"  # of an ATE
    default_pixels = PAPER_PIXELS  # of Table II

    def __repr__(self) -> str:
        return self.data.map(str).to_string()


def style_table_1(
    results: pd.DataFrame, caption: str | None = None, unit: str = "m"
) -> TableStyler:
    """Table I, mean ± std over seeds: best bold, above 0.2 m red with a dagger, missing "–".

    Both marks follow the digits printed, three in m and one in mm: values equal to the last digit
    are equally good. A value without a rival at its rate is not bold. Raises ConfigError for
    another unit. Source: caption of the paper's Table I.
    """
    scale, form = look_up("unit", unit, _UNITS)
    shown = (scale * table_1(results)).map(lambda value: float(form.format(value)))
    rivals = shown.groupby(level="rate_hz")
    is_best = (shown == rivals.transform("min")) & (rivals.transform("count") > 1)
    stds = _texts(scale * table_1(results, "ate_std_m"), form)
    styler = _styled(_texts(shown, form, _MISSING), stds, is_best, shown > scale * LOST_THRESHOLD_M)
    styler.unit = unit
    styler.format_index("{:g} Hz", level="rate_hz")
    styler.format_index(escape="html", level="method").format_index(escape="html", axis="columns")
    return _labelled(styler, caption, _LEGEND)


def style_table_2(
    steps: pd.DataFrame, caption: str | None = None, default_pixels: dict[str, int] = PAPER_PIXELS
) -> TableStyler:
    """Table II, mean ± std over frames; rows of whole numbers without a std have no decimals.

    Steps are marked where the column `converged` is true. The default pixels of each tracker, the n
    used for Table I, are printed bold with an asterisk.
    """
    wide, stds = table_2(steps), table_2(steps, "steps_std")
    is_whole = (wide.isna() | (wide % 1 == 0)).all(axis=1) & stds.isna().all(axis=1)
    texts = _texts(wide, "{:.1f}", _MISSING)
    texts[is_whole] = _texts(wide[is_whole], "{:.0f}", _MISSING)
    has_ended = table_2(steps, "converged") == 1
    texts = texts.mask(has_ended, texts + CONVERGED)
    styler = _styled(texts, _texts(stds, "{:.1f}"), is_best=False, is_lost=False)
    styler.default_pixels = default_pixels
    is_default = [default_pixels.get(tracker) == n for tracker, n in wide.index]
    styler.format_index("{:g} ms", axis="columns")
    labels = ["<b>{} *</b>" if default else "{}" for default in is_default]
    styler.relabel_index(labels, level="n_pixels")
    # Notebooks show every row label in bold, so the others are set to normal weight.
    weights = [_BOLD if default else "font-weight: normal;" for default in is_default]
    styler.apply_index(lambda labels: weights, axis="index", level="n_pixels")
    ended = f"; {CONVERGED}: until it converged, with time left" if has_ended.any(axis=None) else ""
    return _labelled(styler, caption, f"* and bold: the n used for tracking{ended}")


def _texts(wide: pd.DataFrame, form: str, missing: str = "") -> pd.DataFrame:
    """Numbers as texts by a format such as `{:.3f}`; NaN as the text `missing`."""
    return wide.map(lambda value: missing if pd.isna(value) else form.format(value))


def _styled(texts: pd.DataFrame, stds: pd.DataFrame, is_best: Any, is_lost: Any) -> TableStyler:
    """A styled table of `Cell`s; marks are tables of the shape of the texts, or a flag for all."""
    cells = np.vectorize(Cell, otypes=[object])(texts, stds, is_best, is_lost)
    styler = TableStyler(pd.DataFrame(cells, texts.index, texts.columns))
    return styler.format(Cell.html).map(Cell.css)


def _labelled(styler: TableStyler, caption: str | None, legend: str) -> TableStyler:
    """The styler, given a caption that explains the marks, and an id from all that it shows.

    A page's style sheets go by ids: tables that share one would colour each other.
    """
    styler.set_caption(html.escape(f"{caption}; {legend}" if caption else legend))
    return styler.set_uuid(fingerprint(styler.set_uuid("table").to_html()))


def write_tables(
    folder: Path,
    results: pd.DataFrame,
    steps: pd.DataFrame,
    note: str,
    default_pixels: dict[str, int] = PAPER_PIXELS,
    steps_note: str | None = None,
    own: Wording = OUR_WORDING,
) -> list[Path]:
    """Writes Tables I and II as CSV (long form), LaTeX, and beside the paper's; returns the paths.

    The arguments are those of `table_1`, `table_2`, `latex_file` and `style_table_2`. Table II is
    always measured by the clock and may have a note of its own.
    """
    styled = style_table_2(steps, default_pixels=default_pixels)
    both = beside(table_2(steps), table_2(published_table_2()))
    paths = write_table_1(folder, results, note, own)
    return paths + _write_table(folder / "table_2", steps, styled, steps_note or note, own, both)


def write_table_1(
    folder: Path, results: pd.DataFrame, note: str, own: Wording = OUR_WORDING
) -> list[Path]:
    """Writes Table I alone as CSV, LaTeX, and beside the paper's; see `write_tables`."""
    cells, styled = average_over_seeds(results), style_table_1(results)
    return _write_table(folder / "table_1", cells, styled, note, own, beside_published(results))


def write_table_3(
    folder: Path, results: pd.DataFrame, note: str, own: Wording = OUR_WORDING
) -> list[Path]:
    """Writes Table III, Table I with other rows and in mm, as CSV and LaTeX; see `write_tables`."""
    results = naming_points(results)  # with more points a frame it is another method
    cells, styled = average_over_seeds(results), style_table_1(results, unit="mm")
    return _write_table(folder / "table_3", cells, styled, note, own)


def _write_table(
    stem: Path, cells: pd.DataFrame, styler: TableStyler, note: str, own: Wording, *compared: Any
) -> list[Path]:
    """Write a table as CSV, as LaTeX and, if given, `compared` with the paper's; their paths."""
    path = stem.with_suffix(".tex")
    write_atomic(path, latex_file(styler, path, note, own))
    beside_it = stem.with_name(f"{stem.name}_vs_paper.csv")
    paths = [write_csv(beside_it, table, index=True) for table in compared]
    return [write_csv(stem.with_suffix(".csv"), cells), path, *paths]


def write_csv(path: Path, table: pd.DataFrame, **options: Any) -> Path:
    """Writes a table as CSV, by default without its index and with six digits; returns the path."""
    options = {"index": False, "float_format": "%.6g", "lineterminator": "\n", **options}
    write_atomic(path, table.to_csv(**options))
    return path
