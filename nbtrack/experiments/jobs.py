"""Jobs: pieces of work that are named by all that they depend on and made once, and their running.

They run one after the other here, or side by side in processes or on a Dask cluster: small networks
gain nothing from a second thread, so scenes and methods share the cores instead.
"""

import importlib.util
import json
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle

from nbtrack.experiments.runs import check_no_recording
from nbtrack.experiments.workers import DEATHS, Workplace, cluster, processes
from nbtrack.fields import FIELDS
from nbtrack.machinery import device
from nbtrack.machinery.errors import MissingError, NbtrackError
from nbtrack.machinery.files import data_folder, locked, runs_folder, write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.images import images_of
from nbtrack.tracking import TRACKERS

_LOOK_SECONDS = 1.0  # between two looks at jobs elsewhere, and between two of their reports
_DIED = "a worker process died at {}, perhaps for lack of memory: run again with fewer --workers"
_NAME_BYTES = 180  # of a folder's name; the key, suffixes and those of temporary files follow
Pairs = Iterator[tuple[Path, Any]]  # of a job's folder and what became of it
Report = Callable[[float, str], None]
"""Called by a job with the share of it that is done and a word on how it goes."""


class Job:
    """One piece of work, which can be pickled. Its result is kept in a folder of its own.

    `needs` is the job whose result it is made from, if any.
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

    @property
    def lock(self) -> Path:
        """A file that keeps other processes out; how far the job is stands in one beside it."""
        return runs_folder() / "locks" / f"{self.folder.name}.lock"

    def make(self, report: Report) -> Any:
        """The job's `result`, which is computed where it is missing.

        If another process is computing it, this one waits for the lock, which the system frees when
        that process ends.
        """
        report(0.0, "begins, or waits for another process that makes the same")
        check_no_recording(self.lock)
        setting = f"the frames and settings of {self.name}"
        with locked(self.lock), device.usual_modes(), device.advise_on_memory(setting):
            report(0.0, "running")
            return self.result() if self.is_done else self.compute(report)


@dataclass(frozen=True)
class Execution:
    """How jobs are run."""

    # Processes, which share the threads; by default one a core, or this one alone where a GPU does
    # the work: jobs share its memory, and side by side gain less (benchmarks/README.md).
    workers: int | None = None
    dask: str | None = None  # address of a Dask scheduler whose workers run the jobs instead
    # An NbtrackError of one job stands among the results, also in place of the results of jobs that
    # need it. The others still run.
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
    waves = _waves(jobs)
    missing = {folder: job for wave in waves for folder, job in wave.items()}
    outcomes: dict[Path, Any] = {}
    bar = ProgressBar(Job.doing, sum(job.work for job in missing.values()))

    def show(running: Mapping[Path, tuple[float, str]]) -> None:
        """Move the bar to what ended, and the shares of jobs that run; the first has its status."""
        ended = sum(missing[folder].work for folder in outcomes)
        worked = ended + sum(missing[folder].work * share for folder, (share, _) in running.items())
        # Compilation makes the first frame slow, which says nothing of the time that is left.
        if worked > ended and not bar.warm_up_work:
            bar.end_warm_up(worked)
        folder, (_, status) = next(iter(running.items()))
        bar.set_description_str(missing[folder].doing, refresh=False)
        status = f"{missing[folder].name}: {status}"
        bar.move_to(worked, f"{len(outcomes)} of {len(missing)} done, {status}")

    def settle(folder: Path, outcome: Any) -> None:
        if isinstance(outcome, NbtrackError) and not execution.keep_going:
            raise outcome
        outcomes[folder] = outcome

    # Whatever ends the block, the workers end with it at once.
    with bar, _workplace(execution, max(map(len, waves), default=0)) as workplace:
        for wave in waves:
            for folder, outcome in _outcomes(wave, outcomes, show, workplace):
                settle(folder, outcome)
                show({folder: (0.0, "done")})
    for job in jobs:
        if job.folder not in outcomes:
            settle(job.folder, _caught(job.result))
    return [outcomes[job.folder] for job in jobs]


def _waves(jobs: Sequence[Job]) -> list[dict[Path, Job]]:
    """Missing jobs by folder, in waves that run one after the other: each needs only earlier ones.

    Of tracked runs in corrected maps these are plain maps, corrected maps and runs.
    """
    waves = []
    wave = {job.folder: job for job in jobs if not job.is_done}
    while wave:
        waves.insert(0, wave)
        needed = [job.needs for job in wave.values()]
        wave = {job.folder: job for job in needed if job and not job.is_done}
    return waves


def _workplace(execution: Execution, n_jobs: int) -> AbstractContextManager[Workplace | None]:
    """Where the jobs run side by side; None where they run in this process, one after the other."""
    usual = device.usable_cores() if device.choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, n_jobs)
    if execution.dask is None and workers <= 1:
        return nullcontext()
    images_of.cache_clear()  # what was read here takes memory that workers need
    return cluster(execution.dask, n_jobs) if execution.dask else processes(workers)


def _caught(work: Callable, *arguments: Any) -> Any:
    """What a call returns, or the NbtrackError that ended it."""
    try:
        return work(*arguments)
    except NbtrackError as error:
        return error


def _outcomes(wave: Mapping, before: Mapping, show: Callable, place: Workplace | None) -> Pairs:
    """Pairs of folder and outcome, as the jobs of a wave end.

    `before` are the outcomes of earlier waves. A job that is in two waves has its outcome there.
    `show` is that of `run_jobs`.
    """
    ready = {folder: job for folder, job in wave.items() if folder not in before}
    for folder, job in wave.items():
        needed = before.get(job.needs.folder) if job.needs else None
        if isinstance(needed, NbtrackError) and ready.pop(folder, None):
            yield folder, NbtrackError(f"not run, because {job.needs.name} failed: {needed}")
    if place:
        yield from _elsewhere(ready, show, place)
        return
    for folder, job in ready.items():
        # A default argument, since the loop changes `folder`.
        def report(share: float, status: str, folder: Path = folder) -> None:
            show({folder: (share, status)})

        yield folder, _caught(job.make, report)


def _elsewhere(jobs: Mapping[Path, Job], show: Callable, place: Workplace) -> Pairs:
    """Pairs of folder and outcome of jobs that run side by side, as they end.

    Where a process dies, that is the outcome of the job that ran there.
    """
    waiting = [*jobs]
    running: dict[Future, tuple[Path, Executor]] = {}
    while waiting or running:
        while waiting and len(running) < place.n_calls:
            executor = place.idle.pop() if place.idle else place.begin()
            folder = waiting.pop(0)
            running[_submit(jobs[folder], executor, place.n_threads)] = folder, executor
        show({folder: _progress_of(jobs[folder]) for folder, _ in running.values()})
        for future in wait(running, _LOOK_SECONDS, FIRST_COMPLETED).done:
            folder, executor = running.pop(future)
            if type(future.exception()).__name__ in DEATHS:
                yield folder, NbtrackError(_DIED.format(jobs[folder].name))
            else:
                place.idle.append(executor)
                yield folder, future.result()


def _submit(job: Job, executor: Executor, n_threads: int) -> Future:
    """Begin a job elsewhere; the future gives its outcome.

    Folders, device, search path, fields and trackers there are those of this process. Classes of a
    notebook or script travel whole, those of files by the name of their module.
    """
    settings = {name: text for name, text in os.environ.items() if name.startswith("NBTRACK_")}
    settings |= {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    _progress_file(job).unlink(missing_ok=True)  # of an attempt that was killed
    work = cloudpickle.dumps((FIELDS, TRACKERS, job))
    return executor.submit(_outcome_there, settings, sys.path, n_threads, work)


def _outcome_there(settings: Mapping, search_path: list[str], n_threads: int, work: bytes) -> Any:
    """What becomes of a job: runs in a worker, which may have been started elsewhere."""
    os.environ |= settings
    # Before the work is unpickled, which imports the modules of its classes.
    sys.path += [folder for folder in search_path if folder not in sys.path]
    fields, trackers, job = pickle.loads(work)
    FIELDS.update(fields)
    TRACKERS.update(trackers)
    last = -_LOOK_SECONDS

    def report(share: float, status: str) -> None:
        nonlocal last
        if share == 0 or time.monotonic() - last >= _LOOK_SECONDS:
            write_atomic(_progress_file(job), json.dumps([share, status]))
            last = time.monotonic()

    with device.threads(n_threads):
        return _caught(job.make, report)


def _progress_file(job: Job) -> Path:
    """Where a job that runs elsewhere tells how far it is: its share and a word on how it goes."""
    return job.lock.with_suffix(".progress")


def _progress_of(job: Job) -> tuple[float, str]:
    """How far a job that runs elsewhere is, and how it goes, as it said last."""
    try:
        share, status = json.loads(_progress_file(job).read_text("utf-8"))
    except (OSError, ValueError):  # it has said nothing yet
        return 0.0, "running"
    return share, status
