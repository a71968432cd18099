"""What a cell is, and what is known of cells while they run."""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nbtrack.core.errors import NbtrackError
from nbtrack.core.progress import ProgressBar

Report = Callable[[int, str], None]
"""Called by a cell with the units done so far and a word on how it goes."""


class Cell(abc.ABC):
    """One piece of work: picklable, kept below its folder's name, perhaps made of another's."""

    name: str
    folder: Path
    units: int  # that it reports: iterations or frames
    cost: float  # work in all, relative to other cells: its share of the bar
    needs: "Cell | None"
    is_done: bool

    @abc.abstractmethod
    def result(self) -> Any:
        """What a finished cell has kept."""

    @abc.abstractmethod
    def make(self, report: Report) -> Any:
        """Compute it, or wait for whoever does; returns the result."""


@dataclass
class Board:
    """What is known of the cells while they run."""

    bar: ProgressBar
    cells: dict[Path, Cell]
    results: dict[Path, Any]
    keep_going: bool

    def __post_init__(self) -> None:
        self.shares = dict.fromkeys(self.cells, 0.0)

    def show(self, folder: Path, units: int, status: str) -> None:
        """Move the bar to where a cell says it is."""
        cell = self.cells[folder]
        self.shares[folder] = min(1.0, units / max(cell.units, 1))
        done = sum(share * self.cells[f].cost for f, share in self.shares.items())
        ended = f"{len(self.results)} of {len(self.cells)} done"
        self.bar.move_to(done, f"{ended}, {cell.name}: {status}")

    def settle(self, folder: Path, outcome: Any) -> None:
        """Note what became of a cell. Raises a user's mistake unless that is to be kept."""
        if isinstance(outcome, NbtrackError) and not self.keep_going:
            raise outcome
        self.results[folder] = outcome
        self.show(folder, self.cells[folder].units, "done")


def outcome_of(cell: Cell, needed: Any, report: Report) -> Any:
    """What a cell returns, or the user's mistake that it met, or was kept from it by."""
    if isinstance(needed, NbtrackError):
        return NbtrackError(f"not run, because {cell.needs.name} failed: {needed}")
    try:
        return cell.make(report)
    except NbtrackError as error:
        return error
