"""Jobs on a Dask cluster, by joblib: for grids that one machine is too small for.

The cluster's machines must see the project, the data and the results folder under the same paths,
as on a shared file system. Workers with one task at a time are meant: `dask worker ADDRESS
--nthreads 1 --nworkers 4`.
"""

import os
from collections.abc import Sequence
from typing import Any

import torch

from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.paths import data_folder, runs_folder
from nbtrack.experiments.parallel import Board, Job, quiet

_SECONDS_TO_CONNECT = 10


def run_on_cluster(jobs: Sequence[Job], address: str, threads: int, board: Board) -> None:
    """Run jobs on the workers of a Dask scheduler and note their results on the board.

    Jobs go in waves: first those that need nothing, then those that need these, and so on. The
    bar moves when a job ends.

    Args:
        address: of the scheduler, as "tcp://127.0.0.1:8786".
        threads: that each job computes with.

    Raises:
        MissingError: Dask is not installed, nothing answers at the address, or there is no worker.
    """
    joblib, client, KilledWorker = _connect(address)
    environment = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    environment |= {k: v for k, v in os.environ.items() if k == "NBTRACK_DEVICE"}
    with client, joblib.parallel_config(backend="dask", wait_for_workers_timeout=60):
        waiting = list(jobs)
        while waiting:
            wave = [job for job in waiting if board.is_ready(job)]
            waiting = [job for job in waiting if job not in wave]
            wave = [job for job in wave if not board.settle_if_hopeless(job)]
            # One job a task: they are long, and a batch would keep finished ones back.
            run = joblib.Parallel(return_as="generator_unordered", batch_size=1)
            tasks = [joblib.delayed(_run_there)(job, environment, threads) for job in wave]
            try:
                for name, result in run(tasks):
                    board.settle(board.jobs[name], lambda result=result: _unwrapped(result))
            except KilledWorker:
                raise NbtrackError(
                    "a Dask worker died, perhaps for lack of memory: what was finished is kept; "
                    "run the same command again, with fewer workers a machine if need be"
                ) from None


def _connect(address: str) -> tuple[Any, Any, type[Exception]]:
    try:
        import joblib
        from distributed import Client, KilledWorker
    except ImportError:
        raise MissingError(
            "--dask needs joblib and Dask: pip install 'nbtrack[cluster]', or run without --dask"
        ) from None
    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError) as error:
        raise MissingError(
            f"no Dask scheduler at {address!r} ({type(error).__name__}): start one with 'dask "
            "scheduler', and workers with 'dask worker ADDRESS --nthreads 1'"
        ) from None
    if not client.scheduler_info()["workers"]:
        client.close()
        raise MissingError(
            f"the Dask scheduler at {address} has no worker: start some with 'dask worker "
            f"{address} --nthreads 1'"
        )
    return joblib, client, KilledWorker


def _run_there(job: Job, environment: dict[str, str], threads: int) -> tuple[str, Any]:
    """Runs in a worker, which may have been started with other folders, or for another device."""
    os.environ |= environment
    torch.set_num_threads(threads)
    try:
        return job.name, job.function(*job.arguments, report=quiet)
    except NbtrackError as error:
        return job.name, error


def _unwrapped(result: Any) -> Any:
    if isinstance(result, NbtrackError):
        raise result
    return result
