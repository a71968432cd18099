"""The grid of maps and tracked runs, as DataFrames: what is not cached is computed.

Jobs run one after the other in this process, or side by side on an executor: processes here, or a
Dask cluster. Small networks gain nothing from a second thread, so scenes and methods share the
cores instead.
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
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import pandas as pd
import torch

from nbtrack.core.device import choose_device, threads, usable_cores
from nbtrack.core.errors import MissingError, NbtrackError, check_lists
from nbtrack.core.files import data_folder, runs_folder
from nbtrack.core.progress import ProgressBar, tell
from nbtrack.experiments.jobs import Job
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.runs import read_trajectory
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob, reach_warnings
from nbtrack.fields import FIELDS
from nbtrack.mapping.files import Map
from nbtrack.tracking import TRACKERS
from nbtrack.tracking.methods import Methods, find_methods
from nbtrack.tracking.trajectories import Trajectory

_START = "spawn"  # how worker processes begin: forked ones would lack the threads of libraries
_LOOK_SECONDS = 1.0  # between two looks at jobs elsewhere, so that the bar's clock moves
_SECONDS_TO_CONNECT = 10


@dataclass(frozen=True)
class Execution:
    """How jobs are run."""

    # Processes; by default one a core, or this process alone where a GPU does the work: there jobs
    # share its memory, and side by side gain less (benchmarks/README.md). They share the threads.
    workers: int | None = None
    dask: str | None = None  # address of a Dask scheduler whose workers run the jobs instead
    # A user's mistake in one job stands in its place among the results, as the exception, and so
    # does one for every job that needs it; the others still run.
    keep_going: bool = False

    def __post_init__(self) -> None:
        """Raises MissingError, before any work, if Dask is needed and not there."""
        if self.dask is not None and not importlib.util.find_spec("distributed"):
            raise MissingError("--dask needs Dask: pip install 'nbtrack[cluster]', or --workers")


def map_scene(scene: Scene, field: str, preset: Preset, seed: int = 0) -> Map:
    """The map of a scene, from the cache or made now."""
    job = MapJob.of(scene, field, preset, seed=seed)
    run_jobs([job])
    return job.map()


def map_scenes(scenes: Sequence[Scene], fields: Sequence[str], preset: Preset) -> pd.DataFrame:
    """Scores of the maps of some scenes; those that are not cached are made, side by side.

    A row is a map: field, scene, seed, seconds, and the scores, `SCORES`. Raises ConfigError where
    scenes or fields are no lists.
    """
    check_lists(scenes=scenes, fields=fields)
    jobs = [MapJob.of(scene, field, preset) for field, scene in product(fields, scenes)]
    return pd.DataFrame(
        {"field": job.field, "scene": job.scene.name, "seed": job.seed}
        | {"seconds": record["seconds"], **record["quality"]}
        for job, record in zip(jobs, run_jobs(jobs), strict=True)
    )


def track_scenes(
    scenes: Sequence[Scene],
    methods: Methods,
    preset: Preset,
    rates_hz: Sequence[float | int] | None = None,
    steps: float | int | None = None,
    clock: bool = False,
    frames: str | None = None,
    seeds: Sequence[int] = (0,),
    execution: Execution | None = None,
    tracked: Sequence[Scene] | None = None,
) -> pd.DataFrame:
    """Track some scenes with some methods; maps and runs that are not cached are made first.

    Args:
        rates_hz: by default the preset's; each frame has the steps of the paper's hardware.
        steps, clock: so many steps a frame instead, or 1/rate seconds by this machine's clock.
        frames: the slice to track; by default the preset's.
        seeds: of map and run together: their spread is that of the method.
        tracked: other recordings of the same rooms, in the same order, which no map has seen.

    Returns a row a run: rate_hz, steps, method, n_pixels, scene, seed, run (its name), the metrics,
    ate_m (NaN where not known), failure (why). Raises ConfigError for no list; what a job raised.
    """
    execution = execution or Execution()
    check_lists(scenes=scenes, rates_hz=rates_hz or (), seeds=seeds)
    rates = [None] if steps else rates_hz or preset.tables.rates_hz
    frames = str(frames or preset.scenes.track_frames)
    pairs = list(zip(scenes, tracked or scenes, strict=True))
    jobs, rows = [], []
    for method, seed, rate_hz, (scene, seen) in product(find_methods(methods), seeds, rates, pairs):
        own = preset.with_method(method.settings)
        what = seen, method.tracker, own.tracking_of(method.tracker)
        n_steps = steps or (None if clock else method.paper_steps(rate_hz))
        made = MapJob.of(scene, method.field, own, seed=seed)
        jobs.append(TrackJob(made, *what, n_steps, rate_hz if clock else None, frames, seed))
        rows.append({"rate_hz": rate_hz, "steps": n_steps, "method": method.label})
    return pd.DataFrame(map(_row_of, rows, jobs, _run(jobs, clock, execution)))


def _run(jobs: Sequence[TrackJob], clock: bool, execution: Execution) -> list[Any]:
    """Side by side; by the clock one after the other, here: a neighbour would slow a clock down."""
    missing = [job for job in jobs if not job.is_done]
    if 0 < len(missing) < len(jobs):
        tell(f"{len(jobs) - len(missing)} of {len(jobs)} runs are cached")
    for warning in reach_warnings(missing):
        tell(f"nbtrack: warning: {warning}")
    if clock:
        run_jobs([job.needs for job in missing], execution)
        execution = replace(execution, workers=1, dask=None)
    return run_jobs(jobs, execution)


def _row_of(
    row: dict[str, Any], job: TrackJob, result: dict[str, Any] | NbtrackError
) -> dict[str, Any]:
    """A whole row. Its scene is the mapped one; metrics name the one that was tracked."""
    row |= {"scene": job.needs.scene.name, "seed": job.seed, "run": job.folder.name}
    row["n_pixels"] = job.settings.n_pixels
    if isinstance(result, NbtrackError):
        return {**row, "failure": str(result), "ate_m": float("nan")}
    metrics = {k: v for k, v in result.items() if k not in ("config", "map_record", "versions")}
    return {**metrics, **row, "failure": "", "ate_m": result.get("ate_rmse_m", float("nan"))}


def read_run(name: str | Path) -> Trajectory:
    """A run by its name in the column `run`, or by its folder; MissingError if there is none."""
    return read_trajectory(Path(name) if Path(name).is_dir() else runs_folder() / "tracks" / name)


def run_jobs(jobs: Sequence[Job], execution: Execution | None = None) -> list[Any]:
    """The results of all jobs, in order; those that are missing, and what they need, are made.

    Unless it is to keep going, it raises what the first failing job raised, and drops the others.
    """
    execution = execution or Execution()
    missing = {part.folder: part for job in jobs for part in _missing(job)}
    results: dict[Path, Any] = {}

    def show(job: Job, share: float = 0.0, status: str = "running") -> None:
        """Where the work is: `share` of a job that runs in this process, and all that ended."""
        bar.set_description_str(job.doing, refresh=False)
        worked = sum(missing[folder].work for folder in results) + share * job.work
        if 0 < share < 1 and not bar.warm_up[0]:  # a first frame waits for what is compiled
            bar.warm_up = worked, bar.format_dict["elapsed"]
        bar.move_to(worked, f"{len(results)} of {len(missing)} done, {job.name}: {status}")

    with (
        ProgressBar(Job.doing, sum(job.work for job in missing.values())) as bar,
        contextlib.closing(_outcomes(missing, results, show, execution)) as outcomes,
    ):
        for folder, outcome in outcomes:
            if isinstance(outcome, NbtrackError) and not execution.keep_going:
                raise outcome
            results[folder] = outcome
            show(missing[folder], status="done")
    return [results[job.folder] if job.folder in results else job.result() for job in jobs]


def _missing(job: Job | None) -> list[Job]:
    """What is not done of a job and what it needs, in the order in which it can be done."""
    return [] if job is None or job.is_done else [*_missing(job.needs), job]


def _outcomes(
    jobs: Mapping[Path, Job], results: Mapping[Path, Any], show: Callable, execution: Execution
) -> Iterator[tuple[Path, Any]]:
    """What becomes of each job, as they end; each begins when what it needs is in the results."""
    usual = usable_cores() if choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, len(jobs))
    needs = {folder: job.needs.folder if job.needs else None for folder, job in jobs.items()}
    if workers <= 1 and execution.dask is None:
        for folder, job in jobs.items():
            yield folder, job.outcome(results.get(needs[folder]), partial(show, job))
        return
    waiting = list(jobs)
    running: dict[Future, Path] = {}
    with _submitting(execution.dask, workers) as submit:
        while waiting or running:
            for folder in [f for f in waiting if needs[f] in results or needs[f] not in jobs]:
                if execution.dask or len(running) < workers:
                    running[submit(jobs[folder], results.get(needs[folder]))] = folder
                    waiting.remove(folder)
            show(jobs[next(iter(running.values()))])
            ended, _ = wait(running, _LOOK_SECONDS, FIRST_COMPLETED)
            names = " or ".join(folder.name for folder in running.values())
            for future in ended:
                yield running.pop(future), _result_of(future, names)


def _result_of(future: Future, names: str) -> Any:
    """What a job gave. Raises NbtrackError where its process died, the system's usual way to get
    memory back, when jobs of some names were running."""
    error = future.exception()
    if type(error).__name__ not in ("BrokenProcessPool", "KilledWorker"):  # the latter is Dask's
        return future.result()
    died = f"a worker process died at {names}, perhaps for lack of memory"
    advice = "run it again, with fewer --workers or smaller settings; what was finished is kept"
    raise NbtrackError(f"{died}: {advice}")


@contextlib.contextmanager
def _submitting(address: str | None, workers: int) -> Iterator[Callable[[Job, Any], Future]]:
    """A function that begins a job, given what became of the one that it needs, elsewhere.

    Its processes know the folders, the device, the search path and all fields and trackers of this
    one. Classes of a notebook or script travel whole, those of files by the name of their module.
    """
    settings = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    settings |= {k: v for k, v in os.environ.items() if k == "NBTRACK_DEVICE"}
    n_threads = 1 if address else max(1, torch.get_num_threads() // workers)
    with _cluster(address) if address else _pool(workers) as executor:

        def submit(job: Job, needed: Any) -> Future:
            work = cloudpickle.dumps((FIELDS, TRACKERS, job, needed))
            return executor.submit(_outcome_there, settings, sys.path, n_threads, work)

        yield submit


def _outcome_there(
    settings: Mapping[str, str], search_path: Sequence[str], n_threads: int, work: bytes
) -> Any:
    """Runs in a worker, which may have been started elsewhere, or with other classes."""
    os.environ |= settings
    sys.path += [folder for folder in search_path if folder not in sys.path]
    fields, trackers, job, needed = pickle.loads(work)
    FIELDS.update(fields)
    TRACKERS.update(trackers)
    with threads(n_threads):
        return job.outcome(needed, lambda share, status: None)


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """Processes of this machine, which end with the block, or with this process if it is killed."""
    context = multiprocessing.get_context(_START)
    theirs, ours = context.Pipe(duplex=False)
    with ProcessPoolExecutor(workers, context, _end_with, (theirs,)) as executor, ours:
        with _spared():
            for _ in range(workers):
                executor.submit(int)  # a process is begun for each, since none is idle yet
        yield executor


def _end_with(pipe: Connection) -> None:
    """End this worker, whatever it does, as soon as the other end of a pipe is closed."""

    def watch() -> None:
        pipe.poll(None)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _spared() -> Iterator[None]:
    """Spare the processes that are started in a block what is this one's business.

    That is Ctrl-C, of which each would tell in a traceback; and the main script, which Python runs
    in them once more: without a `__main__` guard it would start processes from within them.
    """
    script = sys.modules["__main__"]
    is_main = threading.current_thread() is threading.main_thread()  # others have no handlers
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
    """The workers of a Dask scheduler. Raises MissingError where there are none."""
    from distributed import Client

    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
        client.wait_for_workers(1, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError):
        advice = "start 'dask scheduler', and 'dask worker ADDRESS --nthreads 1'"
        raise MissingError(f"no Dask scheduler at {address!r} with a worker: {advice}") from None
    with client, client.get_executor(pure=False) as executor:
        yield executor
