"""Both tables of the paper as DataFrames: long and wide form, and what is bold and red.

Long form has one value a row and is what CSV files hold; wide form is laid out as printed. Rows
follow the data, so a new tracker is a new row and nothing here names a method.
"""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.paths import PAPER_TABLES
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

COLUMNS_1 = ("rate_hz", "method", "scene", "ate_m")
COLUMNS_2 = ("tracker", "n_pixels", "budget_ms", "steps")

PAPER_SCENE_LABELS = {
    "breakfast_room": "Breakfast",
    "complete_kitchen": "Compl. Kitchen",
    "green_room": "Green Room",
    "grey_white_room": "Grey-white",
    "kitchen": "Kitchen",
    "morning_apartment": "Morning Apart.",
    "staircase": "Staircase",
    "thin_geometry": "Thin Geo.",
    "whiteroom": "Whiteroom",
}
"""Folders of the Neural RGB-D dataset and the names that the paper's Table I gives them."""

PAPER_PIXELS = {"VR": 512, "SDF": 4096}
"""The n that the paper's Table II prints in bold: the one used for Table I."""

MISSING_CELL = "–"


def published_table_1() -> pd.DataFrame:
    """The paper's Table I in long form: rate (Hz), method, scene, ATE (m); 54 rows."""
    return read_table(PAPER_TABLES / "published_table_1.csv", COLUMNS_1)


def published_table_2() -> pd.DataFrame:
    """The paper's Table II in long form: tracker, n (pixels), budget (ms), steps; 18 rows."""
    return read_table(PAPER_TABLES / "published_table_2.csv", COLUMNS_2)


def read_table(path: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    """A long table from CSV with exactly these columns; empty cells become NaN.

    Raises:
        MissingError: there is no such file.
        DataError: the columns differ.
    """
    if not path.is_file():
        raise MissingError(
            f"no file {path}; expected a table with columns {', '.join(columns)}; "
            "install the project in place (pip install -e .) or write the tables first"
        )
    cells = pd.read_csv(path)
    _check_columns(cells, columns, str(path))
    return cells[list(columns)]


def table_1(cells: pd.DataFrame, value: str = "ate_m") -> pd.DataFrame:
    """Table I as printed: ATE (m), a row per rate and method, a column per scene.

    Rates fall; methods and scenes keep the order of their first appearance. Every method gets a
    row at every rate: a combination without result is NaN and shown as "–".

    Args:
        cells: long form with columns COLUMNS_1. Scenes named as in the dataset's folders get the
            paper's labels.
        value: the column to lay out.

    Raises:
        DataError: a column is missing, there is no row, or two rows share one cell.
    """
    _check_columns(cells, COLUMNS_1, "table 1")
    cells = cells.assign(scene=cells["scene"].replace(PAPER_SCENE_LABELS))
    wide = _pivot(cells, ["rate_hz", "method"], "scene", value)
    rates = sorted(cells["rate_hz"].unique(), reverse=True)
    rows = pd.MultiIndex.from_product(
        [rates, cells["method"].unique()], names=["rate_hz", "method"]
    )
    return wide.reindex(index=rows, columns=pd.Index(cells["scene"].unique(), name="scene"))


def table_2(cells: pd.DataFrame, value: str = "steps") -> pd.DataFrame:
    """Table II as printed: steps, a row per tracker and n (pixels), a column per budget (ms).

    Trackers keep the order of their first appearance; n and budgets rise.

    Args:
        cells: long form with columns COLUMNS_2.
        value: the column to lay out.

    Raises:
        DataError: as `table_1`.
    """
    _check_columns(cells, COLUMNS_2, "table 2")
    wide = _pivot(cells, ["tracker", "n_pixels"], "budget_ms", value)
    order = [
        (tracker, n_pixels)
        for tracker in cells["tracker"].unique()
        for n_pixels in sorted(wide.loc[tracker].index)
    ]
    return wide.reindex(index=pd.MultiIndex.from_tuples(order, names=["tracker", "n_pixels"]))


def long_form(wide: pd.DataFrame, value: str) -> pd.DataFrame:
    """The inverse of `table_1` and `table_2`, row by row; a missing cell stays, as NaN.

    Args:
        value: name of the value column, "ate_m" or "steps".
    """
    rows = [(*row, column, wide.at[row, column]) for row in wide.index for column in wide.columns]
    return pd.DataFrame(rows, columns=[*wide.index.names, wide.columns.name, value])


def average_over_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Table I in long form from a row for every seed.

    Columns: those of COLUMNS_1 with the mean ATE (m), ate_deviation_m (the standard deviation of
    the seeds as a sample; NaN for one seed), and seeds, their number. A cell with a seed that
    failed is NaN: a mean over the others would hide the failure.

    Args:
        results: long form with columns COLUMNS_1, several rows a cell.
    """
    keys = list(COLUMNS_1[:3])
    groups = results.groupby(keys, sort=False)["ate_m"]
    return pd.DataFrame(
        {
            "ate_m": groups.agg(lambda ate_m: ate_m.mean(skipna=False)),
            "ate_deviation_m": groups.agg(lambda ate_m: ate_m.std(ddof=1, skipna=False)),
            "seeds": groups.size(),
        }
    ).reset_index()


def error_texts(wide: pd.DataFrame, deviation: pd.DataFrame | None = None) -> pd.DataFrame:
    """Table I as strings of three decimals, with "±" and the deviation over seeds if there is one.

    Args:
        wide, deviation: ATE (m) and its deviation as `table_1` lays them out.
    """
    texts = wide.map(lambda value: MISSING_CELL if pd.isna(value) else f"{value:.3f}")
    if deviation is None:
        return texts
    spread = deviation.map(lambda value: "" if pd.isna(value) else f" ± {value:.3f}")
    return texts + spread.reindex(index=wide.index, columns=wide.columns)


def deviations_1(cells: pd.DataFrame) -> pd.DataFrame | None:
    """The deviations (m) over seeds, laid out as `table_1`; None where there was one seed only."""
    if "ate_deviation_m" not in cells or cells["ate_deviation_m"].isna().all():
        return None
    return table_1(cells, "ate_deviation_m")


def deviations_2(cells: pd.DataFrame) -> pd.DataFrame | None:
    """The deviations over frames of the steps, laid out as `table_2`; None where not measured."""
    if "steps_deviation" not in cells:
        return None
    return table_2(cells, "steps_deviation")


def best_cells(wide: pd.DataFrame) -> pd.DataFrame:
    """True where an ATE is the smallest among the methods of one rate and scene: printed bold.

    Values equal to the last printed digit are equally good. A value without a rival is not bold,
    because it was not compared with anything.

    Source: caption of the paper's Table I ("better").
    """
    shown = _as_printed(wide)
    levels = [name for name in wide.index.names if name != "method"]
    groups = shown.groupby(level=levels)
    return (shown == groups.transform("min")) & (groups.transform("count") > 1)


def failed_cells(wide: pd.DataFrame) -> pd.DataFrame:
    """True where the printed ATE is above 0.2 m: printed red. Source: the paper's Table I."""
    return _as_printed(wide) > LOST_THRESHOLD_M


def step_texts(wide: pd.DataFrame, deviation: pd.DataFrame | None = None) -> pd.DataFrame:
    """Table II as strings: one decimal, or none in a row of whole numbers, as the paper prints.

    Args:
        wide: steps as `table_2` lays them out.
        deviation: of the steps over frames; follows after "±" with one decimal.
    """
    decimals = {row: 0 if (wide.loc[row].dropna() % 1 == 0).all() else 1 for row in wide.index}
    texts = {
        row: [MISSING_CELL if pd.isna(v) else f"{v:.{decimals[row]}f}" for v in wide.loc[row]]
        for row in wide.index
    }
    frame = pd.DataFrame.from_dict(texts, orient="index", columns=wide.columns)
    frame = frame.set_axis(wide.index)
    if deviation is None:
        return frame
    spread = deviation.map(lambda value: "" if pd.isna(value) else f" ± {value:.1f}")
    return frame + spread.reindex(index=wide.index, columns=wide.columns)


def is_default(row: tuple[str, int], default_pixels: Mapping[str, int]) -> bool:
    """Whether a row (tracker, n) of Table II has the n that the tracker uses for Table I."""
    tracker, n_pixels = row
    return default_pixels.get(tracker) == n_pixels


def _as_printed(wide: pd.DataFrame) -> pd.DataFrame:
    """Values rounded as they will be read, so that bold and red can be checked from the page."""
    return wide.map(lambda value: float(f"{value:.3f}"))


def _pivot(cells: pd.DataFrame, rows: list[str], column: str, value: str) -> pd.DataFrame:
    keys = [*rows, column]
    twice = cells[cells.duplicated(keys)]
    if len(twice):
        found = ", ".join(str(key) for key in twice[keys].iloc[0])
        raise DataError(f"two rows for ({found}); allowed: one per cell; remove one of them")
    return cells.pivot(index=rows, columns=column, values=value).astype(float)


def _check_columns(cells: pd.DataFrame, columns: tuple[str, ...], where: str) -> None:
    if not set(columns) <= set(cells.columns) or cells.empty:
        raise DataError(
            f"{where} has {len(cells)} rows with columns {', '.join(map(str, cells.columns))}; "
            f"expected at least one row with {', '.join(columns)}; run the experiments first"
        )
