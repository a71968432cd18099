"""Broken recordings, a fault of each class: one clear line, never a traceback or a guess.

And texts of every format with anything in them, of which some that can be read are also checked:
absurd numbers must not break the check either. `NBTRACK_FUZZ_EXAMPLES` sets how many are tried
(default 300).
"""

import json
import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random

import cv2
import numpy as np
import pandas as pd
import pytest
from recordings import N_FRAMES, WRITERS, change_camera, source, write_recording

from nbtrack.checks.check import check_recording
from nbtrack.machinery.errors import NbtrackError
from nbtrack.recordings.reading import read_sequence
from nbtrack.recordings.recording import open_recording

Damage = Callable[[Path], object]


def changed(pattern: str, change: Callable[[bytes], bytes]) -> Damage:
    """Change the content of all files that a pattern names."""
    return lambda folder: [p.write_bytes(change(p.read_bytes())) for p in folder.glob(pattern)]


def text(name: str, content: str | bytes) -> Damage:
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(raw)


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda folder: cv2.imwrite(str(folder / name), pixels)


def as_listed(file: str, done: str, content: str) -> Damage:
    """What a row of the table below says is done to a file."""
    content = content.replace("\\n", "\n")
    if done == "write":
        return text(file, content)
    if done == "delete":
        return lambda folder: (folder / file).unlink()
    if done == "set":
        return lambda folder: change_camera(folder, **json.loads(content))
    number = int(done.removeprefix("line "))  # from 0

    def other_line(whole: bytes) -> bytes:
        lines = whole.decode().splitlines()
        lines[number : number + 1] = [content] if content else []
        return "\n".join([*lines, ""]).encode()

    return changed(file, other_line)


def flipped(content: bytes) -> bytes:
    return content[:99] + bytes([content[99] ^ 1]) + content[100:]


def giant(png: bytes) -> bytes:
    """With a header that promises 60,000 x 60,000 pixels, whose checksum is right."""
    header = b"IHDR" + struct.pack(">II", 60_000, 60_000) + png[24:29]
    return png[:12] + header + struct.pack(">I", zlib.crc32(header)) + png[33:]


DEPTHS = "depth_filtered"
DEPTH_1, IMAGE_1 = f"{DEPTHS}/depth1.png", "images/img1.png"
# What the message must say; empty where the recording can be read all the same.
BROKEN: dict[tuple[str, str], tuple[Damage, str]] = {
    ("replica", "deep JSON"): (text("../cam_params.json", "[" * 100_000), "readable JSON file"),
    ("scannet", "all lost"): (changed("pose/*", lambda _: 4 * b"nan nan nan nan\n"), "0 of th"),
    ("plain", "fx huge"): (lambda f: change_camera(f, fx=10**400), "fx is '1000.*: write finite"),
    ("neural_rgbd", "binary"): (text("poses.txt", bytes(range(256))), "poses.txt .*table .*:"),
    ("neural_rgbd", "folder missing"): (shutil.rmtree, "no folder .*recording"),
    ("neural_rgbd", "PGM"): (lambda f: (f / DEPTHS).rename(f / "pgm"), r"no depth maps \(PNG"),
    ("neural_rgbd", "size"): (image(DEPTH_1, np.ones((18, 24), np.uint16)), r"\(18, 24\)"),
    ("neural_rgbd", "8 bits"): (image(DEPTH_1, np.ones((36, 48), np.uint8)), "depth1.png is uint8"),
    ("neural_rgbd", "16 bits"): (image(IMAGE_1, np.ones((36, 48), np.uint16)), "img1.png is uint1"),
    ("neural_rgbd", "cut"): (changed(IMAGE_1, lambda c: c[:-999] + c[-12:]), "img1.png .*readable"),
    ("neural_rgbd", "a bit flipped"): (changed(DEPTH_1, flipped), "depth1.png .*readable"),
    ("neural_rgbd", "giant depth"): (changed(DEPTH_1, giant), "depth1.png .*readable"),
}  # fmt: skip
LISTED = pd.read_csv(Path(__file__).parent / "data/broken_recordings.csv", keep_default_na=False)
for format, case, *damage, says in LISTED.itertuples(index=False):
    BROKEN[format, case] = (as_listed(*damage), says)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Callable[[str, Path], Path]:
    """Copies of whole recordings, written once."""
    base = tmp_path_factory.mktemp("whole")
    for format in WRITERS:
        write_recording(format, base / format / "recording")
    return lambda format, to: shutil.copytree(base / format, to) / "recording"


@pytest.mark.parametrize(("format", "case"), BROKEN)
def test_one_line(whole, tmp_path: Path, capfd, format: str, case: str) -> None:
    """Catches other errors, garbage read in silence, and messages without file, limit or advice."""
    damage, expected = BROKEN[format, case]
    folder = whole(format, tmp_path / "copy")
    damage(folder)
    named = None if case.startswith("format") else format
    if not expected:
        read_sequence(folder, format=named)
    else:
        with pytest.raises(NbtrackError, match=expected) as caught:
            read_sequence(folder, format=named)
        message = str(caught.value)
        assert "\n" not in message
        assert len(message) < 690
        assert ": " in message  # what was found: what is allowed
    assert capfd.readouterr() == ("", "")


def test_files_of_the_system(tmp_path: Path) -> None:
    """Catches hidden files that are taken for images."""
    folder = write_recording("replica", tmp_path / "r")
    for name in (".DS_Store", "._frame000001.jpg"):
        (folder / "results" / name).write_bytes(b"no image")
    assert len(open_recording(folder)) == N_FRAMES


WORDS = (
    "nan", "inf", "-inf", "1e400", "-1e308", "1e200", "1e7", "-0.5", "[" * 100_000,
    "1e-320", "0", "-0", "1", "1_0", "0x1p3", "٣", "½", "true", "null", "NaN", "1" * 400,
    "a" * 5000, "\0", "#", ",", '"', "{", "=", "..", "/", "rgb", "\ufeff", "\u2028", "wxyz",
    "plain", "depth_scale", "[x]", "", "\n", "\r", "\ud800", "-5", "1e9", "[]",
    '"ray"', '"up up up"', '"tum"', "1979-05-27",
)  # fmt: skip
DECLARED = 'format = "plain"\ndepth_scale = 1000\nno_depth = 65535\ndepth_along = "axis"\n'
DECLARED += 'camera_axes = "right up forward"\nposes = "world-to-camera"\nquaternion = "wxyz"\n'


@cache
def small_recording(format: str, base: Path) -> tuple[Path, list[Path]]:
    """Its folder, and its texts."""
    folder = write_recording(format, base / format / "r", source(n_frames=2))
    images = (".png", ".jpg", ".depth")
    texts = [path for path in folder.parent.rglob("*") if path.suffix not in ("", *images)]
    return folder, [*sorted(texts), folder / "metadata", folder / "sequence.toml"]


def nearly_as(original: str, random: Random) -> str:
    """A text that is nearly right: of its words, blanks and numbers some are replaced."""
    parts = re.split(r"(-?[\d.e+-]+|\s+)", original)
    for _ in range(random.randint(1, 4)):
        parts[random.randrange(len(parts))] = random.choice(WORDS)
    return "".join(parts)


def test_only_our_own_errors(tmp_path: Path) -> None:
    """Catches any other exception or warning, and poses or pixels that are no numbers."""
    random = Random(0)
    for number in range(int(os.environ.get("NBTRACK_FUZZ_EXAMPLES", "300"))):
        format = random.choice([*WRITERS])
        folder, texts = small_recording(format, tmp_path)
        path = random.choice(texts)
        original = path.read_text() if path.is_file() else None
        text = nearly_as(original or DECLARED, random)
        path.write_text(text, "utf-8", "surrogatepass")
        message = "nothing wrong"
        try:
            sequence = read_sequence(folder, slice(0, 1), format=format)
            assert np.isfinite(sequence.T_world_camera).all()
            assert np.isfinite([sequence.intrinsics.fx, sequence.intrinsics.cx]).all()
            if number % 20 == 0:
                str(check_recording(open_recording(folder, format)))
        except NbtrackError as error:
            message = str(error)
        path.unlink()
        if original is not None:
            path.write_text(original)
        assert 0 < len(message) < 1000, (path, text)
