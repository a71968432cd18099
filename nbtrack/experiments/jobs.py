"""Jobs: pieces of work that are named by all that they depend on and made once, and their running.

They run one after the other here, or side by side in processes or on a Dask cluster: small networks
gain nothing from a second thread, so scenes and methods share the cores instead.
"""

import contextlib
import importlib.util
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import torch

from nbtrack.experiments.output import check_no_recording
from nbtrack.fields import FIELDS
from nbtrack.machinery.device import (
    advise_on_memory,
    choose_device,
    threads,
    usable_cores,
    usual_modes,
)
from nbtrack.machinery.errors import MissingError, NbtrackError
from nbtrack.machinery.files import data_folder, locked, runs_folder
from nbtrack.machinery.progress import ProgressBar
from nbtrack.tracking import TRACKERS

_START = "spawn"  # how worker processes begin: forked ones would lack the threads of libraries
_LOOK_SECONDS = 1.0  # between two looks at jobs elsewhere, so that the bar's clock moves
_NAME_BYTES = 180  # of a folder's name; the key, suffixes and those of temporary files follow
_SECONDS_TO_CONNECT = 10
Report = Callable[[float, str], None]
"""Called by a job with the share of it that is done and a word on how it goes."""


class Job:
    """One piece of work: picklable, its result kept in its own folder, perhaps made from another's.

    `needs` is the job whose result it is made from.
    """

    kind: str  # the part of the cache where it is kept
    name: str  # for readers
    key: str  # changes with everything that the result depends on
    doing: str = "computing"  # what its progress is called
    work: float = 1.0  # how long it takes, in tracked runs: its weight in the time that is left
    needs: "Job | None"
    is_done: bool
    result: Callable[[], Any]  # what a finished job has kept
    compute: Callable[[Report], Any]  # makes it, or takes a killed attempt up; returns `result`

    @property
    def folder(self) -> Path:
        """Where its files are kept, in the cache."""
        # A recording's folder may have a name as long as a file system allows, 255 bytes.
        name = self.name.encode(errors="replace")[:_NAME_BYTES].decode(errors="ignore")
        return runs_folder() / self.kind / f"{name}-{self.key}"

    def outcome(self, needed: Any, report: Report) -> Any:
        """Its `result`, made where it is missing, or the NbtrackError that ended it.

        `needed` is the outcome of the job that it needs: if that is an error, this one is not run.
        A lock keeps other processes out, and waits for one that makes the same; the system frees it
        when its process ends.
        """
        if isinstance(needed, NbtrackError):
            return NbtrackError(f"not run, because {self.needs.name} failed: {needed}")
        path = runs_folder() / "locks" / f"{self.folder.name}.lock"
        report(0.0, "begins, or waits for another process that makes the same")
        try:
            check_no_recording(path)
            with (
                locked(path),
                usual_modes(),
                advise_on_memory(f"the frames and settings of {self.name}"),
            ):
                return self.result() if self.is_done else self.compute(report)
        except NbtrackError as error:
            return error


@dataclass(frozen=True)
class Execution:
    """How jobs are run."""

    # Processes, which share the threads; by default one a core, or this one alone where a GPU does
    # the work: jobs share its memory, and side by side gain less (benchmarks/README.md).
    workers: int | None = None
    dask: str | None = None  # address of a Dask scheduler whose workers run the jobs instead
    # A user's mistake in one job stands among the results, also of what needs it; others still run.
    keep_going: bool = False

    def __post_init__(self) -> None:
        """Raises MissingError, before any work, if Dask is needed and not there."""
        if self.dask is not None and not importlib.util.find_spec("distributed"):
            raise MissingError("--dask needs Dask: pip install 'nbtrack[cluster]', or --workers")


def run_jobs(jobs: Sequence[Job], execution: Execution | None = None) -> list[Any]:
    """The results of all jobs, in order; those that are missing, and what they need, are made.

    Raises what the first failing job raised, unless it is to keep going.
    """
    execution = execution or Execution()
    missing = {part.folder: part for job in jobs for part in _missing(job)}
    results: dict[Path, Any] = {}
    bar = ProgressBar(Job.doing, sum(job.work for job in missing.values()))

    def show(job: Job, share: float = 0.0, status: str = "running") -> None:
        """Move the bar: to all that ended, and the `share` of a job that runs in this process."""
        worked = sum(missing[folder].work for folder in results) + share * job.work
        # Compilation makes the first frame slow, which says nothing of the time that is left.
        if 0 < share < 1 and not bar.warm_up_work:
            bar.end_warm_up(worked)
        bar.set_description_str(job.doing, refresh=False)
        bar.move_to(worked, f"{len(results)} of {len(missing)} done, {job.name}: {status}")

    outcomes = _outcomes(missing, show, execution)
    # Closing the generator leaves its `with` blocks: so workers end at once after an error too.
    with bar, contextlib.closing(outcomes):
        for folder, outcome in outcomes:
            if isinstance(outcome, NbtrackError) and not execution.keep_going:
                raise outcome
            results[folder] = outcome
            show(missing[folder], status="done")
    return [results[job.folder] if job.folder in results else job.result() for job in jobs]


def _missing(job: Job | None) -> list[Job]:
    """A job and those that it needs, as far as they are not done, what is needed first."""
    return [] if job is None or job.is_done else [*_missing(job.needs), job]


def _outcomes(jobs: Mapping[Path, Job], show: Callable, execution: Execution) -> Iterator[tuple]:
    """Pairs of each job's folder and outcome, as jobs end; a job begins after the one it needs.

    `show` is that of `run_jobs`. `jobs` are in an order in which they can be run.
    """
    usual = usable_cores() if choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, len(jobs))
    if execution.dask is not None or workers > 1:
        limit = len(jobs) if execution.dask else workers  # Dask shares them among its workers
        with _submitting(execution.dask, workers) as submit:
            yield from _elsewhere(jobs, submit, limit, show)
        return
    results: dict[Path, Any] = {}
    for folder, job in jobs.items():
        needed = results.get(job.needs.folder) if job.needs else None
        results[folder] = job.outcome(needed, partial(show, job))
        yield folder, results[folder]


def _elsewhere(jobs: Mapping[Path, Job], submit: Callable, limit: int, show: Callable) -> Iterator:
    """As `_outcomes`, of jobs that `submit` begins elsewhere, at most `limit` at a time."""
    needs = {folder: job.needs.folder if job.needs else None for folder, job in jobs.items()}
    results: dict[Path, Any] = {}
    waiting = list(jobs)
    running: dict[Future, Path] = {}
    while waiting or running:
        # Jobs that need nothing, something that is cached already, or a job that has ended.
        ready = [f for f in waiting if needs[f] in results or needs[f] not in jobs]
        for folder in ready[: limit - len(running)]:
            running[submit(jobs[folder], results.get(needs[folder]))] = folder
            waiting.remove(folder)
        names = " or ".join(folder.name for folder in running.values())
        show(jobs[next(iter(running.values()))])  # the job that began first
        ended, _ = wait(running, _LOOK_SECONDS, FIRST_COMPLETED)
        for future in ended:
            folder = running.pop(future)
            results[folder] = _result_of(future, names)
            yield folder, results[folder]


def _result_of(future: Future, names: str) -> Any:
    """What a job gave. Raises NbtrackError where a process died.

    `names` are those of all jobs that ran then: which of their processes died is not known.
    """
    error = future.exception()
    if type(error).__name__ not in ("BrokenProcessPool", "KilledWorker"):  # the latter is Dask's
        return future.result()
    died = f"a worker process died at {names}, perhaps for lack of memory"
    advice = "run it again, with fewer --workers or smaller settings; what was finished is kept"
    raise NbtrackError(f"{died}: {advice}")


@contextlib.contextmanager
def _submitting(address: str | None, workers: int) -> Iterator[Callable[[Job, Any], Future]]:
    """A function that begins a job elsewhere, given the outcome of the one that it needs.

    Elsewhere is a Dask cluster at `address`, or `workers` processes here, which end with the block.
    Folders, device, search path, fields and trackers there are those of this process. Classes of a
    notebook or script travel whole, those of files by the name of their module.
    """
    settings = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    if "NBTRACK_DEVICE" in os.environ:
        settings["NBTRACK_DEVICE"] = os.environ["NBTRACK_DEVICE"]
    # Small networks gain nothing from a second thread; processes here share this one's threads.
    n_threads = 1 if address else max(1, torch.get_num_threads() // workers)
    workplace = _cluster(address) if address else _pool(workers)
    with workplace as executor:

        def submit(job: Job, needed: Any) -> Future:
            work = cloudpickle.dumps((FIELDS, TRACKERS, job, needed))
            return executor.submit(_outcome_there, settings, sys.path, n_threads, work)

        yield submit


def _outcome_there(settings: Mapping, search_path: list[str], n_threads: int, work: bytes) -> Any:
    """What becomes of a job: runs in a worker, which may have been started elsewhere."""
    os.environ |= settings
    # Before the work is unpickled, which imports the modules of its classes.
    sys.path += [folder for folder in search_path if folder not in sys.path]
    fields, trackers, job, needed = pickle.loads(work)
    FIELDS.update(fields)
    TRACKERS.update(trackers)
    with threads(n_threads):
        return job.outcome(needed, lambda share, status: None)  # only outcomes are sent back


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Processes of this machine, which end with the block, or with this process if it is killed.

    Each watches a pipe whose other end, `ours`, is closed in both cases. At the block's end that
    comes first, so that the pool does not wait for jobs that still run.
    """
    context = multiprocessing.get_context(_START)
    theirs, ours = context.Pipe(duplex=False)
    with ProcessPoolExecutor(workers, context, _end_with, (theirs,)) as executor, ours:
        with _spared():
            for _ in range(workers):
                # Calls that do nothing: a process is begun for each, since none is idle yet.
                executor.submit(int)
        yield executor


def _end_with(pipe: Connection) -> None:
    """End this worker, whatever it does, as soon as the other end of a pipe is closed."""

    def watch() -> None:
        pipe.poll(None)  # waits without limit: nothing is ever sent
        os._exit(1)  # at once, in the middle of a job

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _spared() -> Iterator[None]:
    """Let processes that are started in a block ignore Ctrl-C, and not run the main script again.

    At Ctrl-C each would print a traceback. A main script without a `__main__` guard would start
    processes from within them: Python runs again what `sys.modules` holds as `__main__`.
    """
    script = sys.modules["__main__"]
    # Python lets only the main thread set a handler.
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler, as an executor. Raises MissingError where there are none."""
    from distributed import Client  # an extra

    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
        client.wait_for_workers(1, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError):
        advice = "start 'dask scheduler', and 'dask worker ADDRESS --nthreads 1'"
        raise MissingError(f"no Dask scheduler at {address!r} with a worker: {advice}") from None
    # Not pure: Dask would answer an equal call with the result of the earlier one.
    with client, client.get_executor(pure=False) as executor:
        yield executor
