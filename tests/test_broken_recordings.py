"""Broken recordings, a fault of each class: one clear line, never a traceback or a guess.

And texts of every format with anything in them, of which some that can be read are also checked:
absurd numbers must not break the check either. `NBTRACK_FUZZ_EXAMPLES` sets how many are tried
(default 100).
"""

import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
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


def without(pattern: str) -> Damage:
    return lambda folder: [path.unlink() for path in list(folder.glob(pattern))]


def renamed(name: str, to: str) -> Damage:
    return lambda folder: (folder / name).rename(folder / to)


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda folder: cv2.imwrite(str(folder / name), pixels)


def line(name: str, number: int, *contents: str) -> Damage:
    """Replace a line, counted from 0, by others or by none."""

    def change(content: bytes) -> bytes:
        lines = content.decode().splitlines()
        return "\n".join([*lines[:number], *contents, *lines[number + 1 :], ""]).encode()

    return changed(name, change)


def camera(**values: object) -> Damage:
    return lambda folder: change_camera(folder, **values)


def toml(content: str) -> Damage:
    return text("sequence.toml", content)


def flipped(content: bytes) -> bytes:
    return content[:99] + bytes([content[99] ^ 1]) + content[100:]


def giant_png() -> bytes:
    """A PNG whose header promises 60,000 x 60,000 pixels, whose checksums are right."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 16, 0, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(bytes(99))), (b"IEND", b"")
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


SKEWED = "1 0.5 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
FAR = "1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1"
ROW = "1305031102.675 0 0 0 0 0 0"
K = "intrinsic/intrinsic_depth.txt"
DEPTH_1, IMAGE_1 = "depth_filtered/depth1.png", "images/img1.png"

# What the message must say; None where the recording can be read all the same.
BROKEN: dict[str, dict[str, tuple[Damage, str | None]]] = {
    "tum": {
        "no list": (without("rgb.txt"), "no colour images .*TUM RGB-D needs rgb.txt"),
        "empty list": (text("depth.txt", "# nothing\n"), "depth.txt is empty: write it anew"),
        "no timestamp": (line("rgb.txt", 1, "rgb/a.png"), "every line holds 'timestamp file'"),
        "file not there": (line("depth.txt", 2, "1305031102.2 no.png"), "depth.txt names .*no.png"),
        "other clock": (text("depth.txt", "1.0 depth/odd.png\n"), "within 0.02 s; both"),
        "7 columns": (line("groundtruth.txt", 3, ROW), "readable table .* from 8 to 7"),
        "long quaternion": (line("groundtruth.txt", 3, ROW + " 2"), "pose 1 .* norm 2:"),
        "NaN timestamp": (line("groundtruth.txt", 3, "nan 0 0 0 0 0 0 1"), "pose 1 .* time nan"),
        "5 numbers": (text("calibration.txt", "1 2 3 4 5"), "readable table .*there are 5"),
        "not used": (text("rgb/odd.png", "no image"), None),
    },
    "replica": {
        "no rotation": (line("traj.txt", 1, SKEWED), "traj.txt frame 1 is no rigid transform"),
        "out of this world": (line("traj.txt", 1, FAR), "frame 1 is no .*1e.300.* t up to 1e.07"),
        "camera is a list": (text("../cam_params.json", "[1, 2]"), "readable JSON .*list"),
        "deep JSON": (text("../cam_params.json", "[" * 100_000), "readable JSON file"),
    },
    "7scenes": {
        "pose missing": (without("frame-000002.pose.txt"), "6 .* 5 .txt .*: frame-000002.color"),
        "3 rows": (line("frame-000001.pose.txt", 3), None),  # 3x4: as good as 4x4
    },
    "scannet": {
        "one NaN": (text(K, "5 nan 5 5"), r"camera matrix .*\[0.0, nan, 5.0\]"),
        "skew": (text(K, "5 1 1\n0 5 1\n0 0 1\n"), r"camera matrix \[\[5.0, 1.0, 1.0\]"),
        "all poses lost": (changed("pose/*", lambda _: 4 * b"-inf -inf -inf -inf\n"), "0 of these"),
    },
    "plain": {
        "unknown key": (toml("depth_scal = 1000\n"), "unknown config key 'depth_scal': did"),
        "no TOML": (toml("depth_scale 1000\n"), "sequence.toml .*readable TOML"),
        "scale zero": (toml("depth_scale = 0\n"), "depth_scale = 0.0: it must be 1e-08 to 1e.08"),
        "axes": (toml('camera_axes = "up up up"\n'), "camera_axes = 'up up up': write 'opencv'"),
        "format": (toml('format = "tumm"\n'), "unknown format 'tumm': did you mean 'tum'"),
        "wrong scale": (toml("depth_scale = 1\n"), "1 depth values a metre: at most 65.535 m"),
        "no fx": (camera(fx=None), r"the camera matrix \[\[nan"),
        "fx a word": (camera(fx="525"), "fx is '525'.*: write finite"),
        "fx huge": (camera(fx=10**400), "fx is '1000.*: write finite"),
        "width broken": (camera(width=47.5), "width is '47.5'.* whole pixels"),
        "no height": (camera(height=None), "'height'.*: write .* both or none"),
        "proportions": (camera(height=48), "is 48x36 but .* is for 48x48"),
        "distortion": (camera(distortion=[1, 2, 3]), r"distortion is '\[1, 2, 3\]'"),
        "another lens": (camera(k1=-0.2, model="equidistant"), "model is 'equidistant', which is"),
        "another camera": (camera(cx=100.0), r"cx, cy then at \(100, \d+\): images"),
        "no poses": (without("trajectory.txt"), "0 of these .*trajectory.txt or poses.txt"),
        "two pose files": (text("poses.txt", "1 2 3"), "keep one, or choose by `data convert"),
        "decimal commas": (text("trajectory.txt", "0,5 0 0 0 0 0 0 1\n"), "points, not commas"),
    },
    "neural_rgbd": {
        "two rows": (text("intrinsics.txt", "5 0 1\n0 5 1\n"), "intrinsics.txt holds 6 numbers"),
        "tiny focal": (text("focal.txt", "1e-300"), r"focal.txt gives .* matrix \[\[1e-300"),
        "binary poses": (text("poses.txt", bytes(range(256))), "poses.txt .*table .*: every line"),
        "folder missing": (shutil.rmtree, "no folder .*recording"),
        "3 images, 2 depths": (without("depth_filtered/depth2.png"), "6 images but .* has 5 .png"),
        "PGM": (renamed("depth_filtered", "pgm"), r"no depth maps \(PNG of 16 bits\) in"),
        "depth of another size": (image(DEPTH_1, np.ones((18, 24), np.uint16)), r"\(18, 24\)"),
        "8-bit depth": (image(DEPTH_1, np.ones((36, 48), np.uint8)), "depth1.png is uint8"),
        "middle cut out": (changed(IMAGE_1, lambda c: c[:-999] + c[-12:]), "img1.png .*readable"),
        "one bit flipped": (changed(DEPTH_1, flipped), "depth1.png .*readable"),
        "giant depth": (text(DEPTH_1, giant_png()), "depth1.png .*readable"),
        "a row too few": (line("poses.txt", 23), "poses.txt has 23 rows"),
        "mirrored pose": (line("poses.txt", 0, "-9 0 0 0"), "poses.txt frame 0 is no"),
    },
}  # fmt: skip
CASES = [(format, case) for format, cases in BROKEN.items() for case in cases]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Callable[[str, Path], Path]:
    """Copies of whole recordings, written once."""
    base = tmp_path_factory.mktemp("whole")
    for format in WRITERS:
        write_recording(format, base / format / "recording")
    return lambda format, to: shutil.copytree(base / format, to) / "recording"


@pytest.mark.parametrize(("format", "case"), CASES)
def test_one_line(whole, tmp_path: Path, capfd, format: str, case: str) -> None:
    """Catches other errors, garbage read in silence, and messages without file, limit or advice."""
    damage, expected = BROKEN[format][case]
    folder = whole(format, tmp_path / "copy")
    damage(folder)
    named = None if case.startswith("format") else format
    if expected is None:
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


EXAMPLES = int(os.environ.get("NBTRACK_FUZZ_EXAMPLES", "100"))
WORDS = (
    "nan", "inf", "-inf", "1e400", "-1e308", "1e200", "1e7", "-0.5", "[" * 100_000,
    "1e-320", "0", "-0", "1", "1_0", "0x1p3", "٣", "½", "true", "null", "NaN", "1" * 400,
    "a" * 5000, "\0", "#", ",", '"', "{", "=", "..", "/", "rgb", "\ufeff", "\u2028", "wxyz",
    "plain", "depth_scale", "[x]", "-5", "1e9", "[]", '"ray"', '"up up up"', '"tum"', "1979-05-27",
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


@st.composite
def nearly_as(draw: Callable, original: bytes) -> bytes:
    """A text that is nearly right: words replaced, lines dropped, doubled, cut or joined."""
    lines = original.decode().splitlines()
    for _ in range(draw(st.integers(1, 4)) if lines else 0):
        number = draw(st.integers(0, len(lines) - 1))
        line = lines[number]
        # Mostly a number: what surrounds it decides little.
        spans = [match.span() for match in re.finditer(r"-?[\d.e+-]+|\S+", line)]
        start, stop = draw(st.sampled_from(spans or [(0, 0)]))
        any_word = st.sampled_from(WORDS)
        word = draw(any_word | any_word | any_word | st.text(max_size=8) | st.floats().map(str))
        replaced, cut = [line[:start] + word + line[stop:]], [line[:start]]
        others = ([], [line, line], cut, [f"{line} {lines[0]}"])
        lines[number : number + 1] = draw(st.sampled_from((replaced,) * 6 + others))
        lines = lines or [""]
    end = draw(st.sampled_from(("\n", "\r\n", "\r", "\n\n")))
    return end.join(lines).encode("utf-8", "surrogatepass")


@settings(
    max_examples=EXAMPLES, deadline=None, derandomize=EXAMPLES <= 100, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@given(data=st.data())
def test_only_our_own_errors(tmp_path_factory, data) -> None:
    """Catches any other exception or warning, and poses or pixels that are no numbers."""
    format = data.draw(st.sampled_from([*WRITERS]))
    folder, texts = small_recording(format, tmp_path_factory.getbasetemp() / "fuzz")
    path = data.draw(st.sampled_from(texts))
    original = path.read_bytes() if path.is_file() else None
    anything = st.binary(max_size=200), st.text(max_size=200).map(str.encode)
    nearly = nearly_as(original or (DECLARED if path.suffix == ".toml" else "1 2 3 4").encode())
    path.write_bytes(data.draw(st.one_of(*anything, nearly, nearly, nearly)))
    message = "nothing wrong"
    try:
        sequence = read_sequence(folder, slice(0, 1), format=format)
        assert np.isfinite(sequence.T_world_camera).all()
        assert np.isfinite([sequence.intrinsics.fx, sequence.intrinsics.cx]).all()
        if data.draw(st.integers(0, 19)) == 0:
            str(check_recording(open_recording(folder, format)))
    except NbtrackError as error:
        message = str(error)
    finally:
        path.unlink()
        if original is not None:
            path.write_bytes(original)
    assert 0 < len(message) < 1000
