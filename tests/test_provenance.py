"""Keys follow the code: what changes a result changes its key, what does not leaves it alone."""

import importlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from nbtrack import provenance
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import NetworkSettings, NeuSField
from nbtrack.machinery import files
from nbtrack.synthetic import make_room
from nbtrack.tracking import SdfTracker


@pytest.fixture
def package(tmp_path: Path, monkeypatch) -> Iterator[Path]:
    """A copy of the package's sources, to be edited."""
    copy = tmp_path / "nbtrack"
    shutil.copytree(provenance.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "PACKAGE", copy)
    yield copy
    provenance.package_code.cache_clear()


def key() -> str:
    provenance.package_code.cache_clear()
    return provenance.code_fingerprint(SdfTracker, NeuSField)


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("fields/rendering.py", True), ("core/geometry.py", True), ("beyond/correction.py", True),
        ("experiments/quality.py", True), ("recordings/reading.py", True),
        ("checks/check.py", False), ("plots/rooms.py", False), ("cli.py", False),
    ],
)  # fmt: skip
def test_what_changes_a_key(package: Path, file: str, counts: bool) -> None:
    """Catches an edited loss or score that is answered from the cache, and results lost for a
    picture."""
    before = key()
    (package / file).write_text((package / file).read_text() + "\nEDITED = True\n")
    assert (key() != before) == counts


def test_reading_counts(package: Path, tmp_path: Path) -> None:
    """Catches frames that are decoded otherwise, and whose results come from the cache."""
    folder = make_room("office", tmp_path / "office", 2, 16, 12)
    before = Scene("office", folder).fingerprint
    provenance.package_code.cache_clear()
    assert Scene("office", folder).fingerprint == before
    file = package / "recordings/images.py"
    file.write_text(file.read_text().replace("INTER_NEAREST", "INTER_LINEAR"))
    provenance.package_code.cache_clear()
    assert Scene("office", folder).fingerprint != before


def test_own_files_count_with_their_helpers(tmp_path: Path, monkeypatch) -> None:
    """Catches a tracker of a user's whose loss, in a second file or a base class, is edited and
    answered from the cache."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    files_of = {
        "own_loss.py": "weight = 1.0\n",
        "own_base.py": "from nbtrack.tracking import SdfTracker\nclass Base(SdfTracker): pass\n",
        "own_mine.py": "import own_loss\nfrom own_base import Base\nclass Mine(Base): pass\n",
    }
    keys = []
    for edited in (None, None, *files_of):
        for name, text in files_of.items():
            monkeypatch.delitem(sys.modules, Path(name).stem, raising=False)
            (tmp_path / name).write_text(text + "# edited\n" * (name == edited))
        importlib.invalidate_caches()
        keys.append(provenance.code_fingerprint(importlib.import_module("own_mine").Mine))
    for name in files_of:
        monkeypatch.delitem(sys.modules, Path(name).stem)
    assert keys[0] == keys[1]
    assert len({*keys}) == 1 + len(files_of)
    assert key() not in keys


CELL = """
from nbtrack.tracking import SdfTracker
HALF = 0.5
def halved(x):
    return x * HALF
class Mine(SdfTracker):
    name = "mine"
"""


@pytest.mark.parametrize(
    ("more", "counts"),
    [
        (CELL, False), ("rows = len('abc')", False), ("HALF = 0.5  # of it", False),
        ("1 +", False), ("%%time", False), ("HALF = 0.4", True), (CELL.replace("*", "+"), True),
        ('class Mine(SdfTracker):\n    name = "my"', True),
    ],
)  # fmt: skip
def test_cells_count(more: str, counts: bool, monkeypatch) -> None:
    """Catches an edited cell that is answered from the cache, and maps made anew in each cell."""
    main = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    mine = type("Mine", (SdfTracker,), {"__module__": "__main__"})
    main.In = ["", CELL]
    before = provenance.code_fingerprint(mine)
    main.In.append(more)
    assert (provenance.code_fingerprint(mine) != before) == counts


def test_what_a_fingerprint_tells_apart() -> None:
    """Catches a cache that mixes up settings, or makes results twice because a step count was
    written 30 and 30.0, or settings in another order."""
    assert files.fingerprint(30, {"a": [1], "b": 2}) == files.fingerprint(
        30.0, {"b": 2.0, "a": [1.0]}
    )
    wide, narrow = NetworkSettings(), NetworkSettings(width=255)
    assert len({files.fingerprint(*parts) for parts in ((wide, 0), (wide, 1), (narrow, 0))}) == 3
