"""Where commands write: never into a recording, and never over files that nbtrack did not write."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from nbtrack.core.errors import ConfigError
from nbtrack.data.formats import holds_recording
from nbtrack.mapping.files import CHECKPOINT_FILE, HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.tracking.trajectories import METRICS_FILE

OVERVIEW_FILE = "overview.png"
# What the folders of runs, maps and tables may hold.
_RUN_FILES = ("trajectory.txt", "groundtruth.txt", "frames.csv", METRICS_FILE, OVERVIEW_FILE)
_MAP_FILES = (MAP_FILE, CHECKPOINT_FILE, HISTORY_FILE, MESH_FILE)
_TABLE_FILES = ("table_1.csv", "table_2.csv", "table_3.csv")
LOCK_FILE = ".nbtrack.lock"
"""It stays in every folder that was given with --out, and tells that nbtrack wrote there."""


def is_own_output(folder: Path) -> bool:
    """Whether nbtrack has written results into a folder."""
    return any((folder / n).exists() for n in (LOCK_FILE, METRICS_FILE, MAP_FILE, CHECKPOINT_FILE))


def new_file(path: Path) -> Path:
    """The path of a file to be written. Raises ConfigError if it exists or lies in a recording."""
    if path.exists():
        raise ConfigError(f"{path} exists: choose another file to write, or remove it first")
    _check_no_recording(path.parent)
    return path


@contextlib.contextmanager
def output_folder(folder: Path | None) -> Iterator[None]:
    """Keep a folder for this process alone while results are written there.

    None stands for the cache, whose jobs are kept apart already.

    Raises ConfigError where it holds a recording, or files of somebody else that are named like
    results, or where another process writes; OSError where nothing can be written.
    """
    if folder is None:
        yield
        return
    _check_no_recording(folder)
    names = _RUN_FILES + _MAP_FILES + _TABLE_FILES
    foreign = [name for name in names if (folder / name).exists()]
    if foreign and not is_own_output(folder):
        raise ConfigError(f"{folder} has a {foreign[0]} that nbtrack did not write: move it away")
    try:
        with FileLock(folder / LOCK_FILE, timeout=0):
            yield
    except Timeout:
        raise ConfigError(f"another nbtrack command is writing to {folder}: wait for it") from None


def _check_no_recording(folder: Path) -> None:
    if holds_recording(folder):
        raise ConfigError(f"{folder} holds a recording, where nothing is written: choose another")
