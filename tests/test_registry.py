"""What is known by name: loaded when it is asked for, whichever door a user comes in by."""

import subprocess
import sys
from pathlib import Path

import pytest
from test_mapping import finished_wall, wall_sequence

from nbtrack.beyond.correction import correct_map
from nbtrack.fields import FIELDS, field_class
from nbtrack.machinery.errors import ConfigError
from nbtrack.mapping.files import MAP_FILE, write_map

DOORS = """
import sys
from nbtrack import FIELDS, METHODS, Frame, make_tracker, read_sequence
assert {*FIELDS} > {"neus", "neus_plus"} and {*METHODS} > {"sdf", "corrected"}
assert not {"numba", "skimage", "nbtrack.experiments"} & {*sys.modules}
"""
READ = "import sys; from nbtrack.mapping.files import read_map; print(read_map(sys.argv[1]).key)"


def test_what_the_doors_load(tmp_path: Path) -> None:
    """Catches a single frame or the paper's part that loads numba, and a corrected map that only a
    program which has imported all of the package can read."""
    corrected = correct_map(finished_wall(), wall_sequence(), 0.2)
    write_map(tmp_path / MAP_FILE, corrected)
    for script, printed in ((DOORS, ""), (READ, f"{corrected.key}\n")):
        command = [sys.executable, "-c", script, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.stdout, done.stderr) == (printed, "")


def test_an_entry_as_a_text(monkeypatch) -> None:
    """Catches a class of a user's that cannot be named as entry points are, and a traceback where
    the name is wrong."""
    monkeypatch.setitem(FIELDS, "neus", "nbtrack.fields.neus:NeuSField")
    assert field_class("neus").name == "neus"
    monkeypatch.setitem(FIELDS, "neus", "nbtrack.fields.neus:NeusField")
    with pytest.raises(ConfigError, match="'neus' cannot be loaded from nbtrack"):
        field_class("neus")
