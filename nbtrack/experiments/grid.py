"""Cells computed side by side by Dask's workers, or one after the other by this process.

Small networks gain nothing from a second thread, so scenes and methods share the cores instead.
"""

import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from nbtrack.core.device import choose_device, threads
from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.progress import ProgressBar
from nbtrack.experiments.cells import Cell


@dataclass(frozen=True)
class Execution:
    """How cells are run; of all this only the threads may change last digits of a result."""

    # Processes; by default one a core, or this process alone where a GPU does the work: cells on
    # one GPU only wait for each other.
    workers: int | None = None
    threads: int | None = None  # of each cell; by default this process's, divided by the workers
    dask: str | None = None  # address of a Dask scheduler whose workers run the cells instead
    # A user's mistake in one cell stands in its place among the results, as the exception, and so
    # does one for every cell that needs it; the others still run.
    keep_going: bool = False

    def __post_init__(self) -> None:
        """Raises MissingError, before any work, if Dask is needed and not there."""
        if (self.dask is not None or (self.workers or 1) > 1) and not _has_dask():
            raise MissingError(
                "several workers need Dask: pip install 'nbtrack[cluster]', or give --workers 1"
            )


def run_cells(cells: Sequence[Cell], title: str, execution: Execution | None = None) -> list[Any]:
    """The results of all cells, in order; those that are missing, and what they need, are made.

    Unless it is to keep going, it raises what the first failing cell raised, and drops the others.
    """
    execution, results = execution or Execution(), {}
    wanted = [part for cell in cells if not cell.is_done for part in (cell.needs, cell) if part]
    missing = {cell.folder: cell for cell in wanted if not cell.is_done}
    done = dict.fromkeys(missing, 0.0)

    def show(folder: Path, share: float, status: str) -> None:
        done[folder] = missing[folder].cost * share
        ended = f"{len(results)} of {len(missing)} done"
        bar.move_to(sum(done.values()), f"{ended}, {missing[folder].name}: {status}")

    with (
        ProgressBar(title, sum(cell.cost for cell in missing.values())) as bar,
        closing(_outcomes(missing, results, show, execution)) as outcomes,
    ):
        for folder, outcome in outcomes:
            if isinstance(outcome, NbtrackError) and not execution.keep_going:
                raise outcome
            results[folder] = outcome
            show(folder, 1.0, "done")
    return [results[c.folder] if c.folder in results else c.result() for c in cells]


def _outcomes(
    cells: dict[Path, Cell], results: dict[Path, Any], show: Callable, execution: Execution
) -> Iterator[tuple[Path, Any]]:
    """What becomes of each cell, as they end; what a cell needs comes before it."""
    usual = os.cpu_count() or 1 if _has_dask() and choose_device().type == "cpu" else 1
    workers = min(execution.workers or usual, len(cells))
    if cells and (execution.dask is not None or workers > 1):
        from nbtrack.experiments.workers import run_on_workers

        share = 1 if execution.dask else max(1, torch.get_num_threads() // workers)
        n_threads = execution.threads or share
        yield from run_on_workers(cells, show, execution.dask, workers, n_threads)
        return
    with threads(execution.threads or torch.get_num_threads()):
        for folder, cell in cells.items():
            needed = results.get(cell.needs.folder) if cell.needs else None
            yield folder, cell.outcome(needed, partial(show, folder))


def _has_dask() -> bool:
    return importlib.util.find_spec("distributed") is not None
