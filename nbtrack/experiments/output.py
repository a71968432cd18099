"""Where commands write: never into a recording, and never over files that nbtrack did not write."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

from filelock import Timeout
from matplotlib.figure import Figure
from PIL import Image

from nbtrack.core.errors import ConfigError
from nbtrack.core.files import resolved, write_atomic
from nbtrack.experiments.runs import METRICS_FILE
from nbtrack.locks import locked
from nbtrack.mapping.files import CHECKPOINT_FILE, HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.plots.style import in_house_style
from nbtrack.recordings.formats import holds_recording

OVERVIEW_FILE = "overview.png"
# What the folders of runs, maps and tables may hold.
_RUN_FILES = ("trajectory.txt", "groundtruth.txt", "frames.csv", METRICS_FILE, OVERVIEW_FILE)
_MAP_FILES = (MAP_FILE, CHECKPOINT_FILE, HISTORY_FILE, MESH_FILE)
_TABLE_FILES = ("table_[123]*",)  # in every form
_SOFTWARE = "nbtrack"
LOCK_FILE = ".nbtrack.lock"
"""It stays in every folder that was given with --out, and tells that nbtrack wrote there."""


def is_own_output(folder: Path) -> bool:
    """Whether nbtrack has written results into a folder."""
    return any((folder / n).exists() for n in (LOCK_FILE, METRICS_FILE, MAP_FILE, CHECKPOINT_FILE))


def new_file(path: Path) -> Path:
    """The path of a file to be written, in a folder that is made where it is missing.

    Raises ConfigError if it lies in a recording, or exists and is no picture that nbtrack drew.
    """
    check_no_recording(path)
    if path.exists() and not _is_own_picture(path):
        raise ConfigError(f"{path} exists: choose another file to write, or remove it first")
    return path


def save_picture(figure: Figure, path: Path, dpi: float | None = None) -> None:
    """Writes a figure as a PNG that says that nbtrack drew it, and may replace it."""
    content = io.BytesIO()
    with in_house_style():
        figure.savefig(content, dpi=dpi or "figure", metadata={"Software": _SOFTWARE})
    write_atomic(path, content.getvalue())


def _is_own_picture(path: Path) -> bool:
    with contextlib.suppress(OSError), Image.open(path) as picture:
        return picture.info.get("Software") == _SOFTWARE
    return False


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
    check_no_recording(folder)
    names = _RUN_FILES + _MAP_FILES + _TABLE_FILES
    foreign = [path.name for name in names for path in sorted(folder.glob(name))]
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
