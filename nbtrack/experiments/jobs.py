"""Jobs, pieces of work that are done once and kept in the cache, and how they are run.

A job's name in the cache holds a digest of all that its result depends on. Jobs run one after the
other in this process, or side by side in other processes or on a Dask cluster. Small networks gain
nothing from a second thread, so it is the jobs that share the cores of a machine.
"""

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
from nbtrack.machinery.errors import ConfigError, NbtrackError
from nbtrack.machinery.files import data_folder, locked, runs_folder, write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.registry import from_extra
from nbtrack.recordings.images import images_of
from nbtrack.tracking import TRACKERS

_LOOK_SECONDS = 1.0  # between two looks at the progress of other processes, and two of its reports
_DIED = "a worker process died at {}, perhaps for lack of memory: run again with fewer --workers"
# At most, of a folder's name: file systems allow 255, and the key and suffixes follow the name.
_NAME_BYTES = 180
# A job's folder, which identifies the job, and its outcome: its result, or the NbtrackError that
# ended it.
Pairs = Iterator[tuple[Path, Any]]
Report = Callable[[float, str], None]
"""A job calls it with the share of its work that is done, and with a word on how it goes."""


class Job:
    """One piece of work, whose result is kept in a folder of its own.

    A job can be pickled, so that another process can run it.
    """

    kind: str  # the folder of the cache for jobs of this kind
    name: str  # for people
    key: str  # a digest that changes with everything that the result depends on
    doing: str = "computing"  # the title of the progress bar
    work: float = 1.0  # how long the job takes, relative to a tracked run: its weight in the bar
    is_timed: bool = False  # whether work at the same time would change its result
    needs: "Job | None"  # the job whose result this one is made from
    is_done: bool
    result: Callable[[], Any]  # reads the result of a finished job
    compute: Callable[[Report], Any]  # does the work or resumes a killed one; returns the result

    @property
    def folder(self) -> Path:
        """The folder in the cache with the job's files."""
        # A job's name begins with that of a recording's folder, which may have 255 bytes by itself.
        name = self.name.encode(errors="replace")[:_NAME_BYTES].decode(errors="ignore")
        return runs_folder() / self.kind / f"{name}-{self.key}"

    @property
    def lock(self) -> Path:
        """The lock file that keeps other processes from doing the same job."""
        return runs_folder() / "locks" / f"{self.folder.name}.lock"

    def make(self, report: Report) -> Any:
        """Return the job's result, and compute it if it is missing.

        If another process is computing it, wait for the lock. The system frees the lock when that
        process ends.
        """
        report(0.0, "begins, or waits for another process that makes the same")
        check_no_recording(self.lock)  # NBTRACK_RUNS may lie in a recording
        to_lower = f"the frames and settings of {self.name}"
        with locked(self.lock), device.usual_modes(), device.advise_on_memory(to_lower):
            report(0.0, "running")
            return self.result() if self.is_done else self.compute(report)


@dataclass(frozen=True)
class Execution:
    """How jobs are run."""

    # The number of processes. By default one for each core; or this process alone if a GPU does the
    # work, since jobs would share its memory.
    workers: int | None = None
    dask: str | None = None  # address of a Dask scheduler, whose workers run the jobs instead
    # Whether the other jobs still run when one raises an NbtrackError. The error is then returned
    # in place of the result, also for jobs that need the failed one.
    keep_going: bool = False

    def __post_init__(self) -> None:
        """Raises MissingError, before any work, if Dask is needed and not there."""
        if self.dask is not None:
            from_extra("distributed", "cluster")


def run_jobs(jobs: Sequence[Job], execution: Execution | None = None) -> list[Any]:
    """The results of all jobs, in order. Missing ones, and the jobs that they need, are run.

    Raises the NbtrackError of the first job that fails; with `keep_going` it is a result instead.
    """
    execution = execution or Execution()
    waves = _waves(jobs)
    missing = {folder: job for wave in waves for folder, job in wave.items()}
    outcomes: dict[Path, Any] = {}
    bar = ProgressBar(Job.doing, sum(job.work for job in missing.values()))

    def show(running: Mapping[Path, tuple[float, str]]) -> None:
        """Move the bar; `running` has by folder the share of work done and the status of a job."""
        ended = sum(missing[folder].work for folder in outcomes)
        worked = ended + sum(missing[folder].work * share for folder, (share, _) in running.items())
        first, *_ = running  # the job whose status is shown
        bar.set_description_str(missing[first].doing, refresh=False)
        status = f"{missing[first].name}: {running[first][1]}"
        bar.move_to(worked, f"{len(outcomes)} of {len(missing)} done, {status}")

    def settle(folder: Path, outcome: Any) -> None:
        """Keep the outcome of a job, or raise it if it is an error that ends all."""
        if isinstance(outcome, NbtrackError) and not execution.keep_going:
            raise outcome
        outcomes[folder] = outcome

    # When the block ends, also by an error, the workers end at once.
    with bar, _workplace(execution, max(map(len, waves), default=0)) as workplace:
        for wave in waves:
            place = None if any(job.is_timed for job in wave.values()) else workplace
            for folder, outcome in _outcomes(wave, outcomes, show, place):
                settle(folder, outcome)
                show({folder: (0.0, "done")})  # 0, since `show` counts the work of outcomes
    for job in jobs:
        if job.folder not in outcomes:  # it was done before: its result is only read
            settle(job.folder, _caught(job.result))
    return [outcomes[job.folder] for job in jobs]


def _waves(jobs: Sequence[Job]) -> list[dict[Path, Job]]:
    """The jobs that are not done, with those that they need, in groups that run one after another.

    A group maps folders to jobs, which need only finished jobs and jobs of earlier groups. For
    tracked runs in corrected maps the groups are plain maps, corrected maps, and runs. Raises
    ConfigError if no job is given.
    """
    if not jobs:
        raise ConfigError("nothing to do: give at least one scene, field or method, rate and seed")
    waves = []
    while missing := {job.folder: job for job in jobs if not job.is_done}:
        waves.insert(0, missing)
        jobs = [job.needs for job in missing.values() if job.needs]
    return waves


def _workplace(execution: Execution, n_jobs: int) -> AbstractContextManager[Workplace | None]:
    """The workplace where at most `n_jobs` jobs run side by side.

    It is None if jobs run in this process, one after the other.
    """
    usual = device.usable_cores() if device.choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, n_jobs)
    if workers <= 1 and execution.dask is None:
        return nullcontext()
    images_of.cache_clear()  # images that this process has read take memory that workers need
    return processes(workers) if execution.dask is None else cluster(execution.dask, n_jobs)


def _caught(work: Callable, *arguments: Any) -> Any:
    """What a call of `work` returns, or the NbtrackError that it raises."""
    try:
        return work(*arguments)
    except NbtrackError as error:
        return error


def _outcomes(wave: Mapping, before: Mapping, show: Callable, place: Workplace | None) -> Pairs:
    """Run the jobs of a wave; yields the folder and the outcome of each job when it ends.

    `before` holds the outcomes of earlier waves, by folder. `show` reports progress, as in
    `run_jobs`. Jobs run in this process if `place` is None.
    """
    # A job may be in two waves; it has run in the first one then.
    ready = {folder: job for folder, job in wave.items() if folder not in before}
    for folder, job in [*ready.items()]:
        needed = before.get(job.needs.folder) if job.needs else None
        if isinstance(needed, NbtrackError):
            del ready[folder]
            yield folder, NbtrackError(f"not run, because {job.needs.name} failed: {needed}")
    if place:
        yield from _elsewhere(ready, show, place)
        return
    for folder, job in ready.items():
        # A default argument keeps this folder: the loop changes the variable.
        def report(share: float, status: str, folder: Path = folder) -> None:
            show({folder: (share, status)})

        yield folder, _caught(job.make, report)


def _elsewhere(jobs: Mapping[Path, Job], show: Callable, place: Workplace) -> Pairs:
    """Run jobs side by side; yields the folder and the outcome of each job when it ends.

    If a process dies, the outcome of the job that ran in it is an NbtrackError.
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
    """Begin a job in the process of an executor; the future gives its outcome.

    The process gets the folders, device, search path, fields and trackers of this one. A class from
    a notebook or script is pickled with its code, a class from a file by the name of its module.
    """
    settings = {name: text for name, text in os.environ.items() if name.startswith("NBTRACK_")}
    settings |= {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    _progress_file(job).unlink(missing_ok=True)  # an attempt that was killed has left it
    work = cloudpickle.dumps((FIELDS, TRACKERS, job))
    return executor.submit(_outcome_there, settings, sys.path, n_threads, work)


def _outcome_there(settings: Mapping, search_path: list[str], n_threads: int, work: bytes) -> Any:
    """Run a job in a worker process, which may be on another machine; returns its outcome.

    The arguments are those that `_submit` sends.
    """
    os.environ |= settings
    # The path comes before the unpickling, which imports the modules of the job's classes.
    sys.path += [folder for folder in search_path if folder not in sys.path]
    fields, trackers, job = pickle.loads(work)
    FIELDS.update(fields)
    TRACKERS.update(trackers)
    last_written = -_LOOK_SECONDS

    def report(share: float, status: str) -> None:
        nonlocal last_written
        # At share 0 the job begins, or waits for another process: this is always told.
        if share == 0 or time.monotonic() - last_written >= _LOOK_SECONDS:
            write_atomic(_progress_file(job), json.dumps([share, status]))
            last_written = time.monotonic()

    with device.threads(n_threads):
        return _caught(job.make, report)


def _progress_file(job: Job) -> Path:
    """The file by which a job in another process reports its share of work done and its status."""
    return job.lock.with_suffix(".progress")


def _progress_of(job: Job) -> tuple[float, str]:
    """The share of work done and the status that a job in another process reported last."""
    try:
        share, status = json.loads(_progress_file(job).read_text("utf-8"))
    except (OSError, ValueError):  # it has reported nothing yet
        return 0.0, "running"
    return share, status
