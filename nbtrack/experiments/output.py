"""Where commands write: never into a recording, and never over files that nbtrack did not write."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

from filelock import Timeout
from matplotlib.figure import Figure

from nbtrack.core.errors import ConfigError
from nbtrack.core.files import resolved, write_atomic
from nbtrack.experiments.runs import METRICS_FILE
from nbtrack.locks import locked
from nbtrack.mapping.files import CHECKPOINT_FILE, HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.plots.style import in_house_style
from nbtrack.recordings.formats import holds_recording

OVERVIEW_FILE = "overview.png"
CHECK_FILE = "check.png"
LOCK_FILE = ".nbtrack.lock"
"""It stays in every folder that was given with --out, and tells that nbtrack wrote there."""
_RESULTS = (
    *("trajectory.txt", "groundtruth.txt", "frames.csv", METRICS_FILE, OVERVIEW_FILE, CHECK_FILE),
    *(MAP_FILE, CHECKPOINT_FILE, HISTORY_FILE, MESH_FILE, "table_[123]*"),
)


def is_own_output(folder: Path) -> bool:
    """Whether nbtrack has written results into a folder."""
    return any((folder / n).exists() for n in (LOCK_FILE, METRICS_FILE, MAP_FILE, CHECKPOINT_FILE))


def check_new(path: Path) -> None:
    """Raises ConfigError if a path that is to be written exists, or lies in a recording."""
    check_no_recording(path)
    if path.exists():
        raise ConfigError(f"{path} exists: choose another file to write, or remove it first")


def save_picture(figure: Figure, path: Path, dpi: float | str = "figure") -> None:
    """Writes a figure as a PNG."""
    content = io.BytesIO()
    with in_house_style():
        figure.savefig(content, dpi=dpi)
    write_atomic(path, content.getvalue())


@contextlib.contextmanager
def output_folder(folder: Path | None) -> Iterator[None]:
    """Keep a folder for this process alone while results are written there.

    None stands for the cache, whose jobs are kept apart already. Raises ConfigError where it holds
    a recording, or files of somebody else that are named like results, or where another process
    writes; OSError where nothing can be written.
    """
    if folder is None:
        yield
        return
    check_no_recording(folder)
    foreign = [path.name for name in _RESULTS for path in sorted(folder.glob(name))]
    if foreign and not is_own_output(folder):
        raise ConfigError(f"{folder} has a {foreign[0]} that nbtrack did not write: move it away")
    try:
        with locked(folder / LOCK_FILE, timeout=0):
            yield
    except Timeout:
        raise ConfigError(f"another nbtrack command is writing to {folder}: wait for it") from None


def check_no_recording(path: Path) -> None:
    """Raises ConfigError if a path that is to be written is a recording, or lies within one."""
    for folder in (path, *resolved(path).parents):
        if folder.is_dir() and holds_recording(folder):
            raise ConfigError(
                f"{folder} holds a recording, where nothing is written: choose another"
            )
