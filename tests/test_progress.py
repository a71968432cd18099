"""What is printed while a command runs and no bar is shown."""

import re
import time

import pytest

from nbtrack.core.progress import ProgressBar


def test_a_line_now_and_then(monkeypatch, capsys: pytest.CaptureFixture) -> None:
    """Catches output that is silent until the end, or never; an ETA that is not from the mean
    speed: 2 of 8 parts in 1.2 seconds leave three or four seconds."""
    monkeypatch.setattr("nbtrack.core.progress._LINE_SECONDS", 0.1)
    with ProgressBar("mapping", 8) as bar:
        time.sleep(1.2)
        bar.move_to(2, "loss 0.5")
        bar.move_to(3)
        time.sleep(0.2)
        bar.move_to(8)
    first, *_, last = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"mapping: 25 %, 00:01 gone, 00:0[34] left, loss 0.5", first)
    assert re.fullmatch(r"mapping: 100 %, 00:01 gone, 00:00 left", last)


def test_a_warm_up_is_left_out(monkeypatch, capsys: pytest.CaptureFixture) -> None:
    """Catches an hour that is left for half a minute, because the first frame was compiled: 58 of
    60 parts after one in a tenth of a second leave about six seconds."""
    monkeypatch.setattr("nbtrack.core.progress._LINE_SECONDS", 0.1)
    with ProgressBar("tracking", 60) as bar:
        time.sleep(1.1)
        bar.warm_up = 1, bar.format_dict["elapsed"]
        bar.move_to(1)
        time.sleep(0.1)
        bar.move_to(2)
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert "? left" in first
    assert re.search(r"00:0[5-9] left", second)


def test_short_and_hidden_work_is_silent(capsys: pytest.CaptureFixture) -> None:
    """Catches noise about what takes no time, and about what nobody asked to see."""
    with ProgressBar("short", 1) as bar:
        bar.move_to(1)
    with ProgressBar("hidden", 1, is_shown=False) as bar:
        time.sleep(0.4)
        bar.move_to(1)
    assert capsys.readouterr().err == ""
