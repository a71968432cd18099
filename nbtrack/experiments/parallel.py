"""Jobs side by side in processes, under one progress bar with an ETA over all of them.

Small networks gain nothing from a second thread, so rooms and methods share the cores instead.
"""

import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.managers import SyncManager
from typing import Any

import torch
from tqdm import tqdm

from nbtrack.core.device import choose_device
from nbtrack.core.errors import NbtrackError

Report = Callable[[int, str], None]
"""Called by a job with the units done so far and a word on how it goes."""


def quiet(done: int, status: str) -> None:
    """A report that nobody reads."""


_BAR = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"


@dataclass(frozen=True)
class Job:
    """One piece of work: `function(*arguments, report=...)`, picklable, importable by name."""

    name: str  # no two jobs of one call share it
    total: int  # units of work that it reports: iterations or frames
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    cost: float | int = 0  # work in all, relative to other jobs: the bar's share; 0 means `total`
    needs: tuple[str, ...] = ()  # jobs that must have ended well before; they stand earlier
    label: str = ""  # shown beside the bar in place of the name


@dataclass(frozen=True)
class Execution:
    """How jobs are run; of all this only the threads may change last digits of a result."""

    # Processes; by default one a core, or this process alone where a GPU does the work: jobs on
    # one GPU only wait for each other.
    workers: int | None = None
    threads: int | None = None  # of each job; by default this process's, divided by the workers
    cluster: str | None = None  # address of a Dask scheduler that runs the jobs instead
    # A user's mistake in one job stands in its place among the results, as the exception, and so
    # does one for every job that needs it; the others still run.
    keep_going: bool = False


def run_jobs(jobs: Sequence[Job], title: str, execution: Execution | None = None) -> list[Any]:
    """Run all jobs and return their results in order.

    Args:
        title: stands before the progress bar.

    Raises:
        Whatever the first failing job raised, unless it is to keep going; the others are then
        abandoned.
    """
    execution = execution or Execution()
    workers = execution.workers
    if workers is None:
        workers = 1 if choose_device().type != "cpu" else os.cpu_count() or 1
    threads = execution.threads or max(1, torch.get_num_threads() // max(workers, 1))
    with _bar(jobs, title) as bar:
        board = Board(bar, jobs, execution.keep_going)
        if execution.cluster is not None and jobs:
            from nbtrack.experiments.cluster import run_on_cluster

            run_on_cluster(jobs, execution.cluster, execution.threads or 1, board)
        elif min(workers, len(jobs)) > 1:
            _run_in_processes(jobs, min(workers, len(jobs)), threads, board)
        else:
            with _threads(threads):
                _run_here(jobs, board)
    return [board.results[job.name] for job in jobs]


class Board:
    """What is known of the jobs while they run: progress, results, and mistakes."""

    def __init__(self, bar: tqdm, jobs: Sequence[Job], keep_going: bool) -> None:
        self.bar = bar
        self.jobs = {job.name: job for job in jobs}
        self.keep_going = keep_going
        self.units: dict[str, int] = {}
        self.results: dict[str, Any] = {}

    def show(self, name: str, done: int, status: str) -> None:
        """Move the bar to where a job says it is."""
        job = self.jobs[name]
        a_unit = (job.cost or job.total) / max(job.total, 1)
        work = a_unit * (done - self.units.get(name, 0))
        # Sums of fractions may end a rounding error above the total, which a bar does not like.
        self.bar.update(min(work, self.bar.total - self.bar.n))
        self.units[name] = done
        ended = f"{len(self.results)} of {len(self.jobs)} done"
        self.bar.set_postfix_str(f"{ended}, {job.label or name}: {status}", refresh=False)

    def reporter(self, name: str) -> Report:
        """A report function for a job of this process."""
        return lambda done, status: self.show(name, done, status)

    def settle(self, job: Job, outcome: Callable[[], Any]) -> None:
        """Note what a job returned. Raises what it raised, unless that is to be kept."""
        try:
            self.results[job.name] = outcome()
        except NbtrackError as error:
            if not self.keep_going:
                raise
            self.results[job.name] = error
        self.show(job.name, job.total, "done")

    def is_ready(self, job: Job) -> bool:
        """Whether all that a job needs has ended, well or not."""
        return all(name in self.results for name in job.needs)

    def settle_if_hopeless(self, job: Job) -> bool:
        """Whether something that a job needs has failed; its result is then the reason."""
        failed = [n for n in job.needs if isinstance(self.results.get(n), NbtrackError)]
        if failed:
            reason = self.results[failed[0]]
            self.results[job.name] = NbtrackError(f"not run, because {failed[0]} failed: {reason}")
            self.show(job.name, job.total, "left out")
        return bool(failed)


def _bar(jobs: Sequence[Job], title: str) -> tqdm:
    # A terminal can be written to often. Elsewhere every line is kept: a notebook's kernel drops
    # messages, its last ones too, once a thousand wait to be read.
    seconds = 0.1 if sys.stderr.isatty() else 3.0
    total = sum(job.cost or job.total for job in jobs)
    # The bar waits a moment, so that a mistake which ends the first job at once is told alone.
    return tqdm(
        total=total, desc=title, bar_format=_BAR, disable=not jobs, delay=1.0, mininterval=seconds
    )


@contextmanager
def _threads(number: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _run_here(jobs: Sequence[Job], board: Board) -> None:
    for job in jobs:
        if not board.settle_if_hopeless(job):
            report = board.reporter(job.name)
            board.settle(job, lambda j=job, r=report: j.function(*j.arguments, report=r))


def _run_in_processes(jobs: Sequence[Job], workers: int, threads: int, board: Board) -> None:
    # Fresh interpreters: a forked one would inherit torch's thread pool in an unusable state.
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    # It is a process as well, and must not outlive a killed command either.
    manager.start(_end_with_parent, (os.getpid(),))
    with manager:
        running_before = set(multiprocessing.active_children())
        messages = manager.Queue()
        pool = ProcessPoolExecutor(workers, context, _start_worker, (threads, os.getpid()))
        try:
            _feed(pool, jobs, messages, board)
        except BaseException as error:
            # Nobody waits for what is still running; what it has kept can be resumed.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - running_before:
                process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise NbtrackError(
                    "a worker process died, perhaps for lack of memory: what was finished is "
                    "kept; run the same command again, with fewer --workers or smaller settings"
                ) from None
            raise
        pool.shutdown()


def _feed(pool: ProcessPoolExecutor, jobs: Sequence[Job], messages: Any, board: Board) -> None:
    """Give the pool every job as soon as what it needs has ended, and gather the results."""
    waiting, running = list(jobs), dict[Future, Job]()
    while waiting or running:
        for job in [job for job in waiting if board.is_ready(job)]:
            waiting.remove(job)
            if not board.settle_if_hopeless(job):
                running[pool.submit(_run_one, job, messages)] = job
        finished, _ = wait(running, timeout=0.3, return_when=FIRST_COMPLETED)
        _show_messages(messages, board)
        for future in finished:
            board.settle(running.pop(future), future.result)


def _start_worker(threads: int, parent: int) -> None:
    torch.set_num_threads(threads)
    # An interruption of the command is the parent's to handle; the parent's end is ours.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent(parent)


def _end_with_parent(parent: int) -> None:
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _run_one(job: Job, messages: Any) -> Any:
    return job.function(
        *job.arguments, report=lambda done, status: messages.put((job.name, done, status))
    )


def _show_messages(messages: Any, board: Board) -> None:
    while True:
        try:
            name, done, status = messages.get_nowait()
        except queue.Empty:
            return
        if name not in board.results:
            board.show(name, done, status)
