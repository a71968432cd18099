"""A grid that is killed at any moment ends with the table of an undisturbed one."""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny import TINY

# Each costs some seconds. More of them: NBTRACK_TEST_KILLS=20 pytest tests/test_resume.py
KILLS = int(os.environ.get("NBTRACK_TEST_KILLS", "1"))
SETTINGS = (
    *TINY, "mapping.imap.iterations=80", "mapping.neus.iterations=80", "tables.rates_hz=[10]",
)  # fmt: skip


def command(folder: Path) -> list[str]:
    """Both tables of two rooms with two workers."""
    words = [sys.executable, "-m", "nbtrack", "tables", "--preset", "synthetic"]
    words += ["--scenes", "living_room,long_hall", "--workers", "2", "--out", str(folder / "out")]
    for setting in (*SETTINGS, "scenes.track_frames=:4"):
        words += ["--set", setting]
    return words


@pytest.fixture
def temporary() -> Iterator[str]:
    """A short path for temporary files: sockets below it may have 107 characters."""
    with tempfile.TemporaryDirectory(prefix="nbt") as folder:
        yield folder


def start(folder: Path, temporary: str) -> subprocess.Popen:
    """The command, in a process group of its own, with its own cache."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("NBTRACK_")}
    environment = {**kept, "NBTRACK_RUNS": str(folder / "runs"), "TMPDIR": temporary}
    return subprocess.Popen(
        command(folder), env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,
    )  # fmt: skip


def finished_cells(folder: Path) -> dict[Path, int]:
    """When each cell that is complete was written, in nanoseconds."""
    found = [p for name in ("map.safetensors", "metrics.json") for p in folder.rglob(name)]
    return {path: path.stat().st_mtime_ns for path in found}


def test_killed_and_resumed(tmp_path: Path, temporary: str) -> None:
    """Catches half-written cells that count as done, and finished ones that are made again."""
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    for folder in (undisturbed, disturbed):
        folder.mkdir()
    begin = time.monotonic()
    process = start(undisturbed, temporary)
    output, _ = process.communicate()
    seconds = time.monotonic() - begin
    assert process.returncode == 0, output
    rng, seen = random.Random(0), {}
    for _ in range(KILLS):
        process = start(disturbed, temporary)
        time.sleep(rng.uniform(0.3, 0.95) * seconds)
        os.kill(process.pid, signal.SIGKILL)  # its workers notice by themselves
        process.communicate()
        for path, written in seen.items():
            assert path.stat().st_mtime_ns == written, f"{path} was made again"
        seen = finished_cells(disturbed)
    process = start(disturbed, temporary)
    output, _ = process.communicate()
    assert process.returncode == 0, output
    assert {path: finished_cells(disturbed)[path] for path in seen} == seen
    for name in ("table_1.csv", "table_1_cells.csv"):
        expected = (undisturbed / "out" / name).read_bytes()
        assert (disturbed / "out" / name).read_bytes() == expected
