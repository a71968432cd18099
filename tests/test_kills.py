"""Mapping, tracking and tables killed at any moment, then told the same again: the same result.

`test_resume.py` does so for tables with workers. Here one process that has imported everything
forks a child for each command, so that many kills are affordable: NBTRACK_TEST_KILLS=30.
"""

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
import torch
from tiny import TINY

from nbtrack.trajectories import read_tum

KILLS = int(os.environ.get("NBTRACK_TEST_KILLS", "3"))
# Forks a child for each line `[arguments, seconds until SIGKILL or null]`; answers with its exit
# status, negative where it was killed, and how long it ran. Checkpoints are written after every
# step, or every other command would be over before its first one.
_FORKER = """
import json, os, signal, sys, time
import nbtrack.commands, nbtrack.commands_tables, nbtrack.mapping, nbtrack.tracking
from nbtrack.cli import main
nbtrack.mapping.CHECKPOINT_SECONDS = nbtrack.tracking.CHECKPOINT_SECONDS = 0.0
for line in sys.stdin:
    arguments, seconds = json.loads(line)
    start = time.monotonic()
    child = os.fork()
    if not child:
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
SET = [word for setting in (*TINY, "mapping.neus.iterations=25", "mapping.imap.iterations=25",
                            "scenes.n_frames=10", "tracking.lm.n_pixels=32")
       for word in ("--set", setting)]  # fmt: skip
COMMANDS = {
    "map": ["map", "living_room", "--field", "neus", "--out", "out", *SET],
    "track": ["track", "living_room", "--field", "neus", "--tracker", "lm", "--steps", "6",
              "--out", "out", *SET],
    "tables": ["tables", "--workers", "1", "--out", "out", "--scenes", "living_room", "--set",
               "scenes.track_frames=:4", *SET],
}  # fmt: skip


class Forker:
    """Runs commands in children of a process that has imported the package, in some folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        kept = {k: v for k, v in os.environ.items() if not k.startswith("NBTRACK_")}
        paths = [str(Path(__file__).parents[1]), kept.get("PYTHONPATH", "")]
        kept["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        folder.mkdir()
        self.process = subprocess.Popen(
            [sys.executable, "-c", _FORKER], cwd=folder, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, env={**kept, "NBTRACK_RUNS": str(folder / "runs")},
        )  # fmt: skip

    def run(self, arguments: list[str], seconds: float | None = None) -> tuple[int, float]:
        """Exit status and running time (s) of a command, killed after some seconds if given."""
        self.process.stdin.write(json.dumps([arguments, seconds]) + "\n")
        self.process.stdin.flush()
        status, ran = json.loads(self.process.stdout.readline())
        return status, ran

    def close(self) -> None:
        """End the process, whose children have ended."""
        self.process.communicate()


@pytest.fixture
def forkers(tmp_path: Path) -> Iterator[tuple[Forker, Forker]]:
    both = Forker(tmp_path / "undisturbed"), Forker(tmp_path / "disturbed")
    yield both
    for forker in both:
        forker.close()


def result(folder: Path) -> dict[str, object]:
    """All of a result that the clock does not enter, by file and part."""
    found: dict[str, object] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".txt", ".ply") or path.name == "history.csv":
            found[path.name] = path.read_bytes()
        elif path.name == "frames.csv":
            found[path.name] = pd.read_csv(path).drop(columns="seconds").to_csv()
        elif path.name == "map.pt":
            state = torch.load(path, weights_only=True)["field"]
            found[path.name] = {name: value.numpy().tobytes() for name, value in state.items()}
        elif path.name.startswith("table_1") and path.suffix in (".csv", ".tex"):
            found[path.name] = path.read_bytes()
        else:
            found[path.name] = "there"
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_and_told_again(name: str, forkers: tuple[Forker, Forker], tmp_path: Path) -> None:
    """Catches half-written results that count, and runs that go on otherwise than they began."""
    undisturbed, disturbed = forkers
    # A first map elsewhere makes the room and loads what is loaded once: what is killed is the
    # command's own work.
    for forker in forkers:
        assert forker.run([*COMMANDS["map"], "--out", "first", "--frames", ":3"])[0] == 0
    status, seconds = undisturbed.run(COMMANDS[name])
    assert status == 0
    rng, killed = random.Random(name), 0
    kills = max(1, KILLS // len(COMMANDS))
    while killed < kills:
        status, _ = disturbed.run(COMMANDS[name], rng.uniform(0.02, 0.7) * seconds)
        assert status in (0, -9)
        killed += status == -9
        if status == 0:  # it ended before the kill: the next one begins from nothing
            assert result(tmp_path / "disturbed/out") == result(tmp_path / "undisturbed/out")
            shutil.rmtree(tmp_path / "disturbed/out")
            shutil.rmtree(tmp_path / "disturbed/runs")
    assert disturbed.run(COMMANDS[name])[0] == 0
    expected = result(tmp_path / "undisturbed/out")
    assert len(expected) >= 3
    assert result(tmp_path / "disturbed/out") == expected
    unfinished = list((tmp_path / "disturbed/out").rglob(".*.tmp"))
    assert len(unfinished) <= killed
    if name == "track":
        assert len(read_tum(tmp_path / "disturbed/out/trajectory.txt")[0]) == 9
