"""Cells on Dask's workers: local processes, which end with this one, or those of a cluster."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import dask
from distributed import Client, get_worker, wait
from distributed.scheduler import KilledWorker

from nbtrack.core.device import threads
from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.files import data_folder, runs_folder
from nbtrack.experiments.cells import Cell
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


def run_on_workers(
    cells: Mapping[Path, Cell],
    show: Callable[[Path, float, str], None],
    address: str | None,
    workers: int,
    n_threads: int,
) -> Iterator[tuple[Path, Any]]:
    """What becomes of each cell, as they end; each begins as soon as what it needs is there.

    `show` is told where a running cell is. Without the address of a Dask scheduler, `workers` local
    processes are started.
    """
    with dask.config.set(_LOCAL), _client(address, workers) as client:
        topic, news = f"nbtrack-{os.getpid()}-{time.time_ns()}", []
        client.subscribe_topic(topic, lambda event: news.append(event[1]))
        settings = {"NBTRACK_RUNS": str(runs_folder()), "NBTRACK_DATA": str(data_folder())}
        settings |= {k: v for k, v in os.environ.items() if k == "NBTRACK_DEVICE"}
        waiting: dict[Path, Any] = {}
        for priority, (folder, cell) in enumerate(cells.items()):
            needed = waiting.get(cell.needs.folder) if cell.needs else None
            waiting[folder] = client.submit(
                _outcome_there, cell, needed, topic, settings, n_threads, (FIELDS, TRACKERS),
                key=f"{topic}-{folder.name}", pure=False, priority=-priority,
            )  # fmt: skip
        while waiting:
            with contextlib.suppress(TimeoutError):
                wait([*waiting.values()], timeout=_REPORT_SECONDS, return_when="FIRST_COMPLETED")
            while news:
                name, share, status = news.pop(0)
                if Path(name) in waiting:
                    show(Path(name), share, status)
            for folder in [folder for folder, future in waiting.items() if future.done()]:
                try:
                    outcome = waiting.pop(folder).result()
                except KilledWorker:
                    outcome = NbtrackError(
                        f"a worker process died at {folder.name}, perhaps for lack of memory: what "
                        "is done is kept; run it again, with fewer --workers or smaller settings"
                    )
                yield folder, outcome


def _outcome_there(
    cell: Cell, needed: Any, topic: str, settings: dict[str, str], n_threads: int, known: Any
) -> Any:
    """Runs in a worker, which may have been started with other folders, or for another device.

    It may also know fewer fields and trackers: somebody adds them in the process that asks.
    """
    os.environ |= settings
    FIELDS.update(known[0])
    TRACKERS.update(known[1])
    worker, last = get_worker(), time.monotonic()

    def report(share: float, status: str) -> None:
        nonlocal last
        if time.monotonic() - last > _REPORT_SECONDS:
            last = time.monotonic()
            worker.log_event(topic, [str(cell.folder), share, status])

    with threads(n_threads):
        return cell.outcome(needed, report)


def _client(address: str | None, workers: int) -> Client:
    if address is None:  # a cluster of processes here, which end with this one
        return Client(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0,
            silence_logs=50, local_directory=str(runs_folder() / "dask"),
            dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
        )  # fmt: skip
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
