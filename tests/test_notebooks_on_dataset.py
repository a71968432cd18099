"""Notebooks 1 to 7 as who has the dataset runs them: the preset `paper`, and no known surface."""

import json
from pathlib import Path

import pytest
from IPython.core.interactiveshell import InteractiveShell

from nbtrack.recordings.writer import write_sequence
from nbtrack.synthetic import build_room, room_frames, room_intrinsics

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/0*.ipynb"))
SCENES = {"kitchen": "living_room", "whiteroom": "office"}  # what they show is a room of ours
SIZE = 64, 48
SETTINGS = """
    mapping.imap.iterations=200 mapping.imap.n_rays=32 network.imap.width=32
    mapping.neus.iterations=100 mapping.neus.n_rays=32 network.neus.width=32
    mapping.neus_plus.iterations=60 mapping.neus_plus.n_rays=32
    mapping.neus_plus.n_surface_points=128 scenes.track_frames=20:26
    tracking.vr.n_pixels=16 tracking.sdf.n_pixels=64 tracking.lm.n_pixels=128
    tables.pixels.vr=[16] tables.pixels.sdf=[64]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two of the dataset's scenes in its layout, and beside them what the notebooks leave."""
    folder = tmp_path_factory.mktemp("dataset")
    for name, room in SCENES.items():
        frames = room_frames(build_room(room), 60, *SIZE, seed=0)
        write_sequence(folder / name, room_intrinsics(*SIZE), frames)
    return folder


@pytest.mark.filterwarnings("ignore")  # claims found in our rooms are warnings here
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(notebook: Path, folder: Path, monkeypatch, capsys) -> None:
    """Catches cells that ask of a recording what is known of synthetic rooms alone, as its surface
    or so many frames, and tables that do not know the dataset's scenes."""
    monkeypatch.setenv("NBTRACK_DATA", str(folder))
    monkeypatch.setenv("NBTRACK_RUNS", str(folder / "runs"))
    monkeypatch.setenv("NBTRACK_PRESET", "paper")
    monkeypatch.setenv("NBTRACK_SET", SETTINGS)
    monkeypatch.chdir(notebook.parent)
    shell = InteractiveShell()
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code" and "skip-execution" not in cell["metadata"].get("tags", []):
            shell.run_cell("".join(cell["source"])).raise_error()
