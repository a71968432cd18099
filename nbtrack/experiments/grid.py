"""Cells computed side by side by Dask's workers, or one after the other by this process.

Small networks gain nothing from a second thread, so scenes and methods share the cores instead.
"""

import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from nbtrack.core.device import choose_device, threads
from nbtrack.core.errors import MissingError
from nbtrack.core.progress import ProgressBar
from nbtrack.experiments.board import Board, Cell, outcome_of


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
        needs_dask = self.dask is not None or (self.workers or 1) > 1
        if needs_dask and importlib.util.find_spec("distributed") is None:
            raise MissingError(
                "several workers need Dask: pip install 'nbtrack[cluster]', or give --workers 1"
            )


def run_cells(cells: Sequence[Cell], title: str, execution: Execution | None = None) -> list[Any]:
    """The results of all cells, in order; those that are missing, and what they need, are made.

    Raises:
        Whatever the first failing cell raised, unless it is to keep going; the others are then
        abandoned.
    """
    execution = execution or Execution()
    missing: dict[Path, Cell] = {}
    for cell in cells:
        if not cell.is_done:
            if cell.needs and not cell.needs.is_done:
                missing.setdefault(cell.needs.folder, cell.needs)
            missing.setdefault(cell.folder, cell)
    results: dict[Path, Any] = {}
    if missing:
        with ProgressBar(title, sum(cell.cost for cell in missing.values())) as bar:
            board = Board(bar, missing, results, execution.keep_going)
            _run(board, execution)
    return [results[c.folder] if c.folder in results else c.result() for c in cells]


def _run(board: Board, execution: Execution) -> None:
    workers = execution.workers or _usual_workers()
    workers = min(workers, len(board.cells))
    if execution.dask is not None or workers > 1:
        from nbtrack.experiments.workers import run_on_workers

        share = 1 if execution.dask else max(1, torch.get_num_threads() // workers)
        run_on_workers(board, execution.dask, workers, execution.threads or share)
        return
    with threads(execution.threads or torch.get_num_threads()):
        for folder, cell in board.cells.items():
            needed = board.results.get(cell.needs.folder) if cell.needs else None
            board.settle(folder, outcome_of(cell, needed, partial(board.show, folder)))


def _usual_workers() -> int:
    has_dask = importlib.util.find_spec("distributed") is not None
    return os.cpu_count() or 1 if has_dask and choose_device().type == "cpu" else 1
