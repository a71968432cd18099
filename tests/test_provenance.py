"""Keys follow the code: what changes a result changes its key, what does not leaves it alone."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from nbtrack import provenance
from nbtrack.core import files
from nbtrack.core.settings import with_settings
from nbtrack.experiments import map_jobs, track_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import Preset, load_preset
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.synthetic import make_room


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the package's sources, to be edited."""
    copy = tmp_path / "nbtrack"
    shutil.copytree(provenance.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "PACKAGE", copy)
    yield copy
    provenance.sources_fingerprint.cache_clear()


def key() -> str:
    provenance.sources_fingerprint.cache_clear()
    return provenance.sources_fingerprint("fields.neus", "mapping.fit")


@pytest.mark.parametrize(
    ("file", "old", "new", "counts"),
    [
        ("fields/rendering.py", "weights", "wights", True),
        ("core/geometry.py", "argmax", "argmin", True),
        ("fields/rendering.py", '"""Volume', '"""Another docstring. ', False),
        ("fields/rendering.py", "import torch\n", "import torch  # a comment\n\n", False),
        ("core/errors.py", "did you mean", "perhaps", False),
        ("tracking/budget.py", "yield", "return", False),
        ("checks/check.py", "a metre, in sequence.toml", "a metre", False),
        ("beyond/neus_plus.py", "class", "clas", False),
        ("fields/__init__.py", "NeuSField, ", "", False),
        ("beyond/correction.py", "300_000", "30", False),
    ],
)
def test_what_changes_a_key(package: Path, file: str, old: str, new: str, counts: bool) -> None:
    """Catches an edited loss answered from the cache, and days of results lost for a comment."""
    before = key()
    text = (package / file).read_text()
    assert old in text
    (package / file).write_text(text.replace(old, new))
    assert (key() != before) == counts


def test_reading_counts(package: Path, tmp_path: Path) -> None:
    """Catches frames that are decoded otherwise, and whose results come from the cache."""
    folder = make_room("office", tmp_path / "office", 2, 16, 12)
    before = Scene("office", folder).fingerprint
    provenance.sources_fingerprint.cache_clear()
    assert Scene("office", folder).fingerprint == before
    file = package / "recordings/images.py"
    file.write_text(file.read_text().replace("INTER_NEAREST", "INTER_LINEAR"))
    provenance.sources_fingerprint.cache_clear()
    assert Scene("office", folder).fingerprint != before


def test_what_else_counts() -> None:
    """Catches a tracker or field outside the package whose edit is answered from the cache, and
    results that do not tell the torch they were made with."""
    assert provenance.foreign_source(files.DataError) == ""
    assert "speed" in provenance.foreign_source(Mine)
    assert {"nbtrack", "torch", "python", "numba", "scipy"} <= set(provenance.versions())


def test_numbers_count_by_their_value() -> None:
    """Catches results that are made twice because a step count was written 30 and 30.0."""
    assert files.fingerprint(30, {"a": [1]}) == files.fingerprint(30.0, {"a": [1.0]})
    assert files.fingerprint(30) != files.fingerprint(31)


def test_keys_hold_all_that_makes_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches keys that miss what chooses the seed of a field, gives settings to a tracker or
    judges a run, and versions; and points fused anew because a network has another width."""
    scene = Scene("office", make_room("office", tmp_path / "office", 2, 16, 12))
    preset = load_preset("smoke")

    def keys(preset: Preset = preset) -> tuple[str, str, str]:
        made = MapJob.of(scene, "neus", preset)
        points = MapJob.of(scene, "points", preset)
        return made.key, TrackJob(made, scene, "sdf", preset.tracking_of("sdf"), 2).key, points.key

    before = keys()
    assert keys() == before
    assert keys(with_settings(preset, "network.neus.width=7"))[2] == before[2]
    of_map, of_run = (map_jobs, 0), (track_jobs, 1)
    changed = {"make_field": of_map, "make_tracker": of_run, "_scores": of_run}
    for name, (module, place) in changed.items():
        with monkeypatch.context() as patch:
            patch.setattr(module, name, _other)
            assert keys()[place] != before[place], name
    monkeypatch.setattr(provenance, "versions", lambda: {"torch": "another"})
    assert all(a != b for a, b in zip(keys(), before, strict=True))


def _other() -> None:
    """Stands for a function that was edited."""


class Mine:
    """Stands for a tracker in a file of its own."""

    speed = 1
