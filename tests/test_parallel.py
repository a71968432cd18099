"""Jobs side by side: order, progress, and ends that are not happy."""

import os

import pytest

from nbtrack.core.errors import DataError, NbtrackError
from nbtrack.experiments.parallel import Execution, Job, Report, run_jobs


def square(number: int, report: Report) -> int:
    """A job with two units of work."""
    report(1, "half")
    report(2, "done")
    return number * number


def fail(message: str, report: Report) -> None:
    """A job that meets a user's mistake."""
    raise DataError(message)


def die(code: int, report: Report) -> None:
    """A job that the system kills."""
    os._exit(code)


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order(workers: int, capsys: pytest.CaptureFixture) -> None:
    """Catches results in the order of their completion, and noise before there is news."""
    jobs = [Job(f"job {n}", 2, square, (n,)) for n in range(4)]
    assert run_jobs(jobs, "squares", Execution(workers)) == [0, 1, 4, 9]
    if workers == 1:
        assert capsys.readouterr().err == ""


def test_no_jobs() -> None:
    """Catches a pool of zero workers."""
    assert run_jobs([], "nothing") == []


@pytest.mark.parametrize("workers", [1, 2])
def test_a_users_mistake_comes_through(workers: int) -> None:
    """Catches errors of workers that lose their class or message on the way."""
    jobs = [Job("bad", 1, fail, ("depth1.png is empty",)), Job("good", 2, square, (2,))]
    with pytest.raises(DataError, match=r"depth1.png is empty"):
        run_jobs(jobs, "mixed", Execution(workers))


def test_a_killed_worker_is_explained() -> None:
    """Catches a traceback, or waiting for ever, where the system took a worker away."""
    jobs = [Job("dead", 1, die, (1,)), Job("good", 2, square, (2,))]
    with pytest.raises(NbtrackError, match="a worker process died"):
        run_jobs(jobs, "dying", Execution(2))
