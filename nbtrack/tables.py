"""The paper's tables: long DataFrames in; wide DataFrames, styled HTML, LaTeX and CSV out.

A row of the long form is one result. The wide form is printed: a new tracker is a new row of it.
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
"""The n (points or pixels) that the paper uses for Table I, and prints in bold in Table II."""
STANDING_STILL = "standing still"
"""The method name of a camera that stays at its first pose: the baseline of every tracker."""
CONVERGED = "‡"  # marks steps in Table II after which the tracker had converged
_CELL_1 = ["rate_hz", "method", "scene"]
_CELL_2 = ["tracker", "n_pixels", "budget_ms"]
_HEADS = {"rate_hz": "rate (Hz)", "n_pixels": "pixels a step", "budget_ms": "time a frame (ms)"}
_MISSING = "–"
_BOLD = "font-weight: bold;"
_LEGEND = f"bold: best at this rate; † and red: above {LOST_THRESHOLD_M:g} m"
_UNITS = {"m": (1, "{:.3f}"), "mm": (1000, "{:.1f}")}  # units per metre, and format of an ATE


def published_table_1() -> pd.DataFrame:
    """The paper's Table I in long form: rate_hz, method, scene, ate_m; 54 rows."""
    return pd.read_csv(files(__package__) / "published/table_1.csv")


def published_table_2() -> pd.DataFrame:
    """The paper's Table II in long form: tracker, n_pixels, budget_ms, steps; 18 rows."""
    return pd.read_csv(files(__package__) / "published/table_2.csv")


def naming_points(results: pd.DataFrame) -> pd.DataFrame:
    """Adds n (points or pixels) to the methods' names: "LM" and "LM, 4096" give "LM, n = 4096"."""
    names_and_n = zip(results["method"], results["n_pixels"], strict=True)
    return results.assign(method=[f"{m.removesuffix(f', {n}')}, n = {n}" for m, n in names_and_n])


def average_over_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Table I in long form: means over seeds of results that have a row for each cell and seed.

    Columns are rate_hz (descending), method, scene (those of the dataset as the paper prints them),
    ate_m and, for several seeds, ate_std_m, the sample std (m). A cell with a failed seed is NaN:
    the mean of the others would hide the failure. If the results have a column still_ate_m, it
    becomes the method `STANDING_STILL`. Raises DataError as `_check_keys` does, for cell and seed.
    """
    keys = [*_CELL_1, "seed"] if "seed" in results else _CELL_1
    _check_keys(results, keys)
    if "still_ate_m" in results:
        still = results.dropna(subset="still_ate_m").assign(method=STANDING_STILL)
        still = still.assign(ate_m=still["still_ate_m"]).drop_duplicates(keys)
        results = pd.concat([results, still], ignore_index=True)
    results = results.replace({"scene": DATASET_SCENES})
    groups = results.groupby(_CELL_1, sort=False)["ate_m"]
    averaged = groups.mean(skipna=False).reset_index()
    if groups.size().max() > 1:
        stds = groups.std(skipna=False).to_numpy()  # standing still depends on no seed
        averaged["ate_std_m"] = np.where(averaged["method"] == STANDING_STILL, np.nan, stds)
    return averaged.sort_values("rate_hz", ascending=False, kind="stable", ignore_index=True)


def table_1(results: pd.DataFrame, value: str = "ate_m") -> pd.DataFrame:
    """Table I in wide form: ATE (m), a row per rate and method, a column per scene.

    Takes results and raises errors as `average_over_seeds` does. With the value "ate_std_m" cells
    hold the std over seeds. Methods and scenes keep the order of their first appearance. Every
    method has a row at every rate; cells without a result are NaN.
    """
    cells = average_over_seeds(results)
    rates, methods = cells["rate_hz"].unique(), cells["method"].unique()
    index = pd.MultiIndex.from_product([rates, methods], names=_CELL_1[:2])
    return _wide(cells, _CELL_1, value).reindex(index=index, columns=cells["scene"].unique())


def table_2(steps: pd.DataFrame, value: str = "steps") -> pd.DataFrame:
    """Table II in wide form: mean steps, a row per tracker and n, a column per budget (ms).

    `steps` has a row for each cell, with columns tracker, n_pixels, budget_ms, steps. With the
    value "steps_std" cells hold the std over repetitions. Raises DataError for two rows of a cell.
    """
    _check_keys(steps, _CELL_2)
    return _wide(steps, _CELL_2, value).reindex(steps["tracker"].unique(), level="tracker")


def beside_published(results: pd.DataFrame) -> pd.DataFrame:
    """Our Table I compared with the paper's: cell by cell, if the two have scenes in common.

    Otherwise cells cannot be compared, since they are errors in different rooms. The result then
    has for each row the median ATE (m) and the share of lost scenes. A scene is lost if its ATE, as
    printed with three digits, is above 0.2 m, or if it has no result.
    """
    ours, paper = table_1(results), table_1(published_table_1())
    if common := [scene for scene in ours if scene in paper]:
        return beside(ours[common], paper)
    sides = {"ours": ours, "paper": paper}
    summary = {("median ATE (m)", side): table.median(axis=1) for side, table in sides.items()}
    for side, table in sides.items():
        is_followed = table.round(3) <= LOST_THRESHOLD_M
        summary["lost (share of scenes)", side] = 1 - is_followed.mean(axis=1)
    return pd.DataFrame(summary).reindex(ours.index)


def beside(ours: pd.DataFrame, paper: pd.DataFrame) -> pd.DataFrame:
    """Our wide table, with each row followed by the paper's row and by the difference of both."""
    published = paper.reindex(index=ours.index, columns=ours.columns)
    sources = {"ours": ours, "paper": published, "difference": ours - published}
    stacked = pd.concat(sources, names=["source"]).reorder_levels([1, 2, 0])
    rows = []
    for row in ours.index:  # a row that the paper does not have stands alone
        rows += [(*row, source) for source in (sources if row in paper.index else ["ours"])]
    return stacked.loc[rows]


def _wide(cells: pd.DataFrame, keys: list[str], value: str) -> pd.DataFrame:
    """Long to wide form: the first two keys give rows, the third columns; missing cells are NaN."""
    cells = cells.reindex(columns=[*keys, value])  # a column such as ate_std_m may be missing
    return cells.pivot(index=keys[:2], columns=keys[2], values=value).astype(float)


def _check_keys(cells: pd.DataFrame, keys: list[str]) -> None:
    """Raises DataError if a key column is missing, or if two rows have the same keys."""
    if not {*keys} <= {*cells}:
        raise DataError(f"a table has the columns {[*cells]}: it needs {', '.join(keys)}")
    if len(twice := cells[cells.duplicated(keys)]):
        cell = ", ".join(str(key) for key in twice[keys].iloc[0])
        raise DataError(f"two rows for ({cell}); allowed: one per cell; remove one of them")


@dataclass(frozen=True)
class Cell:
    """A number as it is printed, perhaps with a std, and its marks.

    Marks are both CSS and HTML text, since pages that do not trust a notebook drop style sheets.
    """

    value: str
    std: str = ""
    is_best: bool = False
    is_lost: bool = False

    def __str__(self) -> str:
        return f"{self.value} ± {self.std}" if self.std else self.value

    def css(self) -> str:
        """The marks as CSS declarations."""
        return ("color: red;" if self.is_lost else "") + (_BOLD if self.is_best else "")

    def html(self) -> str:
        """The text as HTML, with a dagger if lost and in bold if best."""
        text = f"{self} †" if self.is_lost else str(self)
        return f"<b>{text}</b>" if self.is_best else text


class TableStyler(Styler):
    """A styled table of `Cell`s. As plain text it has the page's labels, the same in every run."""

    unit = "m"  # of the ATEs in Table I or III
    default_pixels = PAPER_PIXELS  # the n of each tracker that Table II prints in bold

    def __repr__(self) -> str:
        return self.data.map(str).rename(index=_label, columns=_label).to_string()


def style_table_1(
    results: pd.DataFrame, caption: str | None = None, unit: str = "m"
) -> TableStyler:
    """Table I, mean ± std over seeds: best bold, above 0.2 m red with a dagger, missing "–".

    Marks depend on the digits printed, three in m, one in mm. A value without a rival in its scene
    at its rate is not bold. ConfigError: another unit. Source: caption of the paper's Table I.
    """
    scale, form = look_up("unit", unit, _UNITS)
    shown = (scale * table_1(results)).map(lambda value: float(form.format(value)))
    rivals = shown.groupby(level="rate_hz")
    is_best = (shown == rivals.transform("min")) & (rivals.transform("count") > 1)
    stds = _texts(scale * table_1(results, "ate_std_m"), form)
    styler = _styled(_texts(shown, form, _MISSING), stds, is_best, shown > scale * LOST_THRESHOLD_M)
    styler.unit = unit
    return _labelled(styler, caption, _LEGEND)


def style_table_2(
    steps: pd.DataFrame, caption: str | None = None, default_pixels: dict[str, int] = PAPER_PIXELS
) -> TableStyler:
    """Table II, mean ± std over repetitions; rows of whole numbers without a std have no decimals.

    Cells whose `converged` is true in `steps` are marked with `CONVERGED`. Each tracker's default
    pixels, the n used for Table I, are printed in bold with an asterisk.
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
    # Braces stand for the label. Notebooks show all labels in bold: the others get normal weight.
    styler.relabel_index(["<b>{} *</b>" if bold else "{}" for bold in is_default], level=1)
    weights = [_BOLD if default else "font-weight: normal;" for default in is_default]
    styler.apply_index(lambda labels: weights, axis="index", level=1)
    ended = f"; {CONVERGED}: until it converged, with time left" if has_ended.any(axis=None) else ""
    return _labelled(styler, caption, f"* and bold: the n used for tracking{ended}")


def _texts(wide: pd.DataFrame, form: str, missing: str = "") -> pd.DataFrame:
    """The numbers as texts: formatted by `form`, such as `{:.3f}`, and `missing` for NaN."""
    return wide.map(lambda value: missing if pd.isna(value) else form.format(value))


def _styled(texts: pd.DataFrame, stds: pd.DataFrame, is_best: Any, is_lost: Any) -> TableStyler:
    """A styled table of `Cell`s; marks are tables of flags shaped as `texts`, or one flag each."""
    cells = np.vectorize(Cell, otypes=[object])(texts, stds, is_best, is_lost)
    table = pd.DataFrame(cells, texts.index, texts.columns)
    styler = TableStyler(table.rename_axis(index=_HEADS, columns=_HEADS.get))  # none for scenes
    styler.format_index(_label, escape="html").format_index(_label, escape="html", axis="columns")
    return styler.format(Cell.html).map(Cell.css)


def _label(label: object) -> str:
    """The label of a row or column as text: 10.0 is 10, and a scene's name has spaces."""
    return f"{label:g}" if isinstance(label, float) else str(label).replace("_", " ")


def _labelled(styler: TableStyler, caption: str | None, legend: str) -> TableStyler:
    """The styler, given a caption that explains its marks, and an id hashed from its content.

    Style sheets refer to ids: two tables in a page with the same id would colour each other.
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
    wording: Wording = OUR_WORDING,
) -> list[Path]:
    """Writes Tables I and II as CSV (long form), LaTeX, and CSV beside the paper's numbers.

    Takes the arguments of `table_1`, `table_2`, `latex_file` and `style_table_2`; returns the
    paths. Table II, which is always measured by the clock, may have its own note, `steps_note`.
    """
    styled = style_table_2(steps, default_pixels=default_pixels)
    both = beside(table_2(steps), table_2(published_table_2()))
    paths = write_table_1(folder, results, note, wording)
    paths += _write_table(folder / "table_2", steps, styled, steps_note or note, wording)
    return [*paths, write_csv(folder / "table_2_vs_paper.csv", both, index=True)]


def write_table_1(
    folder: Path, results: pd.DataFrame, note: str, wording: Wording = OUR_WORDING
) -> list[Path]:
    """Writes Table I alone as CSV, LaTeX, and CSV beside the paper's numbers; returns the paths."""
    styled, both = style_table_1(results), beside_published(results)
    paths = _write_table(folder / "table_1", average_over_seeds(results), styled, note, wording)
    return [*paths, write_csv(folder / "table_1_vs_paper.csv", both, index=True)]


def write_table_3(
    folder: Path, results: pd.DataFrame, note: str, wording: Wording = OUR_WORDING
) -> list[Path]:
    """Writes Table III, the methods beyond the paper, as CSV (m) and LaTeX (mm); returns paths."""
    results = naming_points(results)  # results with different n must not be averaged
    cells, styled = average_over_seeds(results), style_table_1(results, unit="mm")
    return _write_table(folder / "table_3", cells, styled, note, wording)


def _write_table(
    stem: Path, cells: pd.DataFrame, styler: TableStyler, note: str, wording: Wording
) -> list[Path]:
    """Writes a table as CSV (long form) and as LaTeX; returns the paths."""
    path = stem.with_suffix(".tex")
    write_atomic(path, latex_file(styler, path, note, wording))
    return [write_csv(stem.with_suffix(".csv"), cells), path]


def write_csv(path: Path, table: pd.DataFrame, **options: Any) -> Path:
    """Writes a table as CSV, by default without its index and with six digits; returns the path."""
    options = {"index": False, "float_format": "%.6g", "lineterminator": "\n", **options}
    write_atomic(path, table.to_csv(**options))
    return path
