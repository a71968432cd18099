"""Jobs here, in processes and on Dask: order, progress, failures told, nothing left running.
And mapping, tracking and tables killed at any moment, then started again: the same result.

More kills: NBTRACK_TEST_KILLS=30.
"""

import contextlib
import io
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path
from typing import Any

import dask
import pandas as pd
import psutil
import pytest
from distributed import LocalCluster
from finished import isolate
from forked import forking
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.core.errors import DataError, NbtrackError
from nbtrack.experiments.jobs import Execution, Job, Report, run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import load_preset
from nbtrack.experiments.scenes import open_scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.mapping.files import MAP_FILE, read_map
from nbtrack.tracking.trajectories import read_tum

# Dask's own threads and sockets warn as they are torn down.
pytestmark = pytest.mark.filterwarnings("default")


@dataclass(frozen=True)
class Square(Job):
    """A job that squares a number; or fails, or takes its process with it."""

    number: int
    how: str = "well"
    needs: "Square | None" = None
    is_done: bool = False
    kind, key = "squares", "0"

    @property
    def name(self) -> str:
        return f"square {self.number}"

    def result(self) -> int:
        return self.number**2

    def compute(self, report: Report) -> int:
        if self.how == "badly":
            raise DataError(f"depth{self.number}.png is empty")
        if self.how == "deadly":
            os._exit(1)
        report(0.5, "half")
        return self.result()


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a scheduler with two workers in processes of their own."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        forking(),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture(params=["here", "in processes", "on a cluster"])
def execution(request: pytest.FixtureRequest, address: str) -> Iterator[dict[str, Any]]:
    """All ways of running jobs."""
    ways = {
        "here": {"workers": 1},
        "in processes": {"workers": 2},
        "on a cluster": {"dask": address},
    }
    with forking():
        yield ways[request.param]


def test_results_come_in_order(execution: dict, capsys: pytest.CaptureFixture) -> None:
    """Catches results in the order of their completion, twins computed twice, and early noise."""
    jobs = [Square(3), Square(1, needs=Square(4)), Square(3), Square(5, is_done=True)]
    assert run_jobs(jobs, Execution(**execution)) == [9, 1, 9, 25]
    if execution == {"workers": 1}:
        assert capsys.readouterr().err == ""


def test_a_users_mistake_comes_through_and_others_go_on(execution: dict) -> None:
    """Catches errors of workers that lose their class or message on the way, one bad job that ends
    the grid, and dependants that do not know why they failed."""
    bad = Square(7, "badly")
    jobs = [bad, Square(2, needs=bad), Square(3)]
    with pytest.raises(DataError, match=r"depth7.png is empty"):
        run_jobs(jobs, Execution(**execution))
    results = run_jobs(jobs, Execution(**execution, keep_going=True))
    assert isinstance(results[0], DataError)
    assert str(results[1]) == "not run, because square 7 failed: depth7.png is empty"
    assert results[2] == 9


@pytest.mark.parametrize("execution", ["in processes", "on a cluster"], indirect=True)
def test_a_worker_that_dies_is_explained(execution: dict) -> None:
    """Catches a traceback, or waiting for ever, where the system took a worker away."""
    with pytest.raises(NbtrackError, match=r"a worker process died at .*square 7") as caught:
        run_jobs([Square(7, "deadly"), Square(2)], Execution(**execution))
    assert "\n" not in str(caught.value)


def test_the_bar_moves(monkeypatch: pytest.MonkeyPatch, execution: dict) -> None:
    """Catches a bar that stands still for as long as a map takes, or misses jobs elsewhere."""
    seen = []
    monkeypatch.setattr(
        "nbtrack.core.progress.ProgressBar.move_to",
        lambda bar, done, status="": seen.append((done, status)),
    )
    run_jobs([Square(1), Square(2)], Execution(**execution))
    assert {1, 2} < {done for done, _ in seen}
    if execution == {"workers": 1}:
        assert any(done == 1.5 and "half" in status for done, status in seen)


def test_the_bar_weighs_jobs_by_their_work() -> None:
    """Catches an ETA off by a factor, where a run of LM counts as much as a map.

    By hand: 1,200 iterations of 96 rays with 44 samples; 119 frames of 15 steps with 64 pixels of
    44 samples.
    """
    preset = load_preset("smoke", settings=["scenes.n_frames=120", "scenes.width=16"])
    scene = open_scene("office", preset)
    made = MapJob.of(scene, "imap", preset)
    vr, lm = (TrackJob(made, scene, name, preset.tracking_of(name), 15) for name in ("vr", "lm"))
    assert 1200 * 96 * 44 < made.work < 1.5 * 1200 * 96 * 44
    assert vr.work == 120 * 15 * 64 * 44
    assert lm.work < vr.work / 2
    clock = [replace(vr, steps=None, rate_hz=rate).work for rate in (2, 10)]
    assert clock[0] == 5 * clock[1]


def words(folder: Path, *options: str) -> list[str]:
    """The command for two rooms, and trackers of first and second order."""
    settings = tiny_words("tables.rates_hz=[10]", "scenes.track_frames=:4")
    out = ["--out", str(folder / "out")]
    return ["tables", "--method", "sdf,baked", *out, *settings, *options]


def tables(folder: Path, *options: str) -> int:
    """The command in this process, with its own cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NBTRACK_RUNS", str(folder / "runs"))
        return main(words(folder, *options))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table as one process makes it."""
    folder = tmp_path_factory.mktemp("here")
    assert tables(folder, "--workers", "1") == 0
    return (folder / "out/table_1_cells.csv").read_bytes()


def test_a_cluster_makes_the_same_table(address: str, tmp_path: Path, undisturbed: bytes) -> None:
    """Catches jobs that the cluster computes otherwise, or keeps where nobody looks."""
    assert tables(tmp_path, "--dask", address) == 0
    assert (tmp_path / "out/table_1_cells.csv").read_bytes() == undisturbed
    # A failure in a worker comes back as one line, and the other jobs still run.
    for file in tmp_path.rglob("office*/**/depth_filtered/depth1.png"):
        file.write_bytes(b"no image")
    for kind in ("maps", "tracks"):
        for folder in (tmp_path / "runs" / kind).glob("office-*"):
            shutil.rmtree(folder)
    assert tables(tmp_path, "--dask", address) == 2
    text = (tmp_path / "out/table_1.csv").read_text()
    assert "living_room,\n" not in text
    assert text.count("office,\n") == 2


def test_killed_with_two_workers_and_started_again(tmp_path: Path, undisturbed: bytes) -> None:
    """Catches workers that outlive their parent, finished jobs that are made again, and
    half-written ones that count as done."""
    arguments = words(tmp_path, "--workers", "2")
    with forking() as context:
        process = context.Process(target=undertake, args=(tmp_path, arguments))
        process.start()
    while not glob(f"{tmp_path}/**/map.safetensors", recursive=True):  # folders come and go
        assert process.is_alive(), "it ended before its first map"
        time.sleep(0.01)
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert psutil.wait_procs(workers, timeout=30)[1] == []
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")}
    assert len(made) < 4, "nothing was left to do"
    assert tables(tmp_path, "--workers", "1") == 0
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert (tmp_path / "out/table_1_cells.csv").read_bytes() == undisturbed


def test_no_scheduler(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a traceback of sockets where the address is wrong."""
    monkeypatch.setattr("nbtrack.experiments.jobs._SECONDS_TO_CONNECT", 0.5)
    assert tables(tmp_path, "--dask", "tcp://127.0.0.1:9") == 2
    assert "no Dask scheduler at 'tcp://127.0.0.1:9'" in capsys.readouterr().err.splitlines()[-1]


KILLS = int(os.environ.get("NBTRACK_TEST_KILLS", "2"))
SET = tiny_words(
    "mapping.neus.iterations=15", "mapping.neus.holdout_every=0",
    "scenes.n_frames=8",
)  # fmt: skip
COMMANDS = {
    "map": ["map", "living_room", "--field", "neus", "--out", "out", *SET],
    "track": ["track", "living_room", "--field", "neus", "--tracker", "lm", "--steps", "4",
              "--out", "out", *SET],
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
            process = context.Process(target=undertake, args=(folder, arguments))
            start = time.monotonic()
            process.start()
            process.join(seconds)
            process.kill()
            process.join()
            return process.exitcode, time.monotonic() - start

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
        if path.suffix in (".txt", ".ply"):
            found[path.name] = path.read_bytes()
        elif path.name in ("frames.csv", "history.csv"):
            found[path.name] = pd.read_csv(path).drop(columns="seconds", errors="ignore").to_csv()
        elif path.name == MAP_FILE:
            found[path.name] = read_map(path).key
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_and_started_again(name: str, run: Run, room: Path, tmp_path: Path) -> None:
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
    assert len(list(killed.rglob(".*.tmp"))) <= kills
    if name == "track":
        assert len(read_tum(killed / "out/trajectory.txt")[0]) == 7
