"""A job: one piece of work, named by all that it depends on, and made once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from nbtrack.core import files
from nbtrack.core.device import advise_on_memory
from nbtrack.core.errors import NbtrackError
from nbtrack.experiments.output import check_no_recording
from nbtrack.locks import locked

Report = Callable[[float, str], None]
"""Called by a job with the share of it that is done and a word on how it goes."""


class Job:
    """One piece of work: picklable, kept in a folder of its own, perhaps made of another's."""

    kind: str  # the part of the cache where it is kept
    name: str  # for readers
    key: str  # changes with everything that the result depends on
    doing: str = "computing"  # what its progress is called
    work: float = 1.0  # queries of a field, about, for the time that is left
    out: Path | None = None  # where to keep it instead of in the cache
    needs: "Job | None"
    is_done: bool
    result: Callable[[], Any]  # what a finished job has kept
    compute: Callable[[Report], Any]  # makes it, or takes a killed attempt up; returns `result`

    @property
    def cache(self) -> Path:
        """Its folder in the cache."""
        return files.runs_folder() / self.kind / f"{self.name}-{self.key}"

    @property
    def folder(self) -> Path:
        """Where its files are kept."""
        return self.out or self.cache

    def outcome(self, needed: Any, report: Report) -> Any:
        """Its `result`, made where it is missing, or the user's mistake that kept it from that.

        What another process is computing is waited for. A lock keeps others out, which
        the system frees when that process ends.
        """
        if isinstance(needed, NbtrackError):
            return NbtrackError(f"not run, because {self.needs.name} failed: {needed}")
        path = files.runs_folder() / "locks" / f"{self.cache.name}.lock"
        report(0.0, "begins, or waits for another process that makes the same")
        try:
            check_no_recording(path)
            with locked(path), advise_on_memory(f"the frames and settings of {self.name}"):
                return self.result() if self.is_done else self.compute(report)
        except NbtrackError as error:
            return error
