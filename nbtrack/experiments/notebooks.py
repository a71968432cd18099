"""Run the numbered notebooks without a browser and keep executed and HTML copies."""

import os
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import HTMLExporter
from tqdm.auto import tqdm

from nbtrack.core.errors import NbtrackError
from nbtrack.core.files import write_text_atomic
from nbtrack.core.paths import PROJECT_ROOT, runs_folder

NOTEBOOKS = PROJECT_ROOT / "notebooks"


def run_notebooks(
    preset: str,
    config_file: Path | None = None,
    settings: tuple[str, ...] = (),
    in_place: bool = False,
) -> list[Path]:
    """Execute every notebook in order; returns the HTML copies.

    Copies go to `runs/notebooks/<preset>/`. Settings reach the kernels through the environment,
    where each notebook's settings cell finds them.

    Args:
        in_place: store the outputs in the committed notebooks as well, which otherwise stay as
            they are: for a change of theirs, on the smoke preset.

    Raises:
        NbtrackError: a cell failed; the copy up to there is kept.
    """
    folder = runs_folder() / "notebooks" / preset
    paths = sorted(NOTEBOOKS.glob("[0-9A]*_*.ipynb"))
    pages = []
    with _environment(NBTRACK_PRESET=preset, **_overrides(config_file, settings)):
        for path in paths:
            start = time.perf_counter()
            notebook = execute_notebook(path, folder)
            if in_place:
                write_text_atomic(path, nbformat.writes(notebook) + "\n")
            pages.append(folder / f"{path.stem}.html")
            write_text_atomic(pages[-1], HTMLExporter().from_notebook_node(notebook)[0])
            tqdm.write(f"{pages[-1]}: {time.perf_counter() - start:.0f} s")
    return pages


def execute_notebook(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Run one notebook in a fresh kernel, with a bar over its cells; the copy goes to `folder`.

    Raises:
        NbtrackError: a cell failed; names it, with the error's last line.
    """
    notebook = nbformat.read(path, as_version=4)
    total = sum(cell.cell_type == "code" for cell in notebook.cells)
    with tqdm(total=total, desc=path.stem, unit="cell") as bar:
        client = NotebookClient(
            notebook, timeout=None, kernel_name="python3", record_timing=False,
            resources={"metadata": {"path": str(path.parent)}},
            on_cell_executed=lambda **_: bar.update(),
        )  # fmt: skip
        try:
            client.execute()
        except CellExecutionError as error:
            raise NbtrackError(
                f"{path.name} failed with {error.ename}: {error.evalue}; see the last cell of "
                f"{folder / path.name}, mend what it names and run again"
            ) from None
        finally:
            write_text_atomic(folder / path.name, nbformat.writes(notebook))
    return notebook


def _overrides(config_file: Path | None, settings: tuple[str, ...]) -> dict[str, str]:
    overrides = {"NBTRACK_CONFIG": str(config_file.resolve())} if config_file else {}
    if settings:
        already = os.environ.get("NBTRACK_SET", "")
        overrides["NBTRACK_SET"] = f"{already} {shlex.join(settings)}".strip()
    return overrides


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Environment variables for the kernels that are started inside, put back afterwards."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
