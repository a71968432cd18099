"""The tables of README.md, benchmarks/README.md and of two pages in docs, from committed CSV files.

    python benchmarks/documents.py

This script replaces what stands between a line `<!-- table: NAME -->` and a line `<!-- end -->`. A
test checks that the documents are as this script writes them.

Each function takes the rows of a CSV and returns the cells of a table as text.
"""

import re
from pathlib import Path

import pandas as pd

from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.experiments.runs import over_rooms
from nbtrack.tables import published_table_1, table_1

PROJECT = Path(__file__).parents[1]
_NAMES = "README.md", "benchmarks/README.md", "docs/choices.md", "docs/tried.md"
DOCUMENTS = [PROJECT / name for name in _NAMES]
_RIGHT_TO = 0.02  # m; a map is right if its distance near surfaces has a smaller mean error
# Short heads of the methods' columns. "LM" alone is LM in the corrected NeuS+ map.
_HEADS = {
    "iMAP with VR": "VR",
    "NeuS with SDF": "SDF",
    "NeuS+ baked (LM)": "baked",
    "NeuS corrected (LM)": "NeuS",
    "NeuS+ corrected (LM), sparse": "LM 512",
    "NeuS+ corrected (LM)": "LM 2048",
    "NeuS+ corrected (LM), dense": "LM 4096",
    "NeuS+ grid corrected (LM)": "grid, LM 2048",
    "ICP": "ICP 512",
    "ICP, 2048": "ICP 2048",
    "ICP, dense": "ICP 4096",
    "standing still": "still",
}
_COUNTS = {"wrong_frames": "wrong", "missed_frames": "missed", "frames_lost_in_vain": "in vain"}


def shown(rows: pd.DataFrame, columns: dict[str, tuple[str, str]]) -> pd.DataFrame:
    """Format some columns as text: `columns` maps a name to its head and its format."""
    texts = {head: rows[name].map(form.format) for name, (head, form) in columns.items()}
    return pd.DataFrame(texts)


def tracking(runs: pd.DataFrame) -> pd.DataFrame:
    """ATE (cm) of every method, and of a camera that stands still, by scene, path and frames."""
    runs = pd.concat([runs, runs.assign(method="standing still", ate_m=runs["still_ate_m"])])
    path = runs["path"].replace({"mapped": "", "second": ", 2nd"})
    path = path.replace("odd, mapped even", ", even mapped")
    runs["place"] = runs["scene"] + path + ", `" + runs["frames"] + "`"
    cm = 100 * runs.pivot_table(index="place", columns="method", values="ate_m", sort=False)
    return cm[[*_HEADS]].rename(columns=_HEADS).map("{:.2f}".format, na_action="ignore").fillna("")


def recordings(runs: pd.DataFrame) -> pd.DataFrame:
    """The real recording: mean of the seeds' median errors (cm), and counts of frames by seed."""
    runs = runs[runs["scene"] == "real_office"].replace({"method": _HEADS})
    groups = runs.groupby(["frames", "method"], sort=False)
    table = (100 * groups[["median_error_m"]].mean()).map("{:.2f}".format)
    for name in _COUNTS:
        table[name] = groups[name].agg(lambda counts: ", ".join(counts.astype(str)))
    places = [f"`{frames}`: {method}" for frames, method in table.index]
    return table.rename(columns={"median_error_m": "median, cm", **_COUNTS}).set_axis(places)


def reference(rows: pd.DataFrame) -> pd.DataFrame:
    """RMS distances (cm) of paths from the reference, the truth, and registered pairs of frames."""
    place = rows["scene"].replace({"living_room": "two rooms", "office": "two rooms"})
    cm = 100 * rows.groupby([place, "path"]).mean(numeric_only=True).filter(like="from_")
    cm = cm.set_axis(cm.index.map(": ".join)).rename(columns=lambda name: name[5:-2])
    return cm.map("{:.2f}".format, na_action="ignore").fillna("")


def searches(rows: pd.DataFrame) -> pd.DataFrame:
    """Counts of searches by scene and offset.

    They are of wrong poses, of wrong ones that were called lost, and of right ones that were called
    lost.
    """
    wrong = (rows["error_m"] > 0.05) | (rows["error_deg"] > 3)
    rows = rows.assign(caught=rows["lost"] & wrong, wrong=wrong, alarm=rows["lost"] & ~wrong)
    columns = {"wrong": "wrong", "caught": "called lost", "alarm": "in vain"}
    groups = rows.groupby(["scene", "offset"], sort=False)
    counts = groups[[*columns]].sum().astype(int).rename(columns=columns)
    counts.insert(0, "searches", groups.size())
    return counts.set_axis([": ".join(place) for place in counts.index]).astype(str)


def times(medians: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds a frame, by method and number of points."""
    ms = medians.pivot_table(index="method", columns="n_pixels", values="milliseconds")
    return ms.rename(columns="{:,} points".format).map("{:.1f}".format)


def fast(runs: pd.DataFrame) -> pd.DataFrame:
    """Mean ATE (cm), and numbers of wrong frames, of those that were missed, and of right ones that
    were called lost; by method and frames, over all rooms and seeds."""
    of_motion = runs.groupby(["method", "frames"], sort=False)
    means = 100 * of_motion["ate_m"].mean().unstack()
    counts = of_motion[["wrong_frames", "missed_frames", "frames_lost_in_vain"]].sum()
    columns = {}
    for frames in means:
        columns[f"`{frames}`: ATE, cm"] = means[frames].map("{:.2f}".format)
        of_frames = counts.xs(frames, level="frames").astype(str)
        columns[f"`{frames}`: wrong, missed, in vain"] = of_frames.agg(", ".join, axis=1)
    return pd.DataFrame(columns)


def steps(cells: pd.DataFrame) -> pd.DataFrame:
    """Steps in 500 ms by tracker and pixels, and 500 ms over their number.

    The preparation of a frame and unused time are part of the 500 ms.
    """
    cells = cells.query("budget_ms == 500").eval("ms = 500 / steps")
    cells.index = cells["tracker"] + " " + cells["n_pixels"].astype(str)
    heads = {"steps": ("steps in 500 ms", "{:.1f}"), "ms": ("500 ms over steps", "{:.3g}")}
    return shown(cells, heads).T


def mapping(times: pd.DataFrame) -> pd.DataFrame:
    """Time of a mapping iteration by field, and by the eikonal term's share of the samples."""
    times = times[times["precision"] == "float32"]
    share = times["eikonal_share"].map(", eikonal term on {:g} of the samples".format)
    what = times["field"] + share.where(times["eikonal_share"].notna(), "")
    times = times.assign(what=what, rays=times["n_rays"].astype(str))
    if "recorded" not in times:
        times["recorded"] = "an iteration"
    ms = times.pivot_table(index=["what", "rays"], columns="recorded", values="ms", sort=False)
    names = {False: "ms, called", True: "ms, recorded", "an iteration": "ms an iteration"}
    return ms.map("{:,.1f}".format).reset_index("rays").rename(columns=names)


def recorded(times: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds a step of queued steps, by precision, if called one by one or recorded."""
    times = times[~times["waits"]]
    precision = times["precision"].replace({"float32": "", "TF32": ", TF32"})
    times = times.assign(how=times["recorded"].map({False: "called", True: "recorded"}) + precision)
    ms = times.pivot_table(index="tracker", columns="how", values="ms", sort=False)
    return ms.map("{:.2f}".format).rename(index=str.upper)


def convergence(scores: pd.DataFrame) -> pd.DataFrame:
    """The first number of iterations, and its time, at which distances near surfaces are right."""
    of_seeds = scores.groupby(["field", "iterations"], sort=False)[["seconds", "near_m"]]
    right = of_seeds.mean().reset_index("iterations").query("near_m < @_RIGHT_TO")
    first = right.groupby("field", sort=False).first()
    return shown(first, {"iterations": ("iterations", "{:.0f}"), "seconds": ("s", "{:.0f}")})


def ten_seconds(rounds: pd.DataFrame) -> pd.DataFrame:
    """Seconds of a core for mapping a recording and correcting the map; medians of the rounds."""
    rounds = rounds.eval("both_s = mapping_s + correction_s")
    medians = rounds.groupby("method", sort=False).median(numeric_only=True)
    names = ("mapping", "correction", "both")
    return shown(medians, {f"{name}_s": (f"{name}, s", "{:.1f}") for name in names})


def memory(peaks: pd.DataFrame) -> pd.DataFrame:
    """Peak memory of mapping a long sequence, and the part of it that the images take."""
    # 3 bytes of colour and 2 of depth a pixel
    peaks = peaks.set_index("field").eval("images_gb = 5 * frames * width * height / 1e9")
    columns = {"peak_gb": "peak, GB", "images_gb": "images of it, GB"}
    return shown(peaks, {name: (head, "{:.2f}") for name, head in columns.items()})


def ablation(runs: pd.DataFrame) -> pd.DataFrame:
    """ATE (cm), every frame tracked, by what was changed of a correction."""
    runs = runs[runs["frames"] == ":"]
    place = runs["scene"] + runs["path"].replace({"mapped": "", "second": ", 2nd"})
    cm = 100 * runs.pivot_table("ate_m", "changed", place, sort=False)
    return cm.map("{:.2f}".format)


def choices(runs: pd.DataFrame) -> pd.DataFrame:
    """Ratios of errors at 2 Hz: of each other choice to ours, and of VR to SDF.

    Geometric means over rooms with their intervals of 95 %.
    """
    runs = runs.query("rate_hz == 2").replace({"iMAP with VR": "VR", "NeuS with SDF": "SDF"})
    place = ["choice", "scene", "seed"]
    by_method = runs.pivot(index=place, columns="method", values="ate_m")
    ours = by_method.loc["ours"].reindex(by_method.index.droplevel("choice"))
    ratios = (by_method / ours.values).add_suffix("'s error over ours")
    ratios["VR's over SDF's"] = by_method["VR"] / by_method["SDF"]
    ratios["the same with ours, same rooms"] = (ours["VR"] / ours["SDF"]).values
    rooms = ratios.groupby("choice", sort=False).size()
    table = {name: _over_rooms(column.rename("ratio")) for name, column in ratios.items()}
    table = pd.DataFrame(table).assign(rooms=rooms.astype(str)).loc[runs["choice"].unique()]
    table.loc["ours", [name for name in ratios if "ours" in name]] = ""
    return table


def _over_rooms(ratios: pd.Series) -> pd.Series:
    """Text "mean (from to)" for each choice, from ratios of rooms and seeds."""
    means = over_rooms(ratios.reset_index(), ["choice"], "ratio").set_index("choice")
    return means.apply("{ratio:.2f} ({from:.2f} to {to:.2f})".format_map, axis=1)


def breakfast(cells: pd.DataFrame) -> pd.DataFrame:
    """The column Breakfast of Table I (m), published and ours, as means of the seeds.

    Our results are with the dataset's depth sensor, and those at the paper's sizes with a sensor
    without its bias.
    """
    large = pd.read_csv(PROJECT / "paper_tables" / "paper_rooms_gpu" / "table_1_cells.csv")
    here = cells.query("sensor == 'dataset'").assign(side="here")
    sides = [here, large.assign(side="here, the paper's sizes, no bias")]
    ours = pd.concat(sides).query("scene == 'breakfast_room'")
    rows = pd.concat([ours, published_table_1().assign(side="published")])
    rows["method"] += ", " + rows["side"]
    table = table_1(rows)[DATASET_SCENES["breakfast_room"]].unstack("rate_hz")
    table = table.sort_index()[[10.0, 5.0, 2.0]].dropna(how="all").rename(columns="{:g} Hz".format)
    return table.map("{:.3f}".format, na_action="ignore").fillna("–")


TABLES = {
    "breakfast": (breakfast, "paper_tables/paper_rooms/table_1_cells.csv"),
    "steps": (steps, "benchmarks/cpu/table_2.csv"),
    "mapping": (mapping, "benchmarks/cpu/mapping.csv"),
    "gpu_mapping": (mapping, "benchmarks/gpu/mapping.csv"),
    "gpu_recorded": (recorded, "benchmarks/gpu/steps.csv"),
    "convergence": (convergence, "paper_tables/beyond/convergence.csv"),
    "reference": (reference, "paper_tables/corrected/reference.csv"),
    "tracking": (tracking, "paper_tables/corrected/tracking.csv"),
    "recordings": (recordings, "paper_tables/corrected/tracking.csv"),
    "times": (times, "paper_tables/corrected/times.csv"),
    "searches": (searches, "paper_tables/corrected/searches.csv"),
    "fast": (fast, "paper_tables/corrected/fast.csv"),
    "ten_seconds": (ten_seconds, "paper_tables/corrected/mapping.csv"),
    "memory": (memory, "benchmarks/cpu/memory.csv"),
    "ablation": (ablation, "paper_tables/corrected/ablation.csv"),
    "choices": (choices, "paper_tables/evidence/choices.csv"),
}
"""The function that makes each table, and the file that it takes."""


def written(text: str) -> str:
    """The text of a document with all of its tables made anew."""
    return re.sub(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", _table, text, flags=re.DOTALL)


def _table(match: re.Match) -> str:
    begin, name, end = match.groups()
    make, path = TABLES[name]
    return f"{begin}{_markdown(make(pd.read_csv(PROJECT / path)))}{end}"


def _markdown(table: pd.DataFrame) -> str:
    """A table in Markdown, with row labels aligned left, and cells aligned right."""
    rows = [["", *table.columns], ["-"] + ["-:"] * len(table.columns)]
    rows += [[str(label), *values] for label, values in zip(table.index, table.values, strict=True)]
    return "".join(f"| {' | '.join(str(cell).strip() for cell in row)} |\n" for row in rows)


if __name__ == "__main__":
    for document in DOCUMENTS:
        document.write_text(written(document.read_text()))
