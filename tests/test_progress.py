"""What is printed while a command runs and no bar is shown: a line every 30 seconds."""

from types import SimpleNamespace

import pytest

from nbtrack.machinery.progress import ProgressBar


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """That of the bars, in seconds, moved by hand."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now)
    return clock


def test_a_line_now_and_then(clock, capsys) -> None:
    """Catches output that is silent until the end, or never, and an ETA that is not from the mean
    speed: 2 of 8 parts in 31 seconds leave 93."""
    with ProgressBar("mapping", 8) as bar:
        for clock.now, done in ((31, 2), (40, 3), (90, 8)):
            bar.move_to(done, "loss 0.5")
    first, *others = capsys.readouterr().err.splitlines()
    assert first == "mapping: 25 %, 00:31 gone, 01:33 left, loss 0.5"
    assert {*others} == {"mapping: 100 %, 01:30 gone, 00:00 left, loss 0.5"}


def test_a_warm_up_is_left_out(clock, capsys) -> None:
    """Catches hours that are left for half an hour, because the first frame was compiled."""
    with ProgressBar("tracking", 60) as bar:
        clock.now = 600
        bar.end_warm_up(1)
        bar.move_to(1)
        clock.now = 631
        bar.move_to(2)
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert "? left" in first
    assert "29:58 left" in second  # 58 times 31 s


def test_short_and_hidden_work_is_silent(clock, capsys) -> None:
    """Catches noise about what takes no time, and about what nobody asked to see."""
    with ProgressBar("short", 1) as bar:
        bar.move_to(1)
    with ProgressBar("hidden", 1, is_shown=False) as bar:
        clock.now = 60
        bar.move_to(1)
    assert capsys.readouterr().err == ""
