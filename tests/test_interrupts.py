"""Ctrl-C in a terminal: a line and status 130, at whatever moment, and nothing left running."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tiny import tiny_words

from nbtrack.interrupts import interrupts_put_off

# As libraries do that try what else there is: an import that takes Ctrl-C for a failure of its own.
IMPORTING = """
import os, signal, sys
from nbtrack.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

class Swallowing:
    def find_spec(self, name, *more):
        try:
            if name == "torch":
                os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            pass

sys.meta_path.insert(0, Swallowing())
sys.exit(main(["track", "nowhere"]))
"""
# To the whole group, as a terminal does, while its workers begin.
WORKING = """
import os, signal, sys, threading
from nbtrack.cli import main
from nbtrack.experiments import grid

if __name__ == "__main__":
    client = grid._client
    def watched(*arguments):
        threading.Timer(0.7, os.killpg, (0, signal.SIGINT)).start()
        return client(*arguments)
    grid._client = watched
    sys.exit(main({}))
"""


def interrupted(script: Path, content: str) -> str:
    """What a script says in its last line; all that it has started has ended by then."""
    script.write_text(content)
    run = [sys.executable, str(script)]
    found = subprocess.run(run, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert found.returncode == 130, found.stderr
    assert "Traceback" not in found.stderr
    assert "Warning" not in found.stderr
    return found.stderr.splitlines()[-1]


def test_while_a_library_is_imported(tmp_path: Path) -> None:
    """Catches Ctrl-C that is swallowed, so that the command goes on for minutes."""
    assert "interrupted" in interrupted(tmp_path / "importing.py", IMPORTING)


def test_while_workers_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches tracebacks of workers, of a cluster that is closed half opened, and processes left
    behind: then the pipe that they all write to would stay open."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    long = "mapping.imap.iterations=100000", "mapping.neus.iterations=100000"
    command = ["tables", "--workers", "2", *tiny_words(*long)]
    assert "interrupted" in interrupted(tmp_path / "working.py", WORKING.format(command))


def test_windows_has_no_signal_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches workers that cannot be started where signals cannot be blocked."""
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(signal, "pthread_sigmask")
    with interrupts_put_off():
        ran = True
    assert ran
