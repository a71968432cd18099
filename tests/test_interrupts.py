"""Ctrl-C in a terminal: a line and status 130, at whatever moment, and nothing left running."""

import subprocess
import sys
from pathlib import Path

import pytest
from tiny import tiny_words

# To the whole group, as a terminal does; a shell's background jobs ignore it.
SCRIPT = """
import glob, os, signal, sys, threading, time
from nbtrack.cli import main

def press():
    while not ({condition}):
        time.sleep(0.01)
    time.sleep({seconds})
    os.killpg(0, signal.SIGINT)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=press).start()
    sys.exit(main({words}))
"""
IMPORTING = "'torch' in sys.modules", 0.1
BEGINNING = "'multiprocessing.popen_spawn_posix' in sys.modules", 0.7
WORKING = "glob.glob(os.environ['NBTRACK_RUNS'] + '/locks/*')", 1.0


@pytest.mark.parametrize("moment", [IMPORTING, BEGINNING, WORKING])
def test_interrupted(moment: tuple[str, float], tmp_path: Path, monkeypatch) -> None:
    """Catches tracebacks, also of workers that begin, Ctrl-C that does not end a command, and
    processes left behind: then the pipe that they all write to would stay open."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    long = "mapping.imap.iterations=100000", "mapping.neus.iterations=100000"
    words = ["tables", "--workers", "2", *tiny_words(*long)]
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(condition=moment[0], seconds=moment[1], words=words))
    run = [sys.executable, str(script)]
    found = subprocess.run(run, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert found.returncode == 130, found.stderr
    assert "Traceback" not in found.stderr
    assert "Warning" not in found.stderr
    assert "interrupted" in found.stderr.splitlines()[-1]
