"""The grid of maps and tracked runs, as DataFrames: what is not cached is computed.

Jobs run side by side on Dask's workers, or one after the other in this process. Small networks gain
nothing from a second thread, so scenes and methods share the cores instead.
"""

import contextlib
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from nbtrack.core.device import choose_device, threads, usable_cores
from nbtrack.core.errors import MissingError, NbtrackError, check_lists
from nbtrack.core.files import data_folder, runs_folder
from nbtrack.core.progress import ProgressBar, tell
from nbtrack.experiments import IMPORTED, import_own
from nbtrack.experiments.jobs import Job
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.outlook import reach_warnings
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.runs import read_trajectory
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.fields import FIELDS
from nbtrack.interrupts import interrupts_put_off
from nbtrack.mapping.files import Map
from nbtrack.tracking import TRACKERS
from nbtrack.tracking.methods import Methods, find_methods
from nbtrack.tracking.trajectories import Trajectory

_REPORT_SECONDS = 0.3  # between two reports of a worker
_SECONDS_TO_CONNECT = 10
_LOCAL = {
    # A job that kills its worker is tried once more; memory is the user's to divide.
    "distributed.scheduler.allowed-failures": 1,
    # Without Dask's own malloc threshold, which gives every tensor's memory back to the system:
    # mapping then spent almost half of its time on getting it again.
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1},
}


@dataclass(frozen=True)
class Execution:
    """How jobs are run; of all this only the threads may change last digits of a result."""

    # Processes; by default one a core, or this process alone where a GPU does the work: there jobs
    # share its memory, and side by side gain less (benchmarks/README.md).
    workers: int | None = None
    threads: int | None = None  # of each job; by default this process's, divided by the workers
    dask: str | None = None  # address of a Dask scheduler whose workers run the jobs instead
    # A user's mistake in one job stands in its place among the results, as the exception, and so
    # does one for every job that needs it; the others still run.
    keep_going: bool = False

    def __post_init__(self) -> None:
        """Raises MissingError, before any work, if Dask is needed and not there."""
        if (self.dask is not None or (self.workers or 1) > 1) and not _has_dask():
            raise MissingError("workers need Dask: pip install 'nbtrack[cluster]', or --workers 1")


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
    # By the clock, how far a run comes depends on its threads.
    n_threads = execution.threads or (torch.get_num_threads() if clock else None)
    how = {"frames": str(frames or preset.scenes.track_frames), "n_threads": n_threads}
    pairs = list(zip(scenes, tracked or scenes, strict=True))
    jobs, rows = [], []
    for method, seed, rate_hz, (scene, seen) in product(find_methods(methods), seeds, rates, pairs):
        own = preset.with_method(method.settings)
        what = seen, method.tracker, own.tracking_of(method.tracker)
        n_steps = steps or (None if clock else method.paper_steps(rate_hz))
        made = MapJob.of(scene, method.field, own, seed=seed)
        jobs.append(TrackJob(made, *what, n_steps, rate_hz if clock else None, seed=seed, **how))
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
    metrics = {k: v for k, v in result.items() if k not in ("config", "map_config", "versions")}
    return {**metrics, **row, "failure": "", "ate_m": result.get("ate_rmse_m", float("nan"))}


def read_run(name: str | Path) -> Trajectory:
    """A run by its name in the column `run`, or by its folder; MissingError if there is none."""
    return read_trajectory(Path(name) if Path(name).is_dir() else runs_folder() / "tracks" / name)


def run_jobs(jobs: Sequence[Job], execution: Execution | None = None) -> list[Any]:
    """The results of all jobs, in order; those that are missing, and what they need, are made.

    Unless it is to keep going, it raises what the first failing job raised, and drops the others.
    """
    execution = execution or Execution()
    results = {}
    missing = {part.folder: part for job in jobs for part in _missing(job)}
    done = dict.fromkeys(missing, 0.0)  # shares of each job's own work
    work = {folder: job.work for folder, job in missing.items()}

    def show(folder: Path, share: float, status: str) -> None:
        done[folder] = max(share, done[folder])  # news of a worker may come late
        ended = f"{len(results)} of {len(missing)} done"
        bar.set_description_str(missing[folder].doing, refresh=False)
        worked = sum(share * work[folder] for folder, share in done.items())
        bar.move_to(worked, f"{ended}, {missing[folder].name}: {status}")

    with (
        ProgressBar(Job.doing, sum(work.values())) as bar,
        contextlib.closing(_outcomes(missing, results, show, execution)) as outcomes,
    ):
        for folder, outcome in outcomes:
            if isinstance(outcome, NbtrackError) and not execution.keep_going:
                raise outcome
            results[folder] = outcome
            show(folder, 1.0, "done")
    return [results[job.folder] if job.folder in results else job.result() for job in jobs]


def _missing(job: Job | None) -> list[Job]:
    """What is not done of a job and what it needs, in the order in which it can be done."""
    return [] if job is None or job.is_done else [*_missing(job.needs), job]


def _outcomes(
    jobs: dict[Path, Job], results: dict[Path, Any], show: Callable, execution: Execution
) -> Iterator[tuple[Path, Any]]:
    """What becomes of each job, as they end; what a job needs comes before it."""
    usual = usable_cores() if _has_dask() and choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, len(jobs))
    if jobs and (execution.dask is not None or workers > 1):
        share = 1 if execution.dask else max(1, torch.get_num_threads() // workers)
        yield from _on_workers(jobs, show, execution.dask, workers, execution.threads or share)
        return
    with threads(execution.threads or torch.get_num_threads()):
        for folder, job in jobs.items():
            needed = results.get(job.needs.folder) if job.needs else None
            yield folder, job.outcome(needed, partial(show, folder))


def _has_dask() -> bool:
    return importlib.util.find_spec("distributed") is not None


def _on_workers(
    jobs: Mapping[Path, Job], show: Callable, address: str | None, workers: int, n_threads: int
) -> Iterator[tuple[Path, Any]]:
    """The same by Dask: each job begins as soon as what it needs is there.

    `show` is told where a running job is. Without the address of a Dask scheduler, `workers` local
    processes are started.
    """
    import dask
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    with dask.config.set(_LOCAL), _main_kept_back(), _cluster(address, workers) as client:
        topic = f"nbtrack-{os.getpid()}-{time.time_ns()}"
        client.subscribe_topic(topic, lambda event: show(Path(event[1][0]), *event[1][1:]))
        settings = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
        settings |= {k: v for k, v in os.environ.items() if k == "NBTRACK_DEVICE"}
        for source in IMPORTED:
            client.run(import_own, source)
        how = topic, settings, n_threads, (FIELDS, TRACKERS)
        futures: dict[Path, Any] = {}
        for folder, job in jobs.items():
            needed = futures.get(job.needs.folder) if job.needs else None
            futures[folder] = client.submit(_outcome_there, job, needed, *how, pure=False)
        folders = {future: folder for folder, future in futures.items()}
        for future in as_completed(folders):
            folder = folders[future]
            try:
                outcome = future.result()
            except KilledWorker:
                died = f"a worker process died at {folder.name}, perhaps for lack of memory"
                advice = "run it again, with fewer --workers or smaller settings"
                outcome = NbtrackError(f"{died}: {advice}")
            yield folder, outcome


def _outcome_there(
    job: Job, needed: Any, topic: str, settings: dict[str, str], n_threads: int, known: Any
) -> Any:
    """Runs in a worker, which may have been started with other folders, or for another device.

    Fields and trackers that were registered in the calling process may be missing in it.
    """
    from distributed import get_worker

    os.environ |= settings
    FIELDS.update(known[0])
    TRACKERS.update(known[1])
    worker = get_worker()
    last = time.monotonic()

    def report(share: float, status: str) -> None:
        nonlocal last
        if time.monotonic() - last > _REPORT_SECONDS:
            last = time.monotonic()
            worker.log_event(topic, [str(job.folder), share, status])

    with threads(n_threads):
        return job.outcome(needed, report)


@contextlib.contextmanager
def _main_kept_back() -> Iterator[None]:
    """Start processes that do not run the main script once more, as those of Python do.

    A script without a `__main__` guard would start processes from within them. They need nothing of
    it: what a script defines travels with the jobs.
    """
    main = sys.modules["__main__"]
    kept = {name: value for name, value in vars(main).items() if name in ("__file__", "__spec__")}
    main.__dict__.pop("__file__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(kept)


@contextlib.contextmanager
def _cluster(address: str | None, workers: int) -> Iterator[Any]:
    """A client of Dask's workers. Ctrl-C waits until they are all there, or all gone."""
    opened = contextlib.ExitStack()
    try:
        with interrupts_put_off():
            client = opened.enter_context(_client(address, workers))
        yield client
    finally:
        with interrupts_put_off():
            opened.close()


def _client(address: str | None, workers: int) -> Any:
    from distributed import Client

    if address is None:  # a cluster of processes here, which end with this one
        return Client(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0,
            silence_logs=50, local_directory=str(runs_folder() / "dask"),
            dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
        )  # fmt: skip
    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
        client.wait_for_workers(1, timeout=_SECONDS_TO_CONNECT)
        return client
    except (OSError, ValueError):
        advice = "start 'dask scheduler', and 'dask worker ADDRESS --nthreads 1'"
        raise MissingError(f"no Dask scheduler at {address!r} with a worker: {advice}") from None
