"""Documents: their tables are those of the committed CSV files, and they stay readable."""

import re
import sys
from pathlib import Path

import pandas as pd

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
import documents  # noqa: E402


def test_tables_are_those_of_the_files() -> None:
    """Catches a number in a document that no committed file says, and a table that nobody shows."""
    texts = [path.read_text() for path in documents.DOCUMENTS]
    for text in texts:
        assert documents.written(text) == text, "run python benchmarks/documents.py"
    assert all(f"<!-- table: {name} -->" in "".join(texts) for name in documents.TABLES)


def test_the_readme_has_the_measured_size_of_maps() -> None:
    """Catches a size of map files that no measured room or walk has."""
    readme = (documents.PROJECT / "README.md").read_text()
    said = [*map(int, re.search(r"one file of (\d+) to (\d+) MB", readme).groups())]
    folder, sizes = documents.PROJECT / "paper_tables", []
    for name in ("beyond/points.csv", "corrected/walks.csv"):
        rows = pd.read_csv(folder / name)
        sizes += [*rows.loc[rows["method"].str.startswith("NeuS+ corrected"), "map_mb"]]
    assert said == [round(min(sizes)), round(max(sizes))]


def test_the_benchmarks_are_read_in_one_sitting() -> None:
    """Catches a diary: paragraphs without end, and lines that have to be scrolled."""
    lines = (BENCHMARKS / "README.md").read_text().splitlines()
    prose = [line for line in lines if not line.startswith("|")]
    assert len(prose) <= 120
    assert max(len(line) for line in prose) <= 100
