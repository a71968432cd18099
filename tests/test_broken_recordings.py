"""Broken recordings of every format: one clear line, never a traceback, a guess or chatter."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
import pytest
from recordings import N_FRAMES, WRITERS, write_recording

from nbtrack.cli import main
from nbtrack.core.errors import NbtrackError
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


def suffix(pattern: str, to: str) -> Damage:
    return lambda folder: [path.rename(path.with_suffix(to)) for path in folder.glob(pattern)]


def in_a_folder(folder: Path) -> None:
    """Everything lies one level deeper."""
    folder.rename(folder.parent / "inner")
    folder.mkdir()
    (folder.parent / "inner").rename(folder / "inner")


def cut(name: str) -> Damage:
    """Only the first half is left."""
    return changed(name, lambda content: content[: len(content) // 2])


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda folder: cv2.imwrite(str(folder / name), pixels)


def line(name: str, number: int, *contents: str) -> Damage:
    """Replace a line, counted from 0, by others or by none."""

    def change(content: bytes) -> bytes:
        lines = content.decode().splitlines()
        return "\n".join([*lines[:number], *contents, *lines[number + 1 :], ""]).encode()

    return changed(name, change)


def camera(name: str = "intrinsics.json", **values: object) -> Damage:
    """Change values of a JSON file's object, or of its `camera`; None drops a key."""

    def change(content: bytes) -> bytes:
        camera = json.loads(content)
        camera = {k: v for k, v in (camera.get("camera", camera) | values).items() if v is not None}
        return json.dumps({"camera": camera}).encode()

    return changed(name, change)


def toml(content: str) -> Damage:
    return text("sequence.toml", content)


def png(header: bytes) -> bytes:
    """A PNG of a header and too few pixels, whose checksums are right."""
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(bytes(99))), (b"IEND", b"")
    chunks = (struct.pack(">I", len(c)) + k + c + struct.pack(">I", crc32(k + c)) for k, c in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


BINARY = bytes(range(256))
GIANT = png(struct.pack(">IIBBBBB", 60_000, 60_000, 16, 0, 0, 0, 0))
EIGHT_BIT, SMALL = np.ones((36, 48), np.uint8), np.ones((18, 24), np.uint16)
THREE_CHANNELS = np.ones((36, 48, 3), np.uint16)
SKEWED = "1 0.5 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
FAR = "1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1"
ROW = "1305031102.675 0 0 0 0 0 0"
K = "intrinsic/intrinsic_depth.txt"
DEPTH_1 = "depth_filtered/depth1.png"
FLIPPED = changed(DEPTH_1, lambda c: c[:99] + bytes([c[99] ^ 1]) + c[100:])
MIDDLE_CUT_OUT = changed("images/img1.png", lambda c: c[: len(c) // 2] + c[-12:])

# What the message must say; None where the recording can be read all the same.
BROKEN: dict[str, dict[str, tuple[Damage, str | None]]] = {
    "tum": {
        "no list": (without("rgb.txt"), "no colour images .*TUM RGB-D needs rgb.txt"),
        "empty list": (text("depth.txt", "# nothing\n"), "depth.txt is empty: write it anew"),
        "no timestamp": (line("rgb.txt", 1, "rgb/a.png"), "every line holds 'timestamp file'"),
        "file not there": (line("depth.txt", 2, "1.0 depth/no.png"), "depth.txt names .*no.png"),
        "other clock": (text("depth.txt", "1.0 depth/odd.png\n"), "within 0.02 s .*: both"),
        "7 columns": (line("groundtruth.txt", 3, ROW), "readable table .* from 8 to 7"),
        "long quaternion": (line("groundtruth.txt", 3, ROW + " 2"), "pose 1 .* norm 2:"),
        "NaN timestamp": (line("groundtruth.txt", 3, "nan 0 0 0 0 0 0 1"), "pose 1 .* time nan"),
        "no calibration": (without("calibration.txt"), "no calibration in .*calibration.txt"),
        "5 numbers": (text("calibration.txt", "1 2 3 4 5"), "readable table .*there are 5"),
        "cut image": (cut("rgb/odd.png"), None),  # not used, hence no error
        "cut depth": (cut("depth/1305031102.186000.png"), "not a readable PNG"),
    },
    "replica": {
        "no rotation": (line("traj.txt", 1, SKEWED), "traj.txt frame 1 is no rigid transform"),
        "out of this world": (line("traj.txt", 1, FAR), "frame 1 is no .*1e.300.* t up to 1e.07"),
        "a pose less": (line("traj.txt", 1), "5 poses but there are 6 im.*; remove what is odd"),
        "camera is a list": (text("../cam_params.json", "[1, 2]"), "readable JSON .*list"),
        "deep JSON": (text("../cam_params.json", "[" * 100_000), "readable JSON file"),
        "depth is a JPEG": (image("results/depth000002.png", THREE_CHANNELS), "png is uint8 of"),
        "an image less": (without("results/frame000003.jpg"), "5 im.* 6 .*: depth000003.png"),
    },
    "7scenes": {
        "pose missing": (without("frame-000002.pose.txt"), "6 .* 5 .txt .*: frame-000002.color"),
        "3 rows": (line("frame-000001.pose.txt", 3), None),  # 3x4: as good as 4x4
        "2 rows": (text("frame-000001.pose.txt", "1 0 0 0\n0 1 0 0\n"), "has 2 rows: it needs"),
    },
    "scannet": {
        "zero focal": (text(K, "0 0 1 0\n0 0 1 0\n0 0 1 0\n0 0 0 1\n"), r"camera matrix \[\[0.0"),
        "one NaN": (text(K, "5 nan 5 5"), r"camera matrix .*\[0.0, nan, 5.0\]"),
        "skew": (text(K, "5 1 1\n0 5 1\n0 0 1\n"), r"camera matrix \[\[5.0, 1.0, 1.0\]"),
        "infinite centre": (text(K, "5 0 inf\n0 5 1\n0 0 1\n"), r"camera matrix .*, inf\]"),
        "all poses lost": (changed("pose/*", lambda _: 4 * b"-inf -inf -inf -inf\n"), "no pose in"),
        "pose of UTF-16": (text("pose/3.txt", "1 0 0 0\n".encode("utf-16")), "readable table"),
    },
    "plain": {
        "unknown key": (toml("depth_scal = 1000\n"), "unknown config key 'depth_scal': did"),
        "no TOML": (toml("depth_scale 1000\n"), "sequence.toml .*readable TOML"),
        "scale zero": (toml("depth_scale = 0\n"), "depth_scale = 0.0: it must be 1e-08 to 1e.08"),
        "scale text": (toml('depth_scale = "mm"\n'), "depth_scale = 'mm': it must be float"),
        "axes": (toml('camera_axes = "up up up"\n'), "camera_axes = 'up up up': write 'opencv'"),
        "direction": (toml('poses = "c2w"\n'), "poses = 'c2w': write 'camera-to-world' or 'world"),
        "format": (toml('format = "tumm"\n'), "unknown format 'tumm': did you mean 'tum'"),
        "wrong scale": (toml("depth_scale = 1\n"), "1 depth values a metre: at most 65.535 m"),
        "no fx": (camera(fx=None), r"the camera matrix \[\[nan"),
        "fx a word": (camera(fx="525"), "fx is '525': write 1 finite"),
        "fx huge": (camera(fx=10**400), "fx is '1000.*: write 1 finite"),
        "width broken": (camera(width=47.5), "width is '47.5': write 1 .* whole pixels"),
        "no height": (camera(height=None), "gives one side of the image: write"),
        "proportions": (camera(height=48), "is 48x36 but .* is for 48x48"),
        "distortion": (camera(distortion=[1, 2, 3]), r"distortion is '\[1, 2, 3\]': write 0 or 4"),
        "another lens": (camera(k1=-0.2, model="equidistant"), "model is 'equidistant', which is"),
        "another unit": (camera(focal_unit="mm"), "focal_unit is 'mm', which is not used"),
        "another camera": (camera(cx=100.0), r"cx, cy at \(100, \d+\), outside of .*of 48x36"),
        "no poses": (without("trajectory.txt"), "no poses in .*trajectory.txt or poses.txt"),
        "two pose files": (text("poses.txt", "1 2 3"), "keep one, or choose by `data convert"),
        "a line less": (text("trajectory.txt", "0.5001 0 0 0 0 0 0 1\n"), "has 1 poses but"),
        "decimal commas": (text("trajectory.txt", "0,5 0 0 0 0 0 0 1\n"), "points, not commas"),
    },
    "neural_rgbd": {
        "two rows": (text("intrinsics.txt", "5 0 1\n0 5 1\n"), "intrinsics.txt holds 6 numbers"),
        "tiny focal": (text("focal.txt", "1e-300"), r"focal.txt gives .* matrix \[\[1e-300"),
        "binary poses": (text("poses.txt", BINARY), "poses.txt .*table .*: every line"),
        "folder missing": (shutil.rmtree, "no folder .*recording"),
        "no images": (without("images/*"), "no colour images .*recording: .*needs images/"),
        "no depth folder": (renamed("depth_filtered", "depths"), "no depth maps .*red/. or dep"),
        "3 images, 2 depths": (without("depth_filtered/depth2.png"), "6 images but .* has 5 .png"),
        "other frame numbers": (renamed(DEPTH_1, "depth_filtered/depth7.png"), "img1.png, depth7"),
        "PGM": (suffix("depth_filtered/*", ".pgm"), r"no depth maps \(PNG of 16 bits\) in"),
        "format: one level too high": (in_a_folder, "is no recording: it needs the files of"),
        "depth of another size": (image(DEPTH_1, SMALL), r"depth1.png is .* of shape \(18, 24\)"),
        "8-bit depth": (image(DEPTH_1, EIGHT_BIT), "depth1.png is uint8"),
        "colour of another size": (image("images/img2.png", SMALL), r"img2.png is .*\(18, 24\)"),
        "colour cut in half": (cut("images/img1.png"), "img1.png .*readable"),
        "middle cut out": (MIDDLE_CUT_OUT, "img1.png .*readable"),
        "one bit flipped": (FLIPPED, "depth1.png .*readable"),
        "giant depth": (text(DEPTH_1, GIANT), "depth1.png .*readable"),
        "short header": (text("depth_filtered/depth0.png", png(bytes(4))), "depth0.png .*readable"),
        "text instead of an image": (text("images/img0.png", "version 1"), "img0.png .*readable"),
        "focal empty": (text("focal.txt", " \n"), "focal.txt is empty"),
        "focal negative": (text("focal.txt", "-525"), r"focal.txt gives the .*\[\[-525"),
        "focal text": (text("focal.txt", "five hundred"), "focal.txt .*table .*'five'"),
        "a row too few": (line("poses.txt", 23), "poses.txt has 23 rows"),
        "scaled pose": (line("poses.txt", 0, "2 0 0 0"), "poses.txt frame 0 is no rigid"),
        "mirrored pose": (line("poses.txt", 0, "-9 0 0 0"), "poses.txt frame 0 is no"),
    },
}  # fmt: skip
CASES = [(format, case) for format, cases in BROKEN.items() for case in cases]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Path], Path]:
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


@pytest.mark.parametrize("format", WRITERS)
def test_command(whole, tmp_path: Path, capfd, format: str) -> None:
    """Catches tracebacks of the command, and Windows line ends or marks taken for numbers."""
    folder = whole(format, tmp_path / "copy")
    for path in [*folder.rglob("*.txt"), *folder.parent.rglob("*.json")]:
        content = path.read_text().replace("\n", "\r\n")
        path.write_bytes(b"\xef\xbb\xbf" + content.encode())
    assert main(["data", "check", str(folder)]) == 0
    assert capfd.readouterr().err == ""
    toml("depth_scal = 1")(folder)
    assert main(["data", "check", str(folder)]) == 2
    error = capfd.readouterr().err
    assert error.startswith("nbtrack: ")
    assert error.count("\n") == 1


def test_files_of_the_system(tmp_path: Path) -> None:
    """Catches hidden files that are taken for images."""
    folder = write_recording("replica", tmp_path / "r")
    for name in (".DS_Store", "._frame000001.jpg"):
        (folder / "results" / name).write_bytes(b"no image")
    assert len(open_recording(folder)) == N_FRAMES
