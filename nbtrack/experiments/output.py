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
# What the folder of a run and that of a map may hold.
RUN_FILES = ("trajectory.txt", "groundtruth.txt", "frames.csv", METRICS_FILE, OVERVIEW_FILE)
MAP_FILES = (MAP_FILE, CHECKPOINT_FILE, HISTORY_FILE, MESH_FILE)
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
def output_folder(folder: Path | None, *names: str) -> Iterator[None]:
    """Keep a folder for this process alone while files of these names are written there.

    None stands for the cache, whose jobs are kept apart already.

    Raises ConfigError where it is no folder, holds a recording or such files of somebody else, or
    where another process writes; OSError where nothing can be written.
    """
    if folder is None:
        yield
        return
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder} is a file: --out takes a folder; choose another")
    _check_no_recording(folder)
    foreign = [name for name in names if (folder / name).exists()]
    if foreign and not is_own_output(folder):
        raise ConfigError(
            f"{folder} has a {foreign[0]} that nbtrack did not write: choose another --out, or "
            "move the file away"
        )
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / LOCK_FILE, timeout=0):
            yield
    except Timeout:
        raise ConfigError(
            f"another nbtrack command is writing to {folder}: choose another --out, or wait for it"
        ) from None


def _check_no_recording(folder: Path) -> None:
    if holds_recording(folder):
        raise ConfigError(
            f"{folder} holds a recording, where nothing is written: choose another place"
        )
