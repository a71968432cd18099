"""Broken recordings of every format: one clear line and exit status 2, never a traceback."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import WRITERS, write_recording

from nbtrack.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")
Damage = Callable[[Path], object]


def text(name: str, content: str | bytes) -> Damage:
    """Put this into a file."""
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(raw)


def without(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def cut(name: str) -> Damage:
    """Only the first half is left."""

    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return damage


def image(name: str, pixels: np.ndarray) -> Damage:
    return lambda folder: cv2.imwrite(str(folder / name), pixels)


def line(name: str, number: int, content: str | None) -> Damage:
    """Replace a line, counted from 0, or drop it."""

    def damage(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number : number + 1] = [] if content is None else [content]
        (folder / name).write_text("\n".join(lines) + "\n")

    return damage


def camera(**values: object) -> Damage:
    """Change `intrinsics.json`; None drops a key."""

    def damage(folder: Path) -> None:
        content = json.loads((folder / "intrinsics.json").read_text()) | values
        kept = {key: value for key, value in content.items() if value is not None}
        (folder / "intrinsics.json").write_text(json.dumps(kept))

    return damage


def toml(content: str) -> Damage:
    return text("sequence.toml", content)


EIGHT_BIT, SMALL = np.ones((36, 48), np.uint8), np.ones((18, 24), np.uint16)
THREE_CHANNELS = np.ones((36, 48, 3), np.uint16)
SKEWED = "1 0.5 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
FAR = "1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1"
NOT_RIGID = "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
TUM_ROW = "1305031102.675 0 0 0 0 0 0"

BROKEN: dict[str, dict[str, tuple[Damage, str]]] = {
    "tum": {
        "no list": (without("rgb.txt"), "no file .*rgb.txt: the TUM layout needs it"),
        "empty list": (text("depth.txt", "# nothing\n"), "depth.txt is empty: every line holds"),
        "no timestamp": (line("rgb.txt", 1, "rgb/a.png"), "rgb.txt line 2 is 'rgb/a.png': every"),
        "timestamp NaN": (line("rgb.txt", 1, "nan rgb/a.png"), "line 2 is 'nan rgb/a.png'"),
        "file not there": (line("depth.txt", 2, "1.0 depth/no.png"), "no file .*no.png.* line 3"),
        "binary list": (text("rgb.txt", bytes(range(256))), "rgb.txt line 1 is "),
        "other clock": (text("depth.txt", "1.0 depth/odd.png\n"), "no times within 0.02 s"),
        "poses of another clock": (
            text("groundtruth.txt", "5 0 0 0 0 0 0 1\n"), "no pose within 0.02 s of an image"
        ),
        "7 columns": (line("groundtruth.txt", 3, TUM_ROW), "line 4 is '1305031102.675 0"),
        "zero quaternion": (
            line("groundtruth.txt", 3, TUM_ROW + " 0"), "pose 1 has a quaternion of norm 0:"
        ),
        "NaN timestamp": (line("groundtruth.txt", 3, "nan 0 0 0 0 0 0 1"), "no finite timestamp"),
        "no calibration": (without("calibration.txt"), "no calibration for .*freiburg1"),
        "5 numbers": (text("calibration.txt", "1 2 3 4 5"), "calibration.txt line 1 is '1 2 3 4"),
        "cut image": (cut("rgb/odd.png"), None),  # not used, hence no error
        "cut depth": (cut("depth/1305031102.186000.png"), "damaged or not a complete PNG"),
    },
    "replica": {
        "no trajectory": (without("traj.txt"), "no file .*traj.txt: the Replica layout needs it"),
        "15 numbers": (line("traj.txt", 2, "1 " * 15), "traj.txt line 3 is '1 1"),
        "a word": (line("traj.txt", 0, "one " * 16), "traj.txt line 1 is 'one one"),
        "no rotation": (line("traj.txt", 1, SKEWED), "traj.txt frame 1 is no rigid transform"),
        "out of this world": (line("traj.txt", 1, FAR), "frame 1 lies 1e\\+300 m from the origin"),
        "a pose less": (line("traj.txt", 1, None), "traj.txt has 5 poses but there are 6 images"),
        "all NaN": (text("traj.txt", ("nan " * 16 + "\n") * 6), "poses in .*traj.txt are NaN"),
        "no camera": (without("../cam_params.json"), "no file .*cam_params.json"),
        "camera is a list": (text("../cam_params.json", "[1, 2]"), "holds a list: it must be an"),
        "camera is no JSON": (text("../cam_params.json", "{w: 1200}"), "is no JSON"),
        "deep JSON": (text("../cam_params.json", "[" * 100_000), "is no JSON"),
        "other scale": (
            lambda f: text("../cam_params.json", json.dumps({"camera": json.loads(
                (f / "../cam_params.json").read_text())["camera"] | {"scale": 1000.0}}))(f),
            "scale is '1000.0' but 6553.5 depth values a metre are in use",
        ),
        "depth is a JPEG": (
            image("results/depth000002.png", THREE_CHANNELS), "depth000002.png is uint16 of shape"
        ),
        "an image less": (without("results/frame000003.jpg"), "has 5 images but 6 depth maps"),
        "cut JPEG": (cut("results/frame000003.jpg"), "frame000003.jpg is damaged"),
    },
    "7scenes": {
        "pose missing": (without("frame-000002.pose.txt"), "has 6 images but 5 poses"),
        "no poses": (
            lambda f: [p.unlink() for p in f.glob("*.pose.txt")], "no files in .*needs files like"
        ),
        "3 rows": (line("frame-000001.pose.txt", 3, None), None),  # 3x4: as good as 4x4
        "2 rows": (text("frame-000001.pose.txt", "1 0 0 0\n0 1 0 0\n"), "has 2 rows: it needs"),
        "no rotation": (text("frame-000001.pose.txt", NOT_RIGID), "frame 1 is no rigid transform"),
        "8-bit depth": (image("frame-000001.depth.png", EIGHT_BIT), "depth.png is uint8"),
        "small depth": (image("frame-000004.depth.png", SMALL), "depth.png is 24x18 but"),
        "empty image": (text("frame-000000.color.png", b""), r"not a complete PNG or JPEG \(0"),
        "binary pose": (text("frame-000001.pose.txt", bytes(range(256))), "pose.txt line 1 is"),
    },
    "scannet": {
        "no intrinsics": (without("intrinsic/intrinsic_depth.txt"), "no file .*intrinsic_depth"),
        "zero focal": (
            text("intrinsic/intrinsic_depth.txt", "0 0 1 0\n0 0 1 0\n0 0 1 0\n0 0 0 1\n"),
            "gives focal lengths 0 and 0: they must be positive",
        ),
        "NaN focal": (
            text("intrinsic/intrinsic_depth.txt", "nan 0 1\n0 5 1\n0 0 1\n"), "focal lengths nan"
        ),
        "skew": (
            text("intrinsic/intrinsic_depth.txt", "5 1 1\n0 5 1\n0 0 1\n"), "is no camera matrix"
        ),
        "infinite centre": (
            text("intrinsic/intrinsic_depth.txt", "5 0 inf\n0 5 1\n0 0 1\n"), "must be finite"
        ),
        "odd numbers": (
            lambda f: (f / "depth/5.png").rename(f / "depth/9.png"), "frame numbers in the names"
        ),
        "all poses lost": (
            lambda f: [p.write_text(4 * "-inf -inf -inf -inf\n") for p in (f / "pose").iterdir()],
            "poses in .*pose are NaN",
        ),
        "empty pose": (text("pose/3.txt", ""), "3.txt is empty: every line holds four numbers"),
        "pose of UTF-16": (text("pose/3.txt", "1 0 0 0\n".encode("utf-16")), "3.txt line 1 is"),
    },
    "plain": {
        "unknown key": (toml("depth_scal = 1000\n"), "unknown key 'depth_scal': did you mean 'dep"),
        "no TOML": (toml("depth_scale 1000\n"), "sequence.toml is no TOML"),
        "scale zero": (toml("depth_scale = 0\n"), "depth_scale = '0': it must be a positive"),
        "scale text": (toml('depth_scale = "mm"\n'), "depth_scale = 'mm': it must be a positive"),
        "scale true": (toml("depth_scale = true\n"), "depth_scale = 'True': it must be a positive"),
        "scale NaN": (toml("depth_scale = nan\n"), "depth_scale = 'nan': it must be a positive"),
        "scale huge": (toml("depth_scale = 1" + "0" * 400), "must be a positive"),
        "axes": (toml('camera_axes = "up up up"\n'), "camera_axes = 'up up up': write 'opencv'"),
        "axes a list": (toml("camera_axes = [1]\n"), "camera_axes = '': write 'opencv'"),
        "direction": (toml('poses = "c2w"\n'), "poses = 'c2w': write 'camera-to-world' or 'world"),
        "order": (toml('quaternion = "wxzy"\n'), "quaternion = 'wxzy': write 'xyzw' or 'wxyz'"),
        "no_depth": (toml("no_depth = 65536\n"), "no_depth = '65536': it must be a whole number"),
        "format": (toml('format = "tumm"\n'), "unknown format 'tumm': did you mean 'tum'"),
        "format a number": (toml("format = 7\n"), "format = '7': it must be a format's name"),
        "wrong scale": (toml("depth_scale = 1\n"), None),  # diagnosed, not refused
        "no camera": (without("intrinsics.json"), "no file .*intrinsics.json: a plain recording"),
        "no fx": (camera(fx=None), "intrinsics.json: fx is 'None': it must be a number"),
        "fx negative": (camera(fx=-5), "gives focal lengths -5 and"),
        "fx a word": (camera(fx="525"), "fx is '525': it must be a number"),
        "fx NaN": (camera(fx=float("nan")), "fx is 'nan': it must be a number"),
        "fx huge": (camera(fx=10**400), "it must be a number"),
        "width broken": (camera(width=47.5), "gives a size of 47.5 x 36"),
        "proportions": (camera(height=48), "is 48x36 but .* is for 48x48"),
        "distortion": (camera(distortion=[1, 2, 3]), "distortion has 3 numbers: write OpenCV's"),
        "distortion a word": (camera(distortion="no"), "distortion is 'no': write a list"),
        "matrix of eight": (camera(intrinsic_matrix=[1] * 8), "intrinsic_matrix has 8 numbers"),
        "no poses": (without("trajectory.txt"), "no poses in .*trajectory.txt or poses.txt"),
        "two pose files": (text("poses.txt", "1 2 3"), "has trajectory.txt and poses.txt: choose"),
        "9 columns": (text("trajectory.txt", "1 2 3 4 5 6 7 8 9\n"), "trajectory.txt line 1 is"),
        "a line less": (text("trajectory.txt", "0.5001 0 0 0 0 0 0 1\n"), "has 1 poses but"),
        "order of columns": (
            text("trajectory.txt", "0 0 0 0 1 2 3 4\n" * 6), "quaternion of norm 5.48: columns"
        ),
        "rows of two kinds": (
            text("trajectory.txt", "0 0 0 0 0 0 0 1\n" * 5 + "0 0 0 0 0 0 1\n"), "line 6 is '0 0"
        ),
        "no colour": (
            lambda f: [p.unlink() for p in (f / "color").iterdir()], "no images in .*color"
        ),
        "an image of text": (text("color/000001.png", "hello"), "000001.png is damaged"),
        "small colour": (image("color/000003.png", SMALL), "000003.png is 24x18 but"),
    },
    "neural_rgbd": {
        "ten numbers": (text("intrinsics.txt", "5 0 1 0 5 1 0 0 1 2\n"), "intrinsics.txt line 1"),
        "two rows": (text("intrinsics.txt", "5 0 1\n0 5 1\n"), "intrinsics.txt holds 2x3 numbers"),
        "tiny focal": (text("focal.txt", "1e-300"), "focal.txt holds '1e-300': it must be one"),
        "binary poses": (text("poses.txt", bytes(range(256))), "poses.txt line 1 is"),
        "binary focal": (text("focal.txt", bytes(range(256))), "focal.txt holds "),
    },
}  # fmt: skip
CASES = [(format, case) for format, cases in BROKEN.items() for case in cases]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Path], Path]:
    """Copies of whole recordings, written once."""
    base = tmp_path_factory.mktemp("whole")
    for format in WRITERS:
        write_recording(format, base / format / "recording")

    def copy(format: str, to: Path) -> Path:
        shutil.copytree(base / format, to)
        return to / "recording"

    return copy


@pytest.mark.parametrize(("format", "case"), CASES)
def test_one_line(whole, tmp_path: Path, capfd, format: str, case: str) -> None:
    """Catches tracebacks, garbage read in silence, and messages without file, limit or advice."""
    damage, expected = BROKEN[format][case]
    folder = whole(format, tmp_path / "copy")
    damage(folder)
    arguments = ["data", "check", str(folder)]
    if not case.startswith("format"):
        arguments += ["--format", format]
    status = main(arguments)
    error = capfd.readouterr().err
    if expected is None:
        assert (status, error) == (0, "")
        return
    assert status == 2
    assert error.startswith("nbtrack: ")
    assert error.count("\n") == 1
    assert len(error) < 700
    assert re.search(expected, error), error
    assert ": " in error.removeprefix("nbtrack: ")  # what was found: what is allowed


@pytest.mark.parametrize("format", WRITERS)
def test_windows_text(whole, tmp_path: Path, capfd, format: str) -> None:
    """Catches a byte-order mark or CRLF line ends taken for part of the numbers."""
    folder = whole(format, tmp_path / "copy")
    for path in [*folder.rglob("*.txt"), *folder.parent.rglob("*.json")]:
        content = path.read_text().replace("\n", "\r\n")
        path.write_bytes(b"\xef\xbb\xbf" + content.encode())
    assert main(["data", "check", str(folder)]) == 0
    assert capfd.readouterr().err == ""


def test_there_are_enough_cases() -> None:
    """Catches cases that vanish: at least forty, and some for every format."""
    assert len(CASES) >= 40
    assert set(BROKEN) == set(WRITERS)
