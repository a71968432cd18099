"""What is printed while a command runs and no bar is shown."""

import re
import time

import pytest

from nbtrack.core.progress import ProgressBar


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines after 0.2 s, and then twice a second."""
    monkeypatch.setattr("nbtrack.core.progress._FIRST_LINE_SECONDS", 0.2)
    monkeypatch.setattr("nbtrack.core.progress._LINE_SECONDS", 0.5)


def test_a_line_now_and_then(often: None, capsys: pytest.CaptureFixture) -> None:
    """Catches output that is silent until the end, or as long as one step takes; an ETA that is not
    from the mean speed: 2 of 8 parts in a second leave three seconds."""
    with ProgressBar("mapping", 8) as bar:
        time.sleep(0.5)
        bar.move_to(2, "loss 0.5")
        time.sleep(0.6)
        bar.move_to(8)
    first, second, *_, last = capsys.readouterr().err.splitlines()
    assert first == "mapping: 0 %, 00:00 gone, ? left"
    assert re.fullmatch(r"mapping: 25 %, 00:0[01] gone, 00:0[2-4] left, loss 0.5", second)
    assert last == "mapping: done in 1 s"


def test_short_and_hidden_work_is_silent(often: None, capsys: pytest.CaptureFixture) -> None:
    """Catches noise about what takes no time, and about what nobody asked to see."""
    with ProgressBar("short", 1) as bar:
        bar.move_to(1)
    with ProgressBar("hidden", 1, is_shown=False):
        time.sleep(0.4)
    assert capsys.readouterr().err == ""
