"""Broken input of every kind: one clear line, exit status 2, and earlier results as they were."""

import errno
import json
import os
import resource
import shlex
import signal
import zipfile
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest
from finished import GIVEN, MAP, OWN

from nbtrack.cli import main
from nbtrack.machinery.files import save_checkpoint


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but locks, which are empty, and what Python keeps of an imported file."""
    files = [p for p in folder.rglob("*") if p.is_file() and p.suffix not in (".lock", ".pyc")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def assert_refused(work: Path, capsys, command: list[str], says: str) -> str:
    """The command fails as a user's mistake must: one line, status 2, nothing changed."""
    before = contents(work)
    capsys.readouterr()
    assert main(command) == 2
    lines = capsys.readouterr().err.splitlines()
    beside = "nbtrack: warning: ", "nbtrack: note: "
    (error,) = [line for line in lines if not line.startswith(beside)]
    assert error.startswith("nbtrack: "), error
    assert says in error
    assert contents(work) == before
    return error


def _nothing() -> None:
    """The command itself is the fault."""


def _write(path: str, content: str | bytes) -> Callable[[], object]:
    return lambda: Path(path).write_bytes(content.encode() if isinstance(content, str) else content)


def _gone(path: str) -> Callable[[], None]:
    return lambda: Path(path).unlink()


def _environment(variable: str) -> Callable[[], None]:
    return lambda: os.environ.update([f"NBTRACK_{variable}".split("=", 1)])


def _cut(path: str) -> Callable[[], None]:
    def cut() -> None:
        (whole,) = Path().glob(path)
        whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])

    return cut


def _put(name: str, value) -> Callable[[], None]:
    """Another value of an entry in a run's metrics."""

    def put() -> None:
        path = Path("run/metrics.json")
        path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))

    return put


def _killed(kind: str, finished: str, checkpoint: str, content) -> Callable[[], None]:
    """What a killed command leaves in the cache, but with another content of its checkpoint."""

    def leave() -> None:
        for folder in Path("runs", kind).iterdir():
            (folder / finished).unlink()
            save_checkpoint(folder / checkpoint, content)

    return leave


# Settings in files; more kinds in test_settings.py.
TOML = {
    "binary": (b"\x00\xff\xfe", "readable TOML"),
    "unknown key": (b"[mapping.neus]\niteration = 3", "did you mean 'mapping.neus.iterations'"),
    "date": (b"[mapping.neus]\niterations = 2020-01-01", "must be int"),
    "deep list": (b"tables.rates_hz = " + b"[" * 5000, "readable TOML"),
    "deep table": (b".".join(5000 * [b"a"]) + b" = 1", "unknown config key 'a.a.a.a"),
}
KITTI = ["export", "run", "--to", "kitti", "poses.txt"]
GIF = ["export", "run", "--to", "gif", "m.gif"]
MESH = ["export", "map", "--to", "glb", "m.glb"]
COMMANDS = {"OWN": OWN, "GIVEN": GIVEN, "MAP": MAP}
CUT = "not a readable checkpoint"
TRAJECTORY, MAP_FILE, RUN = "run/trajectory.txt", "map/map.safetensors", "run/metrics.json"
COMMAS = "frame_id,time,translation_error_m,without_depth\n" + 5 * "1,0,1,0,2,False\n"
ROW = "0.1 1 2 3 0 0 0 1"
RUN_OF_WORDS = {"estimates": "here", "rows": [], "tracker": {}, "budget": {}}
KILLED_MAP = "maps", "map.safetensors", "mapping.pt"
KILLED_RUN = "tracks", "metrics.json", "run.pt"
# What is spoilt, the command, and what it says. Spoilt results come first. What a map file may hold
# instead of a map: test_map_files.py.
FAULTS: dict[str, tuple[Callable[[], object], list[str], str]] = {
    "no map": (_nothing, [*GIVEN, "nowhere"], "nowhere holds no finished map"),
    "a run for a map": (_nothing, [*GIVEN, "run"], "run holds no finished"),
    "another file for a map": (_nothing, [*GIVEN, RUN], "map again; give the folder"),
    "map cut": (_cut(MAP_FILE), [*GIVEN, "map"], "not a readable map file"),
    "cached map cut": (_cut("runs/maps/*/map.safetensors"), MAP, "not a readable map file"),
    "history cut": (_write("map/history.csv", "a"), [*GIVEN, "map"], "not a readable history"),
    "map checkpoint cut": (_killed(*KILLED_MAP, {}), MAP, "KeyError: 'recipe'"),
    "run checkpoint is a list": (_killed(*KILLED_RUN, [1]), OWN, "run.pt is " + CUT),
    "run checkpoint of words": (_killed(*KILLED_RUN, RUN_OF_WORDS), OWN, "run.pt is " + CUT),
    "trajectory gone": (_gone(TRAJECTORY), KITTI, "run/trajectory.txt: give a traj"),
    "trajectory empty": (_write(TRAJECTORY, " "), KITTI, "trajectory.txt is empty"),
    "a word": (_write(TRAJECTORY, ROW.replace("3", "x")), KITTI, "readable table"),
    "a NaN": (_write(TRAJECTORY, ROW.replace("3", "nan")), KITTI, "not a finite pose"),
    "another order": (_write(TRAJECTORY, "0.5 0 0 1 1 2 3 4"), KITTI, "of norm 5.48"),
    "unfinished run": (_gone(RUN), KITTI, "no finished run in run"),
    "mesh cut": (_cut("map/mesh.ply"), MESH, "not a readable mesh"),
    "no entries": (_write(RUN, "{}"), KITTI, "run is not a readable run"),
    "a number for a map": (_put("map", 3), [*MESH[:1], "run", *MESH[2:]], "metrics.json is 3"),
    "a text for an origin": (_put("origin", "000"), KITTI, "metrics.json is '000'"),
    "another recording": (_put("recording_key", "x"), GIF, "not the recording of this run"),
    "decimal commas": (_write("run/frames.csv", COMMAS), KITTI, "run is not a readable"),
    "other columns": (_write("run/frames.csv", "a\n" + 4 * "1\n"), KITTI, "run is not a readable"),
}
for case, (content, says) in TOML.items():
    command = [*MAP, "--config", "settings.toml"]
    FAULTS[f"config file: {case}"] = (_write("settings.toml", content), command, says)
REFUSED = pd.read_csv(Path(__file__).parent / "data/refused_commands.csv", keep_default_na=False)
for case, variable, command, says in REFUSED.itertuples(index=False):
    words = [w for word in shlex.split(command) for w in COMMANDS.get(word, [word])]
    FAULTS[case] = (_environment(variable) if variable else _nothing, words, says)


@pytest.mark.parametrize("case", FAULTS)
def test_faults(case: str, work: Path, capsys) -> None:
    """Catches tracebacks, also of the system and for root, whom no permission bit stops; settings
    that are guessed, ignored or checked less in one place; results that are half there and taken
    for whole or repaired in silence; and mistakes that are met after earlier results are gone."""
    spoil, command, says = FAULTS[case]
    spoil()
    with zipfile.ZipFile("scan.r3d", "w") as archive:
        archive.writestr("metadata", "{}")
    assert_refused(work, capsys, command, says)


@contextmanager
def files_limited_to(n_bytes: int):
    """No file may grow beyond a size: a disk that is full in the middle of a write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


@pytest.mark.parametrize("n_bytes", [0, 400, 1500])
def test_a_disk_that_fills_up_while_results_are_written(n_bytes: int, work: Path, capsys) -> None:
    """Catches a run of which half is new and half is old: all of it stays old; and "122684
    requested and 36864 written", which names no cause and no folder."""
    commands = [([*OWN, "--seed", "0", "--frames", "1:"], "run")]
    if n_bytes < 1000:
        make = "data make office --out new --n-frames 2 --width 64"
        commands.append((make.split(), "new"))
    if n_bytes == 0:
        commands += [(["export", "map", "--to", "ply", "new"], "new"), (KITTI, "poses.txt")]
    with files_limited_to(n_bytes):
        for command, place in commands:
            assert os.strerror(errno.EFBIG) in assert_refused(work, capsys, command, place)
    assert json.loads((work / "run/metrics.json").read_text())["frames"] == 5
