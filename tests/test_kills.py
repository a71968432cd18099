"""Mapping, tracking and tables killed at any moment, then told the same again: the same result.

`test_grid.py` does so for tables with workers. More kills: NBTRACK_TEST_KILLS=30.
"""

import contextlib
import io
import os
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic as time

import pandas as pd
import pytest
from finished import isolate
from forked import forking
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.mapping.files import MAP_FILE, read_map
from nbtrack.tracking.trajectories import read_tum

KILLS = int(os.environ.get("NBTRACK_TEST_KILLS", "3"))
SET = tiny_words(
    "mapping.neus.iterations=15", "mapping.imap.iterations=15", "mapping.neus.holdout_every=0",
    "mapping.imap.holdout_every=0", "scenes.n_frames=8", "tables.rates_hz=[10]",
)  # fmt: skip
COMMANDS = {
    "map": ["map", "living_room", "--field", "neus", "--out", "out", *SET],
    "track": ["track", "living_room", "--field", "neus", "--tracker", "lm", "--steps", "4",
              "--out", "out", *SET],
    "tables": ["tables", "--workers", "1", "--out", "out", "--scenes", "living_room", "--set",
               "scenes.track_frames=:4", *SET],
}  # fmt: skip


Run = Callable[..., tuple[int, float]]
"""Exit status and time (s) of a command in a folder, killed after some seconds if given."""


def undertake(folder: Path, arguments: list[str]) -> None:
    """The command in a process of its own. Checkpoints are written after every step, or every
    other command would be over before its first one."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()):
        isolate(folder, patch)
        patch.setattr("nbtrack.mapping.fit.CHECKPOINT_SECONDS", 0.0)
        patch.setattr("nbtrack.tracking.trajectories.CHECKPOINT_SECONDS", 0.0)
        sys.exit(main(arguments))


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    """Runs commands in processes of their own; exit statuses are negative where killed."""
    with forking() as context:

        def run(folder: Path, arguments: list[str], seconds: float | None = None) -> tuple:
            folder.mkdir(exist_ok=True)
            process, start = context.Process(target=undertake, args=(folder, arguments)), time()
            process.start()
            process.join(seconds)
            process.kill()
            process.join()
            return process.exitcode, time() - start

        yield run


@pytest.fixture(scope="module")
def room(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room that all commands work on: what is killed is the command's own work."""
    folder = tmp_path_factory.mktemp("room")
    assert run(folder, [*COMMANDS["map"], "--frames", ":2"])[0] == 0
    return folder / "runs" / "rooms"


def result(folder: Path) -> dict[str, object]:
    """All of a result that the clock does not enter, by file and part."""
    found: dict[str, object] = {path.name: "there" for path in folder.iterdir()}
    for path in folder.iterdir():
        if path.suffix in (".txt", ".ply") or path.name.startswith("table_1"):
            found[path.name] = path.read_bytes()
        elif path.name in ("frames.csv", "history.csv"):
            found[path.name] = pd.read_csv(path).drop(columns="seconds", errors="ignore").to_csv()
        elif path.name == MAP_FILE:
            found[path.name] = read_map(path).key
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_and_told_again(name: str, run: Run, room: Path, tmp_path: Path) -> None:
    """Catches half-written results that count, and runs that go on otherwise than they began."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        shutil.copytree(room, folder / "runs" / "rooms")
    status, seconds = run(whole, COMMANDS[name])
    assert status == 0
    expected = result(whole / "out")
    assert len(expected) >= 3
    rng, kills = random.Random(name), 0
    while kills < max(1, KILLS // len(COMMANDS)):
        status, _ = run(killed, COMMANDS[name], rng.uniform(0.02, 0.7) * seconds)
        assert status in (0, -9)
        kills += status == -9
        if status == 0:  # it ended before the kill: the next one begins from nothing
            assert result(killed / "out") == expected
            shutil.rmtree(killed)
            shutil.copytree(room, killed / "runs" / "rooms")
    assert run(killed, COMMANDS[name])[0] == 0
    assert result(killed / "out") == expected
    assert len(list((killed / "out").rglob(".*.tmp"))) <= kills
    if name == "track":
        assert len(read_tum(killed / "out/trajectory.txt")[0]) == 7
