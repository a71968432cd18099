"""Independent jobs side by side in processes, under one progress bar with an ETA.

Small networks gain nothing from a second thread, so rooms and methods share the cores instead.
"""

import multiprocessing
import os
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import torch
from tqdm.auto import tqdm

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
    with tqdm(total=total, desc=title, unit="step", disable=not jobs) as bar:
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
    with context.Manager() as manager:
        messages = manager.Queue()
        threads = max(1, (os.cpu_count() or 1) // workers)
        with ProcessPoolExecutor(workers, context, _start_worker, (threads,)) as pool:
            futures = [pool.submit(_run_one, job, messages) for job in jobs]
            pending: set[Future] = set(futures)
            while pending:
                finished, pending = wait(pending, timeout=0.3, return_when=FIRST_EXCEPTION)
                _show_messages(messages, board)
                if any(future.exception() for future in finished):
                    pool.shutdown(wait=False, cancel_futures=True)
                    break
            return [future.result() for future in futures]


def _start_worker(threads: int) -> None:
    torch.set_num_threads(threads)


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
