"""Run the numbered notebooks without a browser and keep executed and HTML copies."""

import importlib.util
import os
import shlex
import time
from argparse import Namespace
from pathlib import Path

from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.files import project_folder, runs_folder, write_atomic
from nbtrack.core.progress import ProgressBar
from nbtrack.experiments.commands import preset_of


def notebooks_command(options: Namespace) -> None:
    """Execute every notebook in order, as `jupyter nbconvert --execute`.

    Copies, executed and HTML, go to `runs/notebooks/<preset>/`. Settings reach the kernels through
    the environment, where each notebook's settings cell finds them. Raises MissingError without
    notebooks or Jupyter, NbtrackError if a cell failed; the copy up to there is kept.
    """
    preset = preset_of(options).name  # a wrong setting is refused before the first kernel starts
    if any(importlib.util.find_spec(name) is None for name in ("nbconvert", "ipykernel")):
        raise MissingError("notebooks need Jupyter: pip install 'nbtrack[notebooks]'")
    paths = sorted((project_folder() / "notebooks").glob("[0-9A]*_*.ipynb"))
    if not paths:
        raise MissingError(f"no notebooks in {project_folder()}: run the command in a checkout")
    before = os.environ.get("NBTRACK_SET", "")
    os.environ |= {
        "NBTRACK_PRESET": preset,
        "NBTRACK_SET": f"{before} {shlex.join(options.settings)}".strip(),
        **({"NBTRACK_CONFIG": str(options.config.resolve())} if options.config else {}),
    }
    with ProgressBar("notebooks", len(paths)) as bar:
        for done, path in enumerate(paths):
            bar.move_to(done, path.stem)
            _run_notebook(path, runs_folder() / "notebooks" / preset)
        bar.move_to(len(paths))


def _run_notebook(path: Path, folder: Path) -> None:
    """Run one notebook in a fresh kernel; its copies go to the folder."""
    import nbformat
    from nbconvert import HTMLExporter
    from nbconvert.preprocessors import CellExecutionError, ExecutePreprocessor

    notebook, page, start = nbformat.read(path, 4), folder / f"{path.stem}.html", time.monotonic()
    run = ExecutePreprocessor(timeout=None, kernel_name="python3", record_timing=False)
    try:
        run.preprocess(notebook, {"metadata": {"path": str(path.parent)}})
    except CellExecutionError as error:
        raise NbtrackError(
            f"{path.name} failed with {error.ename}: {error.evalue}; see the last cell of "
            f"{folder / path.name}, mend what it names and run again"
        ) from None
    finally:
        write_atomic(folder / path.name, nbformat.writes(notebook) + "\n")
    write_atomic(page, HTMLExporter().from_notebook_node(notebook)[0])
    print(f"{page}: {time.monotonic() - start:.0f} s")
