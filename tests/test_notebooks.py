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


def test_text_comes_before_code(notebook: nbformat.NotebookNode) -> None:
    """Catches a notebook that starts or ends without telling what it is about."""
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[-1].cell_type == "markdown"


def test_nothing_of_one_machine(notebook: nbformat.NotebookNode) -> None:
    """Catches absolute paths in code or outputs that readers would take for their own."""
    for cell in notebook.cells:
        assert not re.search(r"/(home|root|tmp|work|Users)/", cell.source), cell.source
        for output in cell.get("outputs", []):
            text = "".join(output.get("text", "")) + str(output.get("data", {}).get("text/plain"))
            assert not re.search(r"/(home|root|tmp|work|Users)/", text), text
