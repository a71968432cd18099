"""Documents: their tables are those of the committed CSV files, and they stay readable."""

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
import documents  # noqa: E402


def test_tables_are_those_of_the_files() -> None:
    """Catches a number in benchmarks/README.md that no committed file says."""
    text = documents.README.read_text()
    assert text.count("<!-- table: ") == 4
    assert documents.written(text) == text, "run python benchmarks/documents.py"


def test_the_benchmarks_are_read_in_one_sitting() -> None:
    """Catches a diary: paragraphs without end, and lines that have to be scrolled."""
    lines = documents.README.read_text().splitlines()
    assert len(lines) <= 150
    assert max(len(line) for line in lines) <= 100
