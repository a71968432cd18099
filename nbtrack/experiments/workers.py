"""Cells on Dask's workers: local processes, which end with this one, or those of a cluster."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, get_worker, wait
from distributed.scheduler import KilledWorker

from nbtrack.core.device import threads
from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.files import data_folder, runs_folder
from nbtrack.experiments.board import Board, Cell, outcome_of
from nbtrack.fields import FIELDS
from nbtrack.tracking import TRACKERS

_REPORT_SECONDS = 0.3  # between two reports of a worker
_SECONDS_TO_CONNECT = 10
_LOCAL = {
    # A cell that kills its worker is tried once more; memory is the user's to divide.
    "distributed.scheduler.allowed-failures": 1,
    # Without Dask's own malloc threshold, which gives every tensor's memory back to the system:
    # mapping then spent almost half of its time on getting it again.
    "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1},
}


def run_on_workers(board: Board, address: str | None, workers: int, n_threads: int) -> None:
    """Run all cells, each as soon as what it needs is there.

    Args:
        address: of a Dask scheduler; by default local processes are started, `workers` of them.
    """
    with _client(address, workers) as client:
        _run(client, board, n_threads)


def _run(client: Client, board: Board, n_threads: int) -> None:
    topic, news = f"nbtrack-{os.getpid()}-{time.time_ns()}", []
    client.subscribe_topic(topic, lambda event: news.append(event[1]))
    settings = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
    settings |= {k: v for k, v in os.environ.items() if k == "NBTRACK_DEVICE"}
    waiting: dict[Path, Any] = {}
    for priority, (folder, cell) in enumerate(board.cells.items()):
        needed = waiting.get(cell.needs.folder) if cell.needs else None
        waiting[folder] = client.submit(
            _make_there, cell, needed, topic, settings, n_threads, _registered(),
            key=f"{topic}-{folder.name}", pure=False, priority=-priority,
        )  # fmt: skip
    while waiting:
        with contextlib.suppress(TimeoutError):
            wait(list(waiting.values()), timeout=_REPORT_SECONDS, return_when="FIRST_COMPLETED")
        while news:
            folder, units, status = news.pop(0)
            if Path(folder) in waiting:
                board.show(Path(folder), units, status)
        for folder in [folder for folder, future in waiting.items() if future.done()]:
            board.settle(folder, _result(waiting.pop(folder), folder.name))


def _result(future: Any, name: str) -> Any:
    """What a worker returned, or that it died."""
    try:
        return future.result()
    except KilledWorker:
        return NbtrackError(
            f"a worker process died at {name}, perhaps for lack of memory: what was finished is "
            "kept; run the same command again, with fewer --workers or smaller settings"
        )


def _make_there(
    cell: Cell, needed: Any, topic: str, settings: dict[str, str], n_threads: int, registered: Any
) -> Any:
    """Runs in a worker, which may have been started with other folders, or for another device."""
    os.environ |= settings
    FIELDS.update(registered[0])
    TRACKERS.update(registered[1])
    worker, last = get_worker(), time.monotonic()

    def report(units: int, status: str) -> None:
        nonlocal last
        if time.monotonic() - last > _REPORT_SECONDS:
            last = time.monotonic()
            worker.log_event(topic, [str(cell.folder), units, status])

    with threads(n_threads):
        return outcome_of(cell, needed, report)


def _registered() -> tuple[dict[str, type], dict[str, type]]:
    """Fields and trackers that somebody has added in this process."""
    foreign = [
        {name: kind for name, kind in kinds.items() if not kind.__module__.startswith("nbtrack.")}
        for kinds in (FIELDS, TRACKERS)
    ]
    return foreign[0], foreign[1]


@contextlib.contextmanager
def _client(address: str | None, workers: int) -> Iterator[Any]:
    """Of a Dask cluster: of processes here, which end with this one, or at an address."""
    if address is not None:
        with _connected(address) as client:
            yield client
        return
    with (
        dask.config.set(_LOCAL),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0,
            silence_logs=50, local_directory=str(runs_folder() / "dask"),
            dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        yield client


def _connected(address: str) -> Client:
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
    return client
