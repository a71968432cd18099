"""Documents: tables and answers are those that the committed CSV files and the code give, and what
the glossary names is there."""

import doctest
import pydoc
import re
import sys
from pathlib import Path

import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import documents


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


def test_the_exercises_have_the_answers_of_the_code() -> None:
    """Catches an answer that the code no longer gives."""
    path = documents.PROJECT / "docs/exercises.md"
    failed, tried = doctest.testfile(str(path), module_relative=False)
    assert failed == 0 < 10 < tried


TEXT = Path(__file__).parents[1].joinpath("docs/notation.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`(nbtrack\.[\w.]+)`", TEXT)))


@pytest.mark.parametrize("name", NAMES)
def test_names_exist(name: str) -> None:
    """Catches a name that was renamed in the code and not in the glossary."""
    found = pydoc.locate(name)
    assert found is not None
    assert found.__doc__
