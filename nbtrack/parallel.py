"""Independent jobs side by side in processes, under one progress bar with an ETA.

Small networks gain nothing from a second thread, so rooms and methods share the cores instead.
"""

import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import torch
from tqdm import tqdm

from nbtrack.errors import NbtrackError

Report = Callable[[int, str], None]
"""Called by a job with the units done so far and a word on how it goes."""


@dataclass(frozen=True)
class Job:
    """One piece of work: `function(*arguments, report=...)`, picklable, importable by name."""

    name: str
    total: int  # units of work, for the bar: iterations or frames
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def run_jobs(jobs: Sequence[Job], title: str, workers: int | None = None) -> list[Any]:
    """Run all jobs and return their results in order.

    Args:
        title: stands before the progress bar.
        workers: processes; by default one a core, or this process alone where a GPU does the
            work: jobs on one GPU only wait for each other.

    Raises:
        Whatever the first failing job raised; the others are then abandoned.
    """
    if workers is None:
        workers = 1 if torch.cuda.is_available() else os.cpu_count() or 1
    workers = min(workers, len(jobs))
    total = sum(job.total for job in jobs)
    # A terminal can be written to often. Elsewhere every line is kept: a notebook's kernel drops
    # messages, its last ones too, once a thousand wait to be read.
    seconds = 0.1 if sys.stderr.isatty() else 3.0
    # The bar waits a moment, so that a mistake which ends the first job at once is told alone.
    with tqdm(
        total=total, desc=title, unit="step", disable=not jobs, delay=1.0, mininterval=seconds
    ) as bar:
        board = _Board(bar)
        if workers <= 1:
            return [
                job.function(*job.arguments, report=board.reporter(job.name)) for job in jobs
            ]
        return _run_in_processes(jobs, workers, board)


class _Board:
    """The bar's state: how far each job is."""

    def __init__(self, bar: tqdm) -> None:
        self.bar = bar
        self.done: dict[str, int] = {}

    def show(self, name: str, done: int, status: str) -> None:
        self.bar.update(done - self.done.get(name, 0))
        self.done[name] = done
        self.bar.set_postfix_str(f"{name}: {status}", refresh=False)

    def reporter(self, name: str) -> Report:
        return lambda done, status: self.show(name, done, status)


def _run_in_processes(jobs: Sequence[Job], workers: int, board: _Board) -> list[Any]:
    # Fresh interpreters: a forked one would inherit torch's thread pool in an unusable state.
    context = multiprocessing.get_context("spawn")
    threads = max(1, (os.cpu_count() or 1) // workers)
    with context.Manager() as manager:
        # The manager is a process as well, and ends by itself.
        running_before = set(multiprocessing.active_children())
        messages = manager.Queue()
        pool = ProcessPoolExecutor(workers, context, _start_worker, (threads, os.getpid()))
        try:
            futures = [pool.submit(_run_one, job, messages) for job in jobs]
            pending: set[Future] = set(futures)
            while pending:
                finished, pending = wait(pending, timeout=0.3, return_when=FIRST_EXCEPTION)
                _show_messages(messages, board)
                for future in finished:
                    future.result()
        except BaseException as error:
            # Nobody waits for what is still running; what it has kept can be resumed.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - running_before:
                process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise NbtrackError(
                    "a worker process died, perhaps for lack of memory: what was finished is "
                    "kept; run the same command again, with smaller settings if need be"
                ) from None
            raise
        pool.shutdown()
        return [future.result() for future in futures]


def _start_worker(threads: int, parent: int) -> None:
    torch.set_num_threads(threads)
    # An interruption of the command is the parent's to handle; the parent's end is ours.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _run_one(job: Job, messages: Any) -> Any:
    return job.function(
        *job.arguments, report=lambda done, status: messages.put((job.name, done, status))
    )


def _show_messages(messages: Any, board: _Board) -> None:
    while True:
        try:
            board.show(*messages.get_nowait())
        except queue.Empty:
            return
