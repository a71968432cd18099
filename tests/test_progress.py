"""What is printed while a command runs and no bar is shown: a line every 30 seconds."""

import pytest

from nbtrack.machinery.progress import ProgressBar, tell


class Clock:
    """Seconds, moved by hand."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    """That of the bars."""
    monkeypatch.setattr("tqdm.std.time", clock := Clock())
    return clock


def test_a_line_now_and_then(clock: Clock, capsys) -> None:
    """Catches output that is silent until the end, or never, and an ETA that is not from the mean
    speed: 2 of 8 parts in 31 seconds leave 93."""
    with ProgressBar("mapping", 8) as bar:
        for clock.now, done in ((31, 2), (40, 3), (90, 8)):
            bar.move_to(done, "loss 0.5")
    first, *others = capsys.readouterr().err.splitlines()
    assert first == "mapping: 25 %, 00:31 gone, 01:33 left, loss 0.5"
    assert {*others} == {"mapping: 100 %, 01:30 gone, 00:00 left, loss 0.5"}


def test_a_warm_up_is_left_out(clock: Clock, capsys) -> None:
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


@pytest.mark.parametrize("columns", [60, 120])
def test_a_narrow_terminal(clock: Clock, monkeypatch, capsys, columns: int) -> None:
    """Catches a bar of which nothing but a long title is left, and warnings without colour; and
    colours where they were not asked for, or nobody looks."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    with ProgressBar("tracking living_room-neus_plus-corrected-lm-10hz-seed3", 8) as bar:
        clock.now = 31
        bar.move_to(2, "waits for another process that makes the same")
        line = bar.format_meter(**bar.format_dict | {"ncols": columns})
    assert line.startswith(" 25 % |███         | 01:33 left, tracking living_room")
    capsys.readouterr()
    for no_color, color, end in (("", "\33[33m", "\33[0m"), ("1", "", "")):
        monkeypatch.setenv("NO_COLOR", no_color)
        tell("nbtrack: warning: w")
        assert capsys.readouterr().err == f"{color}nbtrack: warning: w{end}\n"


def test_short_and_hidden_work_is_silent(clock: Clock, capsys) -> None:
    """Catches noise about what takes no time, and about what nobody asked to see."""
    with ProgressBar("short", 1) as bar:
        bar.move_to(1)
    with ProgressBar("hidden", 1, is_shown=False) as bar:
        clock.now = 60
        bar.move_to(1)
    assert capsys.readouterr().err == ""
