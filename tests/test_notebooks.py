"""The committed notebooks as files: complete runs of small cells, and nothing of one machine."""

import re
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/*.ipynb"))


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request: pytest.FixtureRequest) -> nbformat.NotebookNode:
    """Each committed notebook in turn."""
    return nbformat.read(request.param, as_version=4)


def test_there_are_five() -> None:
    """Catches a lost notebook."""
    assert [path.stem for path in NOTEBOOKS][:5] == [
        "01_map_imap", "02_map_neus", "03_track_vr", "04_track_sdf", "05_tables"
    ]  # fmt: skip


def test_run_in_order_without_errors(notebook: nbformat.NotebookNode) -> None:
    """Catches cells without a stored run, which strict checking would execute but not compare."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error"]


def test_cells_are_small(notebook: nbformat.NotebookNode) -> None:
    """Catches code that belongs in the package: long cells, functions, shell and magics."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.source.count("\n") < 13, cell.source
            assert not re.search(r"^\s*(def |class |[%!])", cell.source, re.M), cell.source


def test_nothing_of_one_machine(notebook: nbformat.NotebookNode) -> None:
    """Catches absolute paths that readers would take for their own, and an end without text."""
    assert notebook.cells[0].cell_type == notebook.cells[-1].cell_type == "markdown"
    for cell in notebook.cells:
        outputs = cell.get("outputs", [])
        shown = [(o.get("text"), o.get("data", {}).get("text/plain")) for o in outputs]
        assert not re.search(r"/(home|root|tmp|work|Users)/", f"{cell.source} {shown}"), cell.source
