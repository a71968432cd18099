"""Installed elsewhere: everything below the current folder, and missing extras in a line.

And keys follow the code: what changes a result changes its key, what does not leaves it alone.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_faults import assert_refused
from test_own_method import OWN
from tiny import TINY

from nbtrack import provenance
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.fields import FIELDS, NetworkSettings, NeuSField
from nbtrack.machinery import files
from nbtrack.synthetic import make_room
from nbtrack.tracking import TRACKERS, SdfTracker, TrackerSettings


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch) -> Path:
    """An empty current folder, and no checkout around the package."""
    monkeypatch.delenv("NBTRACK_RUNS")
    monkeypatch.setattr(files, "PACKAGE", tmp_path / "site-packages" / "nbtrack")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def test_folders(elsewhere: Path) -> None:
    """Catches caches in site-packages, or beside whatever folder the package lies in."""
    assert files.runs_folder() == elsewhere / "runs"
    assert files.data_folder() == elsewhere / "data"
    assert files.tables_folder() == elsewhere / "paper_tables"


ICP = ["track", "office", "--field", "points", "--tracker", "icp", "--steps", "1"]
EXTRAS = [
    ("distributed", ["tables", "--dask", "tcp://h:1"], "pip install 'nbtrack[cluster]'"),
    ("small_gicp", ICP, "pip install small_gicp"),
]


def test_a_missing_extra_is_told_before_any_work(elsewhere: Path, monkeypatch, capsys) -> None:
    """Catches minutes of work that end in a traceback of imports."""
    for package, arguments, says in EXTRAS:
        monkeypatch.setitem(sys.modules, package, None)
        assert_refused(elsewhere, capsys, arguments, says)
    assert not list(elsewhere.iterdir())


def test_help_is_quick_and_needs_no_torch(tmp_path: Path) -> None:
    """Catches an import at the top that makes every typing mistake cost seconds."""
    shutil.copytree(files.PACKAGE, tmp_path / "nbtrack")
    (tmp_path / "torch.py").write_text("raise ImportError('no torch here')")
    command = [sys.executable, "-m", "nbtrack", "track", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "--map-from" in done.stdout


FEW = ["mapping.fading.iterations=6", "mapping.fading.n_rays=8"]
SCRIPT = f"""{OWN}
from nbtrack.experiments.grid import Execution
preset = nbtrack.load_preset(settings={[*TINY, *FEW, "scenes.names=['office','bedroom']"]!r})
how = [nbtrack.open_scenes(preset), ["mine"], preset, [10]]
for workers in (2, 1):
    runs = nbtrack.track_scenes(*how, execution=Execution(workers=workers))
print(runs["ate_m"].notna().sum(), "runs")
"""


def test_a_script_without_a_guard(tmp_path: Path) -> None:
    """Catches workers that run the user's script once more, and end in hundreds of lines; another
    class, or another key of one, in workers than in the script or a notebook; and maps of a class
    without a version that are made twice in one process."""
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "NBTRACK_RUNS": str(tmp_path / "runs")}
    command = [sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout == "2 runs\n", done.stderr
    for kind in ("maps", "tracks"):
        assert len([*(tmp_path / "runs" / kind).iterdir()]) == 2
    assert "Traceback" not in done.stderr


@pytest.fixture
def package(tmp_path: Path, monkeypatch):
    """A copy of the package's sources, to be edited."""
    copy = tmp_path / "nbtrack"
    shutil.copytree(provenance.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "PACKAGE", copy)
    yield copy
    provenance.package_code.cache_clear()


def key() -> str:
    provenance.package_code.cache_clear()
    return provenance.code_fingerprint(SdfTracker)


EDITED = [
    ("fields/rendering.py", True), ("core/geometry.py", True), ("beyond/correction.py", True),
    ("experiments/quality.py", True), ("recordings/reading.py", True),
    ("checks/check.py", False), ("plots/rooms.py", False), ("cli.py", False),
]  # fmt: skip


@pytest.mark.parametrize(("file", "counts"), EDITED)
def test_what_changes_a_key(package: Path, file: str, counts: bool) -> None:
    """Catches an edited loss or score that is answered from the cache, and results lost for a
    picture."""
    before = key()
    (package / file).write_text((package / file).read_text() + "\nEDITED = True\n")
    assert (key() != before) == counts


def classes_of_ones_own() -> tuple[type, ...]:
    """Written anew, as by a cell that runs again."""
    promised = type("Promised", (SdfTracker,), {"version": "1"})
    mine, later = type("Mine", (SdfTracker,), {}), type("Later", (promised,), {})
    return mine, promised, later, SdfTracker, type("Next", (promised,), {"version": "2"})


def test_classes_of_ones_own(capsys) -> None:
    """Catches an edited class that is answered from the cache, one that says its version and is
    made anew, and a class that lives on the promise of its base."""
    keys = [map(provenance.code_fingerprint, classes_of_ones_own()) for _ in range(2)]
    mine, promised, later, ours, newer = map(set, zip(*keys, strict=True))
    assert len(mine | later) == 4
    assert len(promised) == len(ours) == len(newer) == 1
    assert len(mine | later | promised | ours | newer) == 7
    told = capsys.readouterr().err.splitlines()
    assert [line.split()[5].split(".")[-1] for line in told] == 2 * ["Mine"] + 2 * ["Later"]
    assert 'version = "1"' in told[0]


def test_a_class_is_its_own_key(tmp_path: Path, monkeypatch, capsys) -> None:
    """Catches a map made anew for each row, or for another tracker, and results of a class that has
    been written anew, as by a cell that runs again."""

    def keys() -> tuple[str, str]:
        made = MapJob(scene, "mine", None, settings)
        return made.key, TrackJob(made, scene, "mine", settings, steps=1).key

    def write_anew(registry, base: type) -> None:
        monkeypatch.setitem(registry, "mine", type("Mine", (base,), {"name": "mine"}))

    scene = Scene("office", make_room("office", tmp_path / "office", 2, 16, 12))
    settings = TrackerSettings()
    write_anew(FIELDS, NeuSField)
    write_anew(TRACKERS, SdfTracker)
    before = keys()
    assert keys() == before
    assert len(capsys.readouterr().err.splitlines()) == 2  # for each class once
    write_anew(TRACKERS, SdfTracker)
    after = keys()
    assert after[0] == before[0]
    assert after[1] != before[1]
    write_anew(FIELDS, NeuSField)
    assert not {*keys()} & {*before, *after}


def test_what_a_fingerprint_tells_apart() -> None:
    """Catches a cache that mixes up settings, or makes results twice because a step count was
    written 30 and 30.0, or settings in another order; large seeds that floats round alike."""
    assert files.fingerprint(2**53) != files.fingerprint(2**53 + 1)
    whole = files.fingerprint(30, {"a": [1], "b": 2})
    assert whole == files.fingerprint(30.0, {"b": 2.0, "a": [1.0]})
    wide, narrow = NetworkSettings(), NetworkSettings(width=255)
    assert len({files.fingerprint(*parts) for parts in ((wide, 0), (wide, 1), (narrow, 0))}) == 3
