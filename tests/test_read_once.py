"""One command reads a file once, and decodes it once, whoever needs it."""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL.PngImagePlugin import PngImageFile
from recordings import N_FRAMES, write_recording
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.recordings.images import images_of
from nbtrack.recordings.reading import read_frames
from nbtrack.recordings.recording import open_recording

_opened: Counter[str] = Counter()
sys.addaudithook(lambda event, about: event == "open" and _opened.update([str(about[0])]))


def test_track_reads_a_file_once(tmp_path: Path, monkeypatch) -> None:
    """Catches a check, an estimate of the unit, a digest, a map, a run or a picture that opens or
    decodes for itself what another part of the command has read."""
    folder = write_recording("neural_rgbd", tmp_path / "room")
    decoded, load_end = [], PngImageFile.load_end
    monkeypatch.setattr(
        PngImageFile, "load_end", lambda image: decoded.append(image.mode) or load_end(image)
    )
    _opened.clear()
    words = ["--field", "neus", "--tracker", "sdf", "--steps", "2", "--out", str(tmp_path / "run")]
    assert main(["track", str(folder), *words, *tiny_words()]) == 0
    files = [*folder.glob("images/*.png"), *folder.glob("depth_filtered/*.png")]
    assert {_opened[str(file)] for file in files} == {1}
    assert decoded.count("I;16") == N_FRAMES
    assert len(decoded) == len(files) == 2 * N_FRAMES


@pytest.mark.parametrize("format", ["neural_rgbd", "tum"])  # depth in mm, and in another unit
def test_shared_frames_are_those_read_anew(format: str, tmp_path: Path) -> None:
    """Catches frames that change places where others were read before, and copies of what a slice
    could view: twice the memory."""
    recording = open_recording(write_recording(format, tmp_path / "room"))
    whole = read_frames(open_recording(recording.folder), np.arange(N_FRAMES))
    for ids in ([4], [1, 2], [0, 2, 4], [0, 3, 4], [*range(N_FRAMES)], [5, 1]):
        some = read_frames(recording, np.array(ids), needs_poses=False)
        assert (some.colors == whole.colors[ids]).all()
        assert (some.depths_mm == whole.depths_mm[ids]).all()
    kept, _ = images_of(recording).kept(np.arange(N_FRAMES))
    assert np.shares_memory(read_frames(recording, slice(1, None, 2)).colors, kept)
