"""Jobs here, in processes and on Dask: order, progress, failures told, nothing left running.
And tables killed while they map or track, then started again: the same result.
"""

import contextlib
import io
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import dataclass, field
from glob import glob
from pathlib import Path

import dask
import psutil
import pytest
from distributed import LocalCluster
from forked import forking
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.experiments.jobs import Execution, Job, Report, run_jobs
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import locked

# Dask's own threads and sockets warn as they are torn down.
pytestmark = pytest.mark.filterwarnings("default")


@dataclass(frozen=True)
class Square(Job):
    """A job that squares a number; or fails, or takes its process with it."""

    number: int
    how: str = "well"
    needs: "Square | None" = None
    is_done: bool = False
    maker: int = field(default_factory=os.getpid)  # the process that asks for it
    kind, key = "squares", "0"
    name = property(lambda self: f"square {self.number}")
    is_timed = property(lambda self: self.how == "alone")

    def result(self) -> int:
        return self.number**2

    def compute(self, report: Report) -> int:
        if self.how == "badly":
            raise DataError(f"depth{self.number}.png is empty")
        if self.how == "alone" and os.getpid() != self.maker:
            raise DataError("it runs beside others")
        if self.how == "deadly":
            os._exit(1)
        # Long enough for a report, which is written after a second, to be seen.
        end = time.monotonic() + (2.0 if self.how == "slowly" else 0.0)
        while time.monotonic() < end:
            report(0.5, "half")
            time.sleep(0.1)
        return self.result()


@pytest.fixture(scope="module")
def address():
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
def execution(request, address: str):
    """All ways of running jobs."""
    ways = {"here": {"workers": 1}, "in processes": {"workers": 2}}
    with forking():
        yield ways.get(request.param, {"dask": address})


def test_results_come_in_order(execution: dict, capsys) -> None:
    """Catches results in the order of their completion, twins computed twice, early noise, and jobs
    that are timed while others run."""
    jobs = [Square(3), Square(1, needs=Square(4)), Square(3), Square(5, is_done=True)]
    assert run_jobs(jobs, Execution(**execution)) == [9, 1, 9, 25]
    timed = [Square(2, "alone", needs=Square(3)), Square(5, "alone", needs=Square(4))]
    assert run_jobs(timed, Execution(**execution)) == [4, 25]
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
def test_a_worker_that_dies_costs_its_own_job(execution: dict) -> None:
    """Catches a traceback, or waiting for ever, where the system took a worker away, a table that
    ends there, and the blame on jobs that ran beside it."""
    slow, deadly = Square(2, "slowly"), Square(7, "deadly")
    jobs = [slow, deadly, Square(3, needs=deadly), Square(4, needs=slow), Square(5, needs=slow)]
    squared, died, not_run, *others = run_jobs(jobs, Execution(**execution, keep_going=True))
    assert str(died).startswith("a worker process died at square 7, ")
    assert "\n" not in str(died)
    assert "not run, because square 7 failed: " in str(not_run)
    assert [squared, *others] == [4, 16, 25]


def test_the_bar_moves_before_a_job_ends(monkeypatch, execution: dict) -> None:
    """Catches a bar that stands still for as long as a map takes, or misses jobs elsewhere."""
    seen = []
    monkeypatch.setattr("nbtrack.experiments.jobs._LOOK_SECONDS", 0.05)  # workers have the usual
    monkeypatch.setattr(
        "nbtrack.machinery.progress.ProgressBar.move_to",
        lambda bar, done, status="": seen.append((done, status)),
    )
    assert run_jobs([Square(1, "slowly"), Square(2)], Execution(**execution)) == [1, 4]
    assert {1, 2} <= {done for done, _ in seen}
    assert any(done in (0.5, 1.5) and "square 1: half" in status for done, status in seen)


def tables(folder: Path, *options: str) -> int:
    """The command for two rooms, and trackers of first and second order, with its own cache."""
    words = tiny_words("tables.rates_hz=[10]", "scenes.track_frames=:4")
    words += ["--method", "sdf,baked", "--out", str(folder / "out"), *options]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NBTRACK_RUNS", str(folder / "runs"))
        return main(["tables", *words])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> bytes:
    """The table as one process makes it."""
    folder = tmp_path_factory.mktemp("here")
    assert tables(folder, "--workers", "1") == 0
    return (folder / "out/table_1_cells.csv").read_bytes()


def test_a_cluster_makes_the_same_table(address: str, tmp_path: Path, undisturbed: bytes) -> None:
    """Catches jobs that the cluster computes otherwise, or keeps where nobody looks."""
    assert tables(tmp_path, "--dask", address) == 0
    assert (tmp_path / "out/table_1_cells.csv").read_bytes() == undisturbed


def undertake(folder: Path, workers: str) -> None:
    """The command in a process of its own, which writes checkpoints after every step."""
    with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        patch.setattr("nbtrack.machinery.files.CHECKPOINT_SECONDS", 0.0)
        stack.enter_context(forking() if workers != "1" else contextlib.nullcontext())
        sys.exit(tables(folder, "--workers", workers))


def test_killed_and_started_again(tmp_path: Path, undisturbed: bytes) -> None:
    """Catches workers that outlive their parent, finished maps that are made again, half-written
    ones that count as done, and jobs that go on from a checkpoint otherwise than they began."""
    made = {}
    for file, workers in (("mapping.pt", 1), ("map.safetensors", 2), ("run.pt", 1)):
        with forking() as context:
            process = context.Process(target=undertake, args=(tmp_path, str(workers)))
            process.start()
        while not {*glob(f"{tmp_path}/**/{file}", recursive=True)} - {*map(str, made)}:
            assert process.is_alive(), f"it ended before its first {file}"
            time.sleep(0.01)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2 * (workers - 1)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        assert psutil.wait_procs(children, timeout=30)[1] == []
        assert {path: path.stat().st_mtime_ns for path in made} == made
        made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("map.safetensors")}
    assert len([*tmp_path.rglob("metrics.json")]) < 4, "nothing was left to do"
    assert tables(tmp_path, "--workers", "1") == 0
    assert (tmp_path / "out/table_1_cells.csv").read_bytes() == undisturbed


def test_no_scheduler(capsys, monkeypatch, tmp_path: Path) -> None:
    """Catches a traceback of sockets where the address is wrong, and jobs that run here then."""
    monkeypatch.setattr("nbtrack.experiments.workers._SECONDS_TO_CONNECT", 0.5)
    assert tables(tmp_path, "--dask", "tcp://127.0.0.1:9") == 2
    assert "no Dask scheduler at 'tcp://127.0.0.1:9'" in capsys.readouterr().err.splitlines()[-1]


def test_another_process_is_waited_for_in_silence(tmp_path: Path, capsys) -> None:
    """Catches work that is done beside the one who holds its lock, and a warning of waiting."""
    done = []

    def work() -> None:
        with locked(tmp_path / "a.lock"):
            done.append("second")

    other = threading.Thread(target=work)
    with warnings.catch_warnings(action="error"), locked(tmp_path / "a.lock"):
        other.start()
        other.join(0.3)
        done.append("first")
    other.join()
    assert done == ["first", "second"]
    assert capsys.readouterr() == ("", "")


# To the whole group, as a terminal does; a shell's background jobs ignore it.
SCRIPT = """
import glob, multiprocessing, os, signal, sys, threading, time
from nbtrack.cli import main

def press():
    while not ({condition}):
        time.sleep(0.01)
    time.sleep({seconds})
    os.killpg(0, signal.SIGINT)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=press).start()
    sys.exit(main({words}))
"""
IMPORTING = "'torch' in sys.modules", 0.1
BEGINNING = "len(multiprocessing.active_children()) > 1", 0.3
WORKING = "glob.glob(os.environ['NBTRACK_RUNS'] + '/locks/*')", 1.0


@pytest.mark.parametrize("moment", [IMPORTING, BEGINNING, WORKING])
def test_interrupted(moment: tuple[str, float], tmp_path: Path, monkeypatch) -> None:
    """Catches tracebacks, also of workers, Ctrl-C that does not end a command, and processes left
    behind: then the pipe that they all write to would stay open."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    long = "mapping.imap.iterations=100000", "mapping.neus.iterations=100000"
    words = ["tables", "--workers", "2", *tiny_words(*long)]
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(condition=moment[0], seconds=moment[1], words=words))
    run = [sys.executable, str(script)]
    found = subprocess.run(run, stderr=subprocess.PIPE, text=True, start_new_session=True)
    if moment is IMPORTING:  # it ends at once, as by a signal
        assert (found.returncode, found.stderr) == (-signal.SIGINT, "")
        return
    assert found.returncode == 130, found.stderr
    assert not [word for word in ("Traceback", "Warning") if word in found.stderr]
    assert "interrupted" in found.stderr.splitlines()[-1]
