"""Where commands write: never into a recording, and never over files that nbtrack did not write."""

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from nbtrack.experiments.runs import METRICS_FILE
from nbtrack.machinery.errors import ConfigError
from nbtrack.machinery.files import resolved, write_atomic, write_together
from nbtrack.mapping.files import HISTORY_FILE, MAP_FILE, MESH_FILE
from nbtrack.plots.style import in_house_style
from nbtrack.recordings.formats import holds_recording

OVERVIEW_FILE = "overview.png"
CHECK_FILE = "check.png"
MARK = ".nbtrack"
"""An empty file in every folder given with --out, where nbtrack may replace its results."""
# The last one of each tells that the others are there.
FILES_OF_RUN = ("trajectory.txt", "groundtruth.txt", "frames.csv", OVERVIEW_FILE, METRICS_FILE)
FILES_OF_MAP = (HISTORY_FILE, MESH_FILE, MAP_FILE)
_RESULTS = (*FILES_OF_RUN, *FILES_OF_MAP, CHECK_FILE, "table_[123]*")


def is_own_output(folder: Path) -> bool:
    """Whether nbtrack has written results into a folder."""
    return (folder / MARK).exists()


def prepare(folder: Path | None) -> None:
    """Mark a folder, before the work, as one for nbtrack's results. For None nothing is done.

    Raises ConfigError where it holds a recording, or files of somebody else that are named like
    results; OSError where nothing can be written.
    """
    if folder is None:
        return
    check_no_recording(folder)
    foreign = [path.name for name in _RESULTS for path in sorted(folder.glob(name))]
    if foreign and not is_own_output(folder):
        raise ConfigError(f"{folder} has a {foreign[0]} that may not be nbtrack's: move it away")
    write_atomic(folder / MARK, "")


def deliver(cached: Path, names: Sequence[str], folder: Path | None) -> Path:
    """Copy a result's files from the cache to a folder, if one is given.

    Returns the folder where the result then is. A file that an earlier result left there, and that
    this one lacks, is removed. The last of `names` is written last, as the sign that all are there.
    """
    if folder is None:
        return cached
    contents = {name: (cached / name).read_bytes() for name in names if (cached / name).is_file()}
    write_together(folder, contents)
    for name in names:
        if name not in contents:
            (folder / name).unlink(missing_ok=True)
    return folder


def check_no_recording(path: Path) -> None:
    """Raises ConfigError if a path that is to be written is a recording, or lies within one."""
    for folder in (path, *resolved(path).parents):
        if folder.is_dir() and holds_recording(folder):
            where = f"{folder} holds a recording, where nothing is written"
            raise ConfigError(f"{where}: choose another")


def save_picture(figure: Figure, path: Path, dpi: float | str = "figure") -> None:
    """Writes a figure as a PNG, by default with the dots per inch of the figure itself."""
    content = io.BytesIO()
    with in_house_style():
        figure.savefig(content, dpi=dpi)
    write_atomic(path, content.getvalue())
