"""Broken input of every kind: one clear line, exit status 2, and earlier results as they were."""

import errno
import io
import json
import os
import resource
import signal
import sys
import zipfile
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
    (error,) = [line for line in lines if not line.startswith("nbtrack: warning: ")]
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


def _environment(name: str, value: str) -> Callable[[], None]:
    return lambda: os.environ.update({f"NBTRACK_{name}": value})


def _cut(path: str) -> Callable[[], None]:
    def cut() -> None:
        (whole,) = Path().glob(path)
        whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])

    return cut


def _killed(kind: str, finished: str, checkpoint: str, content: Any) -> Callable[[], None]:
    """What a killed command leaves in the cache, but with another content of its checkpoint."""

    def leave() -> None:
        for folder in Path("runs", kind).iterdir():
            (folder / finished).unlink()
            save_checkpoint(folder / checkpoint, content)

    return leave


def _cache_in_a_loop_of_links() -> None:
    Path("one").symlink_to("other")
    Path("other").symlink_to("one")
    os.environ["NBTRACK_RUNS"] = "one"


# Settings in files, on the command line and in the environment; more kinds in test_settings.py.
TOML = {
    "binary": (b"\x00\xff\xfe", "readable TOML"),
    "no TOML": (b"width: 3", "readable TOML"),
    "unknown key": (b"[mapping.neus]\niteration = 3", "did you mean 'mapping.neus.iterations'"),
    "date": (b"[mapping.neus]\niterations = 2020-01-01", "must be int"),
    "deep list": (b"tables.rates_hz = " + b"[" * 5000, "readable TOML"),
    "deep table": (b".".join(5000 * [b"a"]) + b" = 1", "unknown config key 'a.a.a.a"),
}
ENVIRONMENT = {
    "unclosed quote": ("SET", "'a=3", "cannot be split"),
    "no value": ("SET", "mapping.neus.iterations", "has no value"),
    "preset": ("PRESET", "smok", "did you mean 'smoke'"),
    "no config": ("CONFIG", "none.toml", "none.toml: give a TOML file"),
    "config folder": ("CONFIG", "map", "map: give a TOML file"),
    "no memory": ("DEVICE", "meta", "no device 'meta': this machine"),
    "no module": ("DEVICE", "hpu", "no device 'hpu': this machine"),
    "runs in a file": ("RUNS", "room", "room"),
}
KITTI = ["export", "run", "--to", "kitti", "poses.txt"]
MESH = ["export", "map", "--to", "glb", "m.glb"]
MAKE = ["data", "make", "office", "--out", "new"]
OTHER = [*OWN, "--seed", "9"]  # whose map is not made: what is refused must not make it first
NO_STEPS = [*OWN[:4], "--field", "neus"]
PLAIN = [*GIVEN[:2], "--method", "neus_corrected"]
CUT = "not a readable checkpoint"
TRAJECTORY, MAP_FILE, RUN = "run/trajectory.txt", "map/map.safetensors", "run/metrics.json"
ROW = "0.1 1 2 3 0 0 0 1"
RUN_OF_WORDS = {"estimates": "here", "rows": [], "tracker": {}, "budget": {}}
KILLED_MAP = "maps", "map.safetensors", "mapping.pt"
KILLED_RUN = "tracks", "metrics.json", "run.pt"
# Results that were spoilt. What a map file may hold instead of a map: test_map_files.py.
FILES = {
    "cache in a loop": (_cache_in_a_loop_of_links, OWN, "symbolic links"),
    "no map": (_nothing, [*GIVEN, "nowhere"], "nowhere holds no finished map"),
    "a run for a map": (_nothing, [*GIVEN, "run"], "run holds no finished"),
    "another file for a map": (_nothing, [*GIVEN, RUN], "map again, and give"),
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
}
ARGUMENTS = {
    "nothing": ([], "COMMAND"),
    "no folder to make": (["data", "make", "office"], "--out"),
    "onto itself": (["export", "room", "--to", "ply", "room"], "room exists: choose another"),
    "into the kernel": ([*KITTI[:-1], "/proc/nbtrack/poses.txt"], "/proc/nbtrack"),
    "a method and a field": ([*OWN, "--method", "sdf"], "leave --field and --tracker out"),
    "a phone's archive": (["track", "scan.r3d"], "unpack it by `unzip scan.r3d -d scan`"),
    "a movie to check": (["data", "check", "map/map.safetensors"], "is a file: give the rec"),
    "nobody's home": (["data", "check", "~no_such_user/rec"], "no such user; a folder of"),
    "unknown method": (["track", "living_room", "--method", "corected"], "mean 'corrected'"),
    "a method in another map": ([*GIVEN[:2], "--method", "vr", "--map-from", "map"], "not 'imap'"),
    "a plain map": ([*PLAIN, "--map-from", "map"], "was made with correction.neus=0.0, not "),
    "tracker not the map's": ([*GIVEN, "map", "--tracker", "icp"], "does not work on field 'neus'"),
    "two maps": ([*GIVEN, "map", "--map-frames", ":3"], "leave --map-frames out"),
    "an unknown option": ([*OWN, "--bake", "nan"], "unknown argument '--bake': "),
    "no frames to map": ([*OWN, "--map-frames", "10:20"], "0 of the"),
    "no slice": ([*OWN, "--frames", "3"], "is no slice"),
    "one frame": ([*OWN, "--frames", "2:3"], "too short to track"),
    "unknown motion": ([*OTHER, "--set", "tracking.sdf.motion_model=leap"], "unknown motion model"),
    "unknown start": ([*OTHER, "--start", "unknown"], "whose first pose is not known"),
    "frames without end": ([*NO_STEPS, "--rate", "1e-308"], "rate_hz is 1e-308"),
    "too many frames": ([*MAKE, "--n-frames", "1000000000"], "must be 2 to"),
    "too many seeds": (["tables", "--seeds", "1000000000"], "from 1 to 1000"),
    "unknown room": (["track", "living_rom", *OWN[2:]], "did you mean 'living_room'"),
    "both budgets": ([*OWN, "--rate", "2"], "steps=2.0 and rate_hz=2.0: a frame has one budget"),
    "room onto a folder": ([*MAKE[:-1], "run"], "exists"),
    "motion as a path": ([*MAP, "--set", "scenes.motion=tour/../x"], "write 'keyframes' or "),
}


Fault = tuple[Callable[[], object], list[str], str]  # what is spoilt, the command, what it says
FAULTS: dict[str, Fault] = FILES | {case: (_nothing, *fault) for case, fault in ARGUMENTS.items()}
for case, (content, says) in TOML.items():
    command = [*MAP, "--config", "settings.toml"]
    FAULTS[f"config file: {case}"] = (_write("settings.toml", content), command, says)
for case, (name, value, says) in ENVIRONMENT.items():
    FAULTS[f"environment: {case}"] = (_environment(name, value), OWN, says)


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
def files_limited_to(n_bytes: int) -> Any:
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
        commands.append(([*MAKE, "--n-frames", "2", "--width", "64"], "new"))
    if n_bytes == 0:
        commands += [(["export", "map", "--to", "ply", "new"], "new"), (KITTI, "poses.txt")]
    with files_limited_to(n_bytes):
        for command, place in commands:
            assert os.strerror(errno.EFBIG) in assert_refused(work, capsys, command, place)
    assert json.loads((work / "run/metrics.json").read_text())["frames"] == 5


def test_streams_and_letters(tmp_path: Path, monkeypatch) -> None:
    """Catches a daemon's command that ends at its first message, with nothing written, and one that
    has done its work and cannot print a path with letters of other languages."""
    for stream in (None, io.TextIOWrapper(io.BytesIO(), encoding="ascii")):
        monkeypatch.setattr(sys, "stdout", stream)  # it is None where it is closed
        monkeypatch.setattr(sys, "stderr", stream)
        out = tmp_path / f"Küche{stream is None}"
        assert main([*MAKE[:-1], str(out), "--n-frames", "2", "--width", "16"]) == 0
        sys.stdout.close()
        sys.stderr.close()
        assert (out / "poses.txt").is_file()


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks(code: int, work: Path, monkeypatch) -> None:
    """Catches "No locks available", which no user can mend, in place of a room, a map and a run."""

    def no_lock(descriptor: int, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", no_lock)
    assert main([*OWN, "--frames", "1:", "--out", "elsewhere"]) == 0
    assert Path("elsewhere/metrics.json").is_file()
