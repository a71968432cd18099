"""The committed notebooks as files: complete runs of small cells, and nothing of one machine.

And 1 to 7 as who has the dataset runs them: the preset `paper`, and no known surface.
"""

import json
import re
from pathlib import Path

import pandas as pd
import pytest
from IPython.core.interactiveshell import InteractiveShell

from nbtrack.recordings.writer import write_sequence
from nbtrack.synthetic import build_room, room_frames, room_intrinsics

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/*.ipynb"))


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def cells(request):
    """Each committed notebook in turn; a cell's source is one text."""
    found = json.loads(request.param.read_text(encoding="utf-8"))["cells"]
    return [cell | {"source": "".join(cell["source"])} for cell in found]


def test_complete_and_small(request, cells) -> None:
    """Catches cells without a stored run, which strict checking would execute but not compare, and
    code that belongs in the package: long cells, functions, shell and magics. A4 is about code of
    one's own, and has classes."""
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not [o for cell in code for o in cell["outputs"] if o["output_type"] == "error"]
    is_own_code = request.node.callspec.id.startswith("A4")
    for source in (cell["source"] for cell in code if not is_own_code):
        assert source.count("\n") < 13, source
        assert not re.search(r"^\s*(def |class |[%!])", source, re.M), source


def test_progress_is_not_compared(cells) -> None:
    """Catches a stored progress bar in a cell whose output is compared: where an earlier notebook
    made the map already, no bar appears."""
    for cell in cells:
        shown = [output.get("data", {}).get("text/plain", "") for output in cell.get("outputs", [])]
        if any("%|" in "".join(text) for text in shown):
            assert "nbval-ignore-output" in cell["metadata"].get("tags", []), cell["source"]


def test_nothing_of_one_machine(cells) -> None:
    """Catches absolute paths that readers would take for their own, and an end without text."""
    assert cells[0]["cell_type"] == cells[-1]["cell_type"] == "markdown"
    for cell in cells:
        outputs = cell.get("outputs", [])
        shown = [(o.get("text"), o.get("data", {}).get("text/plain")) for o in outputs]
        found = re.search(r"/(home|root|tmp|work|Users)/", f"{cell['source']} {shown}")
        assert not found, cell["source"]


# Numbers in the prose of the notebooks that judge, which no cell of theirs shows, and their source.
FACTS = {*pd.read_csv(Path(__file__).parent / "data/prose_numbers.csv", dtype=str)["number"]}
NUMBER = r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?![\w.]*\d)"


def test_numbers_in_prose_are_computed(request, cells) -> None:
    """Catches a sentence whose number is no longer what the cells of its notebook hold or print:
    each with a decimal, or of two digits and more, is that of a cell, rounded, or one in m that
    the sentence has in cm or mm."""
    if request.node.callspec.id[:2] not in ("05", "06", "07", "A1", "A2", "A3", "A5"):
        pytest.skip("what this notebook says is computed by hand in its cells")
    shown = ""
    for cell in cells:
        if cell["cell_type"] == "code":
            shown += cell["source"]
            for output in cell["outputs"]:
                shown += f" {output.get('text')} {output.get('data', {}).get('text/plain')}"
    known = [float(text.replace(",", "")) for text in re.findall(r"\d[\d,]*(?:\.\d+)?", shown)]
    prose = "\n".join(cell["source"] for cell in cells if cell["cell_type"] == "markdown")
    other = r"\*\*Time\.\*\*[^\n]*|\$\$.*?\$\$|\$.*?\$|`[^`]*`|\]\([^)]*\)|^#[^\n]*$|et al\. \d{4}"
    rounded = {
        digits: {round(factor * number, digits) for number in known for factor in (1, 100, 1000)}
        for digits in range(4)
    }
    unknown = []
    for text in re.findall(NUMBER, re.sub(other, "", prose, flags=re.S | re.M)):
        is_shown = float(text.replace(",", "")) in rounded[len(text.partition(".")[2])]
        if not (len(text) == 1 or is_shown or text in FACTS):
            unknown.append(text)
    assert not unknown


NUMBERED = [path for path in NOTEBOOKS if path.name.startswith("0")]
SCENES = {"kitchen": "living_room", "whiteroom": "office"}  # what they show is a room of ours
SIZE = 96, 72


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two of the dataset's scenes in its layout, and beside them what the notebooks leave."""
    folder = tmp_path_factory.mktemp("dataset")
    for name, room in SCENES.items():
        frames = room_frames(build_room(room), 60, *SIZE, seed=0)
        write_sequence(folder / name, room_intrinsics(*SIZE), frames)
    return folder


@pytest.mark.usefixtures("unchecked")
@pytest.mark.filterwarnings("ignore")  # claims found in our rooms are warnings here
@pytest.mark.parametrize("notebook", NUMBERED, ids=lambda path: path.stem)
def test_every_cell_runs(notebook: Path, folder: Path, monkeypatch, capsys) -> None:
    """Catches cells that ask of a recording what is known of synthetic rooms alone, as its surface
    or so many frames, and tables that do not know the dataset's scenes."""
    monkeypatch.setenv("NBTRACK_DATA", str(folder))
    monkeypatch.setenv("NBTRACK_RUNS", str(folder / "runs"))
    monkeypatch.setenv("NBTRACK_PRESET", "paper")
    monkeypatch.setenv("NBTRACK_CONFIG", str(Path(__file__).parent / "data/notebooks.toml"))
    monkeypatch.chdir(notebook.parent)
    shell = InteractiveShell()
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code" and "skip-execution" not in cell["metadata"].get("tags", []):
            shell.run_cell("".join(cell["source"])).raise_error()
