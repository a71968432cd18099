"""The exercises' answers."""

import doctest
from pathlib import Path


def test_answers() -> None:
    """Catches an answer that the code no longer gives."""
    path = Path(__file__).parents[1] / "docs/exercises.md"
    failed, tried = doctest.testfile(str(path), module_relative=False)
    assert tried > 10
    assert not failed
