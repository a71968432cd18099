"""The tables of benchmarks/README.md, made of the committed CSV files.

    python benchmarks/documents.py

Each stands between a line `<!-- table: NAME -->` and a line `<!-- end -->`; a test holds that they
are what this script writes.
"""

import re
from pathlib import Path

import pandas as pd

from nbtrack.core.files import tables_folder

README = Path(__file__).parent / "README.md"
# Short heads of the methods' columns; LM is that in the corrected NeuS+ map.
_HEADS = {
    "iMAP with VR": "VR",
    "NeuS with SDF": "SDF",
    "NeuS+ baked (LM)": "baked",
    "NeuS corrected (LM)": "NeuS",
    "NeuS+ corrected (LM), sparse": "LM 512",
    "NeuS+ corrected (LM)": "LM 2048",
    "NeuS+ corrected (LM), dense": "LM 4096",
    "ICP": "ICP 512",
    "ICP, 2048": "ICP 2048",
    "ICP, dense": "ICP 4096",
    "standing still": "still",
}


def tracking(runs: pd.DataFrame) -> pd.DataFrame:
    """ATE (cm) of every method in each place, and of a camera that stands still."""
    still = runs.assign(method="standing still", ate_m=runs["still_ate_m"])
    runs = pd.concat([runs, still])
    path = runs["path"].replace({"mapped": "", "second": ", 2nd"})
    path = path.replace("odd, mapped even", ", even mapped")
    runs["place"] = runs["scene"] + path + ", `" + runs["frames"] + "`"
    cm = 100 * runs.pivot_table(index="place", columns="method", values="ate_m", sort=False)
    return cm[[*_HEADS]].rename(columns=_HEADS).map(_number)


def _number(value: float) -> str:
    return "" if pd.isna(value) else f"{value:.2f}"


def searches(rows: pd.DataFrame) -> pd.DataFrame:
    """Shares of starts that were found, and how often the tracker's verdict was right."""
    wrong = (rows["error_m"] > 0.05) | (rows["error_deg"] > 3)
    rows = rows.assign(told=rows["lost"] & wrong, wrong=wrong, alarm=rows["lost"] & ~wrong)
    columns = {"recovered": "found", "wrong": "wrong", "told": "called lost", "alarm": "in vain"}
    groups = rows.groupby(["scene", "offset"], sort=False)
    counts = groups[[*columns]].sum().astype(int).rename(columns=columns)
    counts.insert(0, "searches", groups.size())
    return counts.set_axis([": ".join(place) for place in counts.index]).astype(str)


def times(medians: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds a frame by points."""
    ms = medians.pivot_table(index="method", columns="n_pixels", values="milliseconds")
    return ms.rename(columns="{:,} points".format).map("{:.1f}".format)


def fast(runs: pd.DataFrame) -> pd.DataFrame:
    """ATE (cm), wrong and missed frames of all rooms and seeds, by motion."""
    means = 100 * runs.groupby(["method", "frames"], sort=False)["ate_m"].mean().unstack()
    counts = runs.groupby(["method", "frames"], sort=False)[["wrong_frames", "missed_frames"]].sum()
    columns = {}
    for frames in means:
        columns[f"`{frames}`: ATE, cm"] = means[frames].map("{:.2f}".format)
        of_frames = counts.xs(frames, level="frames").astype(str)
        columns[f"`{frames}`: wrong, missed"] = of_frames.agg(", ".join, axis=1)
    return pd.DataFrame(columns)


def written(text: str) -> str:
    """A document with its tables made anew."""
    return re.sub(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", _table, text, flags=re.DOTALL)


def _table(match: re.Match) -> str:
    begin, name, end = match.groups()
    rows = pd.read_csv(tables_folder() / "corrected" / f"{name}.csv")
    return f"{begin}{_markdown(globals()[name](rows))}{end}"


def _markdown(table: pd.DataFrame) -> str:
    """Row labels to the left, numbers to the right."""
    rows = [["", *table.columns], ["-"] + ["-:"] * len(table.columns)]
    rows += [[str(label), *values] for label, values in zip(table.index, table.values, strict=True)]
    return "".join(f"| {' | '.join(str(cell).strip() for cell in row)} |\n" for row in rows)


if __name__ == "__main__":
    README.write_text(written(README.read_text()))
