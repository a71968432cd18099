"""Mapping, tracking and tables killed at any moment, then told the same again: the same result.

`test_grid.py` does so for tables with workers. Here one process that has imported everything
forks a child for each command, so that many kills are affordable: NBTRACK_TEST_KILLS=30.
"""

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest
from tiny import tiny_words

from nbtrack.mapping.files import MAP_FILE, read_map
from nbtrack.tracking.trajectories import read_tum

KILLS = int(os.environ.get("NBTRACK_TEST_KILLS", "3"))
# Forks a child for each line `[folder, arguments, seconds until SIGKILL or null]`; answers with
# its exit status, negative where it was killed, and how long it ran. Checkpoints are written after
# every step, or every other command would be over before its first one.
_FORKER = """
import json, os, signal, sys, time
import torch._dynamo, trimesh  # else every child would import them by itself
import nbtrack.experiments.commands_tables, nbtrack.experiments.runs
import nbtrack.mapping.fit, nbtrack.tracking.trajectories
from nbtrack.cli import main
nbtrack.mapping.fit.CHECKPOINT_SECONDS = nbtrack.tracking.trajectories.CHECKPOINT_SECONDS = 0.0
for line in sys.stdin:
    folder, arguments, seconds = json.loads(line)
    start = time.monotonic()
    child = os.fork()
    if not child:
        os.makedirs(folder, exist_ok=True)
        os.chdir(folder)
        os.environ["NBTRACK_RUNS"] = folder + "/runs"
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        status = 1
        try:
            status = main(arguments)
        finally:
            sys.stderr.flush()
            os._exit(status)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(json.dumps([status, time.monotonic() - start]), flush=True)
"""
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


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    """Runs commands in children of one process that has imported the package."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("NBTRACK_")}
    kept["PYTHONPATH"] = str(Path(__file__).parents[1])
    forker = subprocess.Popen(
        [sys.executable, "-c", _FORKER], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env=kept,
    )  # fmt: skip

    def run(folder: Path, arguments: list[str], seconds: float | None = None) -> tuple[int, float]:
        forker.stdin.write(json.dumps([str(folder), arguments, seconds]) + "\n")
        forker.stdin.flush()
        return tuple(json.loads(forker.stdout.readline()))

    yield run
    forker.communicate()  # ends with its input


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
        if path.suffix in (".txt", ".ply") or path.name.startswith(("history", "table_1")):
            found[path.name] = path.read_bytes()
        elif path.name == "frames.csv":
            found[path.name] = pd.read_csv(path).drop(columns="seconds").to_csv()
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
