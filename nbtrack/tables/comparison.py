"""Our tables beside the published ones, with the difference."""

from pathlib import Path

import pandas as pd

from nbtrack.core.errors import DataError
from nbtrack.core.files import write_text_atomic
from nbtrack.tables.layout import (
    PAPER_SCENE_LABELS,
    published_table_1,
    published_table_2,
    table_1,
    table_2,
)
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

OURS, PAPER, DIFFERENCE = "ours", "paper", "difference"


def compare_table_1(ours: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    """Two wide Tables I in one: our row, the published one where there is one, the difference.

    The index gains a level `source`: "ours", "paper" and, ours less the paper's, "difference".
    Columns are the scenes that both have.

    Raises:
        DataError: no scene is in both. Errors in different rooms say nothing about each other.
    """
    common = [scene for scene in ours.columns if scene in published.columns]
    if not common:
        raise DataError(
            f"our scenes are {', '.join(ours.columns)}; comparable are results in "
            f"{', '.join(published.columns)}; see summarize_table_1"
        )
    return _beside(ours[common], published[common])


def compare_table_2(ours: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    """Two wide Tables II in one, as `compare_table_1`; where the paper has no such budget, NaN."""
    return _beside(ours, published.reindex(columns=ours.columns))


def summarize_table_1(cells: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    """What two Tables I of different scenes can say about each other: a row a rate and method.

    Columns, ours and the paper's: the median ATE (m) over scenes, and the share of scenes in which
    the camera was lost (ATE above 0.2 m, or no result).

    Args:
        cells, published: long form, see `nbtrack.tables.layout`.
    """
    sides = {OURS: cells, PAPER: published}
    groups = {
        side: table.groupby(["rate_hz", "method"], sort=False)["ate_m"]
        for side, table in sides.items()
    }
    columns = {("median ATE (m)", side): group.median() for side, group in groups.items()}
    columns |= {
        ("lost (share of scenes)", side): group.agg(_share_lost) for side, group in groups.items()
    }
    return pd.DataFrame(columns).reindex(table_1(cells).index)


def beside_published(cells_1: pd.DataFrame) -> pd.DataFrame:
    """Our Table I beside the paper's: scene by scene if it has ours, else in summary.

    Args:
        cells_1: long form, see `nbtrack.tables.layout`.
    """
    published = published_table_1()
    if set(cells_1["scene"]) & {*PAPER_SCENE_LABELS, *PAPER_SCENE_LABELS.values()}:
        return compare_table_1(table_1(cells_1), table_1(published))
    return summarize_table_1(cells_1, published)


def write_comparisons(folder: Path, cells_1: pd.DataFrame, cells_2: pd.DataFrame) -> list[Path]:
    """Writes table_1_vs_paper.csv and table_2_vs_paper.csv; returns their paths.

    Args:
        folder: made if missing.
        cells_1, cells_2: long form, see `nbtrack.tables.layout`.
    """
    tables = {
        "table_1_vs_paper.csv": beside_published(cells_1),
        "table_2_vs_paper.csv": compare_table_2(table_2(cells_2), table_2(published_table_2())),
    }
    for name, table in tables.items():
        text = table.to_csv(float_format="%.6g", lineterminator="\n")
        write_text_atomic(Path(folder) / name, text)
    return [Path(folder) / name for name in tables]


def _share_lost(ate_m: pd.Series) -> float:
    return float(1 - (ate_m <= LOST_THRESHOLD_M).mean())


def _beside(ours: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    parts = {OURS: ours, PAPER: published, DIFFERENCE: ours - published.reindex(ours.index)}
    both = pd.concat(parts, names=["source"])
    order = [
        (*row, source)
        for row in ours.index
        for source in (OURS, PAPER, DIFFERENCE)
        if source == OURS or row in published.index
    ]
    return both.reorder_levels([*ours.index.names, "source"]).loc[order]
