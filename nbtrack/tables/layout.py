"""Both tables: as the paper published them, laid out as printed, and ours beside the paper's.

Long form has a row a result and is what experiments and CSV files hold; wide form is the printed
table. Rows follow the data: a new tracker is a new row and nothing here names a method.
"""

from importlib.resources import files

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from nbtrack.core.errors import DataError
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

PAPER_SCENE_LABELS = {
    "breakfast_room": "Breakfast", "complete_kitchen": "Compl. Kitchen",
    "green_room": "Green Room", "grey_white_room": "Grey-white", "kitchen": "Kitchen",
    "morning_apartment": "Morning Apart.", "staircase": "Staircase", "thin_geometry": "Thin Geo.",
    "whiteroom": "Whiteroom",
}  # fmt: skip
"""Folders of the Neural RGB-D dataset and the names that the paper's Table I gives them."""
PAPER_PIXELS = {"VR": 512, "SDF": 4096}
"""The n that the paper's Table II prints in bold: the one used for Table I."""
STANDING_STILL = "standing still"
"""The row of a camera that stays at its first pose, the dullest alternative to any tracker."""
_CELL_1, _CELL_2 = ["rate_hz", "method", "scene"], ["tracker", "n_pixels", "budget_ms"]


def published_table_1() -> pd.DataFrame:
    """The paper's Table I in long form: rate_hz, method, scene, ate_m; 54 rows."""
    return pd.read_csv(files(__package__) / "published_table_1.csv")


def published_table_2() -> pd.DataFrame:
    """The paper's Table II in long form: tracker, n_pixels, budget_ms, steps; 18 rows."""
    return pd.read_csv(files(__package__) / "published_table_2.csv")


def naming_points(results: pd.DataFrame) -> pd.DataFrame:
    """The results of methods that use different numbers of points or pixels, n, named with it."""
    labels = [f"{m}, n = {n}" for m, n in zip(results["method"], results["n_pixels"], strict=True)]
    return results.assign(method=labels)


def average_over_seeds(results: pd.DataFrame) -> pd.DataFrame:
    """Table I in long form from a row for every seed; rates fall, dataset's scenes are labelled.

    Columns are rate_hz, method, scene, ate_m, and seed where there are several: then the column
    ate_std_m is their std (m) as a sample. A cell with a seed that failed is NaN: a
    mean over the others would hide the failure. Where results have a column still_ate_m, the method
    `STANDING_STILL` is added. Raises DataError where a column is missing, there is no row, or two
    rows have one place.
    """
    keys = [*_CELL_1, "seed"] if "seed" in results else _CELL_1
    _check(results, "ate_m", keys)
    if "still_ate_m" in results:
        still = results.dropna(subset="still_ate_m").assign(method=STANDING_STILL)
        still = still.assign(ate_m=still["still_ate_m"]).drop_duplicates(keys)
        results = pd.concat([results, still], ignore_index=True)
    results = results.replace({"scene": PAPER_SCENE_LABELS})
    groups = results.groupby(_CELL_1, sort=False)["ate_m"]
    averaged = groups.mean(skipna=False).to_frame()
    if groups.size().max() > 1:
        averaged["ate_std_m"] = groups.std(skipna=False)
    averaged = averaged.reset_index()
    if "ate_std_m" in averaged:  # who stands still does so with every seed
        averaged.loc[averaged["method"] == STANDING_STILL, "ate_std_m"] = np.nan
    return averaged.sort_values("rate_hz", ascending=False, kind="stable", ignore_index=True)


def table_1(results: pd.DataFrame, value: str = "ate_m") -> pd.DataFrame:
    """Table I as printed: ATE (m), a row per rate and method, a column per scene.

    Results and what is raised: see `average_over_seeds`; for the std over seeds the value is
    "ate_std_m". Methods and scenes keep the order of their first appearance. Every method
    gets a row at every rate; what has no result is NaN.
    """
    cells = average_over_seeds(results)
    wide = _wide(cells, _CELL_1, value)
    rows = [cells["rate_hz"].unique(), cells["method"].unique()]
    index = pd.MultiIndex.from_product(rows, names=_CELL_1[:2])
    return wide.reindex(index=index, columns=cells["scene"].unique())


def table_2(steps: pd.DataFrame, value: str = "steps") -> pd.DataFrame:
    """Table II as printed: mean steps, a row per tracker and n (pixels), a column per budget (ms).

    `steps` has a row for each cell, with columns tracker, n_pixels, budget_ms, steps. With the
    value "steps_std" the table holds the std over frames. Raises DataError as `average_over_seeds`
    does.
    """
    _check(steps, "steps", _CELL_2)
    return _wide(steps, _CELL_2, value).reindex(steps["tracker"].unique(), level="tracker")


def over_rooms(results: pd.DataFrame, by: list[str], value: str = "ate_m") -> pd.DataFrame:
    """Geometric mean of a positive column by groups, and its 95 % interval: columns `from`, `to`.

    A room counts once, with the mean of its seeds' logarithms: rooms differ more than seeds do.
    The interval is Student's of the rooms' logarithms, NaN for a single room (our choice).
    """
    of_rooms = np.log(results.set_index([*by, "scene"])[value])
    rooms = of_rooms.groupby([*by, "scene"], sort=False).mean().groupby(by, sort=False)
    mean, half = rooms.mean(), rooms.sem() * stdtrit(rooms.size() - 1, 0.975)
    return np.exp(pd.DataFrame({value: mean, "from": mean - half, "to": mean + half})).reset_index()


def beside_published(results: pd.DataFrame) -> pd.DataFrame:
    """Our Table I beside the paper's: scene by scene if ours hold scenes of the paper's.

    Errors in different rooms say nothing about each other. Rooms of our own are therefore compared
    in summary only: the median ATE (m), and the share of scenes in which the camera was lost (ATE
    above 0.2 m, or no result).
    """
    ours, paper = table_1(results), table_1(published_table_1())
    if common := [scene for scene in ours if scene in paper]:
        return beside(ours[common], paper)
    sides = {"ours": ours, "paper": paper}
    medians = {("median ATE (m)", side): table.median(axis=1) for side, table in sides.items()}
    lost = {
        ("lost (share of scenes)", side): 1 - (table <= LOST_THRESHOLD_M).mean(axis=1)
        for side, table in sides.items()
    }
    return pd.DataFrame(medians | lost).reindex(ours.index)


def beside(ours: pd.DataFrame, paper: pd.DataFrame) -> pd.DataFrame:
    """Two wide tables in one: ours, the paper's where it has such a row, ours less the paper's."""
    same = paper.reindex(index=ours.index, columns=ours.columns)
    sources = {"ours": ours, "paper": same, "difference": ours - same}
    both = pd.concat(sources, names=["source"]).reorder_levels([1, 2, 0])
    rows = [(*row, s) for row in ours.index for s in sources if s == "ours" or row in paper.index]
    return both.loc[rows]


def _wide(cells: pd.DataFrame, keys: list[str], value: str) -> pd.DataFrame:
    """The last key across, the others down; a value that there is not is NaN."""
    cells = cells.reindex(columns=[*keys, value])
    return cells.pivot(index=keys[:2], columns=keys[2], values=value).astype(float)


def _check(cells: pd.DataFrame, value: str, keys: list[str]) -> None:
    if not {*keys, value} <= set(cells.columns) or cells.empty:
        raise DataError(
            f"a table of {len(cells)} rows with columns {', '.join(map(str, cells.columns))}; "
            f"expected at least one row with {', '.join([*keys, value])}; run the experiments first"
        )
    twice = cells[cells.duplicated(keys)]
    if len(twice):
        cell = ", ".join(str(key) for key in twice[keys].iloc[0])
        raise DataError(f"two rows for ({cell}); allowed: one per cell; remove one of them")
