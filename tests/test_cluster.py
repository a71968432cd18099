"""The grid on a Dask cluster of two local workers: the same table, and clear words without one."""

from pathlib import Path

import pytest
from tiny import TINY

from nbtrack.cli import main

# Dask's own threads and sockets warn as they are torn down.
pytestmark = pytest.mark.filterwarnings("default")


@pytest.fixture(scope="module")
def address():
    """Of a scheduler with two workers in processes of their own."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def tables(monkeypatch: pytest.MonkeyPatch, folder: Path, *options: str) -> bytes:
    """Table I of two rooms, from an empty cache."""
    monkeypatch.setenv("NBTRACK_RUNS", str(folder / "runs"))
    words = [word for setting in TINY for word in ("--set", setting)]
    out = folder / "out"
    assert main(["tables", "--threads", "1", "--out", str(out), *words, *options]) == 0
    return (out / "table_1_cells.csv").read_bytes()


def test_the_same_table_as_on_this_machine(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches cells that the cluster computes otherwise, or keeps where nobody looks."""
    here = tables(monkeypatch, tmp_path / "here", "--workers", "1")
    there = tables(monkeypatch, tmp_path / "there", "--dask", address)
    assert there == here
    # A failure in a worker comes back as one line, and the other cells still run.
    for file in (tmp_path / "there").rglob("office*/**/depth_filtered/depth1.png"):
        file.write_bytes(b"no image")
    monkeypatch.setattr("nbtrack.experiments.commands_tables.tqdm.write", lambda *a, **k: None)
    words = [word for setting in TINY for word in ("--set", setting)]
    options = ["--dask", address, "--threads", "1", "--out", str(tmp_path / "broken")]
    assert main(["tables", *options, *words]) == 2
    text = (tmp_path / "broken" / "table_1.csv").read_text()
    assert "living_room,\n" not in text
    assert text.count("office,\n") == 4


def test_no_scheduler(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a traceback of sockets where the address is wrong."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    monkeypatch.setattr("nbtrack.experiments.cluster._SECONDS_TO_CONNECT", 0.5)
    words = [word for setting in TINY for word in ("--set", setting)]
    assert main(["tables", "--dask", "tcp://127.0.0.1:9", *words]) == 2
    assert "no Dask scheduler at 'tcp://127.0.0.1:9'" in capsys.readouterr().err.splitlines()[-1]
