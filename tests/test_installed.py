"""Installed elsewhere: everything below the current folder, and missing extras in a line."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_faults import assert_refused
from test_own_method import OWN
from tiny import TINY

from nbtrack.beyond import observed
from nbtrack.machinery import files


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


EXTRAS = [
    ("distributed", ["tables", "--dask", "tcp://h:1"], "pip install 'nbtrack[cluster]'"),
    ("small_gicp", ["track", "office", "--field", "points", "--tracker", "icp", "--steps", "1"],
     "pip install 'nbtrack[icp]'"),
]  # fmt: skip


@pytest.mark.parametrize(("missing", "arguments", "message"), EXTRAS)
def test_a_missing_extra_is_told_before_any_work(
    elsewhere: Path, missing: str, arguments: list[str], message: str, monkeypatch, capsys
) -> None:
    """Catches minutes of work that end in a traceback of imports."""
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *a: None if name == missing else found(name, *a)
    )
    assert_refused(elsewhere, capsys, arguments, message)
    assert not list(elsewhere.iterdir())


def test_help_is_quick_and_needs_no_torch(tmp_path: Path) -> None:
    """Catches an import at the top that makes every typing mistake cost seconds."""
    shutil.copytree(files.PACKAGE, tmp_path / "nbtrack")
    (tmp_path / "torch.py").write_text("raise ImportError('no torch here')")
    command = [sys.executable, "-m", "nbtrack", "track", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "--map-from" in done.stdout


def test_without_a_place_for_compiled_code(monkeypatch) -> None:
    """Catches commands that end because numba can write its cache nowhere."""
    real = observed.njit

    def without_cache(cache: bool = False, **options: object):
        if cache:
            raise RuntimeError("cannot cache function 'add': no locator available")
        return real(**options)

    monkeypatch.setattr(observed, "njit", without_cache)
    assert observed.compiled(lambda a, b: a + b)(2, 3) == 5


FEW = [
    "mapping.fading.iterations=6",
    "mapping.fading.n_rays=8",
    "scenes.names=['office','bedroom']",
]
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
    assert {kind: len([*(tmp_path / "runs" / kind).iterdir()]) for kind in ("maps", "tracks")} == {
        "maps": 2, "tracks": 2,
    }  # fmt: skip
    assert "Traceback" not in done.stderr
