"""Keys follow the code: what changes a result changes its key, what does not leaves it alone."""

import shutil
from pathlib import Path

import pytest

from nbtrack.core import files


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the package's sources, to be edited."""
    copy = tmp_path / "nbtrack"
    shutil.copytree(files.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(files, "PACKAGE", copy)
    return copy


def key() -> str:
    files.sources_fingerprint.cache_clear()
    return files.sources_fingerprint("fields.neus", "mapping.fit")


@pytest.mark.parametrize(
    ("file", "old", "new", "counts"),
    [
        ("fields/rendering.py", "weights", "wights", True),
        ("core/geometry.py", "argmax", "argmin", True),
        ("fields/rendering.py", '"""Volume', '"""Another docstring. ', False),
        ("fields/rendering.py", "import torch\n", "import torch  # a comment\n\n", False),
        ("core/errors.py", "did you mean", "perhaps", False),
        ("tracking/budget.py", "yield", "return", False),
        ("data/images.py", "INTER_NEAREST", "INTER_LINEAR", True),
        ("recordings/check.py", "a metre, in sequence.toml", "a metre", False),
        ("fields/neus_plus.py", "class", "clas", False),
        ("fields/__init__.py", "NeuSField, ", "", False),
        ("fields/correction.py", "300_000", "30", False),
    ],
)
def test_what_changes_a_key(package: Path, file: str, old: str, new: str, counts: bool) -> None:
    """Catches an edited loss answered from the cache, and days of results lost for a comment."""
    before = key()
    text = (package / file).read_text()
    assert old in text
    (package / file).write_text(text.replace(old, new))
    assert (key() != before) == counts


def test_what_else_counts() -> None:
    """Catches a tracker or field outside the package whose edit is answered from the cache, and
    results that do not tell the torch they were made with."""
    assert files.foreign_source(files.DataError) == ""
    assert "speed" in files.foreign_source(Mine)
    assert set(files.versions()) == {"nbtrack", "torch", "python"}


class Mine:
    """Stands for a tracker in a file of its own."""

    speed = 1
