"""The Neural RGB-D layout as it is written: whole or not at all, and nothing lost."""

from pathlib import Path

import numpy as np
import pytest
from recordings import source, write_recording
from test_faults import assert_refused

from nbtrack.cli import main
from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.errors import DataError
from nbtrack.recordings.reading import read_sequence
from nbtrack.recordings.writer import write_sequence

CAMERA = Intrinsics(12, 8, 10.123456789012345, 10.123456789012345, 6.0, 4.0)
RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (8, 12, 3), dtype=np.uint8)
DEPTH = RNG.integers(0, 1 << 16, (8, 12), dtype=np.uint16)


def frames(number: int):
    for i in range(number):
        depths = {"depth": DEPTH, "depth_filtered": DEPTH + np.uint16(i)}
        yield COLOR + np.uint8(i), depths, source().poses[i]


def test_converter(tmp_path: Path, capsys) -> None:
    """Catches a focal length or a principal point that is dropped in silence where the layout
    cannot say it, a slice that is ignored, and a folder without frames."""
    camera = Intrinsics(48, 36, 43.0, 44.5, 25.25, 17.0)
    folder = write_recording("plain", tmp_path / "r", source()._replace(camera=camera))
    out, convert = tmp_path / "a/b/out", ["data", "convert", str(folder)]
    assert main([*convert, str(out), "--frames", "2:5"]) == 0
    assert "it is in intrinsics.txt" in capsys.readouterr().out
    assert not (out / "focal.txt").exists()
    assert read_sequence(out).intrinsics == camera
    assert np.array_equal(read_sequence(out).depths_mm, source().depths_mm[2:5])
    command = [*convert, str(tmp_path / "new"), "--frames", "9:"]
    assert_refused(tmp_path, capsys, command, "0 of the 6 frames")


def test_what_is_declared_is_converted(tmp_path: Path) -> None:
    """Catches a unit of the map that a conversion loses, also that of a scene of the dataset."""
    own, known = (write_recording("neural_rgbd", tmp_path / n) for n in ("own", "breakfast_room"))
    (own / "sequence.toml").write_text("metres_per_unit = 1.25\n")
    for folder, unit in ((own, 1.25), (known, 2.5)):
        assert main(["data", "convert", str(folder), str(tmp_path / f"{unit}")]) == 0
        assert read_sequence(tmp_path / f"{unit}").declared_unit == unit


def test_interrupted_writer_leaves_nothing_behind(tmp_path: Path) -> None:
    """Catches a half-written scene that a later run would take for a whole one, and a folder that
    is overwritten."""

    def interrupted():
        yield from frames(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path / "scene", CAMERA, interrupted())
    with pytest.raises(DataError, match=r"exists: choose another"):
        write_sequence(tmp_path, CAMERA, frames(1))
    assert list(tmp_path.iterdir()) == []


def test_two_writers_of_one_scene(tmp_path: Path) -> None:
    """Catches commands that spoil each other's files of one room: the first to finish stands."""

    def late():
        yield from frames(1)
        write_sequence(tmp_path / "room", CAMERA, frames(2))

    with pytest.raises(OSError, match="not empty"):
        write_sequence(tmp_path / "room", CAMERA, late())
    assert len(read_sequence(tmp_path / "room")) == 2
