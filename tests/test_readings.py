"""`data check` on recordings that are declared wrongly: it must name what is wrong, and only that.

Rooms are seen with a Kinect's noise in small images; every mistake is one that users make.
"""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recordings import Source, camera_matrix, matrix_text, write_images
from scipy.spatial.transform import Rotation

from nbtrack.cli import main
from nbtrack.core.camera import Intrinsics
from nbtrack.data.check import check_sequence
from nbtrack.data.conventions import Convention
from nbtrack.data.sequence import read_sequence
from nbtrack.synthetic import (
    add_kinect_noise,
    build_room,
    filter_depth,
    handheld_trajectory,
    render_frame,
    room_intrinsics,
)

pytestmark = pytest.mark.usefixtures("one_thread")
REAL_ROOM = Path(__file__).resolve().parents[2] / "shared/data/real_room"
ROOMS = ("living_room", "office", "long_hall")
CAMERA = room_intrinsics(48, 36)
N_FRAMES, STRIDE = 30, 3


@cache
def seen(name: str) -> Source:
    """A room, or the real recording at a quarter of its size."""
    if name == "real_room":
        sequence = read_sequence(REAL_ROOM, slice(0, 60, 2))
        camera = replace(sequence.intrinsics.scaled(0.25), cx=40.0, cy=30.0)
        # The middle of four pixels is the corner of one: the principal point moves with it.
        quarter = (slice(None), slice(2, None, 4), slice(2, None, 4))
        camera = replace(camera, cx=camera.cx - 0.125, cy=camera.cy - 0.125)
        return Source(
            sequence.colors[quarter], sequence.depths_mm[quarter], sequence.T_world_camera, camera
        )
    room = build_room(name)
    poses = handheld_trajectory(room, N_FRAMES * STRIDE, 0)[::STRIDE]
    colors, depths = [], []
    for number, pose in enumerate(poses):
        color, depth, _ = render_frame(room, CAMERA, pose)
        noisy = add_kinect_noise(depth, CAMERA.fx, np.random.default_rng(number))
        colors.append(color)
        depths.append(np.rint(1000 * filter_depth(noisy)).astype(np.uint16))
    return Source(np.stack(colors), np.stack(depths), poses, CAMERA)


@dataclass(frozen=True)
class Mistake:
    """How a recording is written, what is declared of it, and what the check must say."""

    says: str  # as a regular expression
    settings: str = ""  # of `sequence.toml`
    poses: Callable[[np.ndarray], np.ndarray] = field(default=lambda poses: poses)
    depth: Callable[[np.ndarray], np.ndarray] = field(default=lambda depth: depth)
    camera: Callable[[Intrinsics], Intrinsics] = field(default=lambda camera: camera)


def ray_lengths(depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    rows, columns = np.indices(depth.shape[-2:])
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    return np.sqrt(1 + x**2 + y**2)


def rolled(places: int) -> Callable[[np.ndarray], np.ndarray]:
    """Matrices made from quaternions whose order was mistaken."""

    def mistake(poses: np.ndarray) -> np.ndarray:
        q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        wrong = poses.copy()
        wrong[:, :3, :3] = Rotation.from_quat(np.roll(q, places, axis=1)).as_matrix()
        return wrong

    return mistake


def scaled(camera: Intrinsics, factor: float) -> Intrinsics:
    numbers = {name: factor * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, **numbers)


MISTAKES = {
    "OpenGL axes": Mistake(
        'poses look like OpenGL axes .*camera-to-world; set camera_axes = "opengl" in',
        poses=Convention("opengl").from_opencv,
    ),
    "OpenCV axes called OpenGL": Mistake(
        'poses look like OpenCV axes .*; set camera_axes = "opencv" in',
        settings='camera_axes = "opengl"',
    ),
    "world-to-camera": Mistake(
        'poses look like OpenCV axes .*world-to-camera; set poses = "world-to-camera" in',
        poses=Convention("opencv", True).from_opencv,
    ),
    "camera-to-world called the inverse": Mistake(
        'poses look like OpenCV axes .*camera-to-world; set poses = "camera-to-world" in',
        settings='poses = "world-to-camera"',
    ),
    "OpenGL axes, world-to-camera": Mistake(
        'set camera_axes = "opengl" and poses = "world-to-camera" in',
        poses=Convention("opengl", True).from_opencv,
    ),
    "robot axes": Mistake(
        'poses look like robot axes .*; set camera_axes = "forward left up" in',
        poses=Convention("forward left up").from_opencv,
    ),
    "quaternions wxyz": Mistake(
        'poses look like quaternions in the order wxyz; set quaternion = "wxyz" in',
        poses=rolled(1),
    ),
    "quaternions xyzw": Mistake(
        'poses look like quaternions in the order xyzw; set quaternion = "xyzw" in',
        settings='quaternion = "wxyz"',
        poses=rolled(-1),
    ),
    "TUM's depth called millimetres": Mistake(
        "depth looks like 5000 depth values a metre; set depth_scale = 5000 in",
        depth=lambda depth: 5 * depth,
    ),
    "millimetres called TUM's": Mistake(
        "depth looks like 1000 depth values a metre; set depth_scale = 1000 in",
        settings="depth_scale = 5000",
    ),
    "millimetres called metres": Mistake(
        "depth looks like 1000 depth values a metre", settings="depth_scale = 1"
    ),
    "millimetres called micrometres": Mistake(
        "depth looks like 1000 depth values a metre", settings="depth_scale = 1000000"
    ),
    "millimetres called 5,000,000 a metre": Mistake(
        "depth looks like 1000 depth values a metre", settings="depth_scale = 5000000"
    ),
    "distances along the ray": Mistake(
        'depth looks like distances along the ray, not z-depth; set depth_along = "ray" in',
        depth=lambda depth: np.rint(depth * ray_lengths(depth, CAMERA)),
    ),
    "z-depth called distances": Mistake(
        'depth looks like depth along the optical axis; set depth_along = "axis" in',
        settings='depth_along = "ray"',
    ),
    "principal point in the corner": Mistake(
        "calibration looks like one with its principal point in the middle of the image; set",
        camera=lambda camera: replace(camera, cx=0.5, cy=0.5),
    ),
    "principal point of a larger image": Mistake(
        "calibration looks like one with its principal point in the middle of the image; set",
        camera=lambda camera: replace(camera, cx=float(camera.width), cy=float(camera.height)),
    ),
    "calibration of a larger image": Mistake(
        "calibration looks like one for images twice as large; set",
        camera=lambda camera: scaled(camera, 2.0),
    ),
    "calibration of a smaller image": Mistake(
        "calibration looks like one for images half as large; set",
        camera=lambda camera: scaled(camera, 0.5),
    ),
}


def write(folder: Path, name: str, mistake: Mistake) -> Path:
    """A plain recording with a mistake. Images of the same depth are written once and linked."""
    data = seen(name)
    folder.mkdir(parents=True)
    depth = mistake.depth(data.depths_mm.astype(float)).clip(0, 65535).astype(np.uint16)
    write_images(folder, data._replace(depths_mm=depth))
    (folder / "poses.txt").write_text(matrix_text(mistake.poses(data.poses).reshape(-1, 16)))
    K = camera_matrix(mistake.camera(data.camera))
    (folder / "intrinsics.txt").write_text(matrix_text(K))
    (folder / "sequence.toml").write_text(mistake.settings + "\n")
    return folder


NEEDS_REAL = pytest.mark.skipif(
    not REAL_ROOM.is_dir(), reason="the real recording is not on this machine"
)
SEEN = [*ROOMS, pytest.param("real_room", marks=NEEDS_REAL)]


@pytest.mark.parametrize("name", SEEN)
def test_every_mistake_is_named(tmp_path: Path, name: str) -> None:
    """Catches a mistake that passes, or that is taken for another one: all of them in each room."""
    wrong = {}
    for number, (label, mistake) in enumerate(MISTAKES.items()):
        if name == "real_room" and label == "distances along the ray":
            data = seen(name)
            lengths = ray_lengths(data.depths_mm, data.camera)
            mistake = replace(mistake, depth=lambda depth, by=lengths: np.rint(depth * by))
        report = check_sequence(write(tmp_path / str(number), name, mistake))
        first = (*report.warnings, "no warning")[0]
        if not re.search(mistake.says, first) or not first.startswith("your "):
            wrong[label] = first
        shutil.rmtree(tmp_path / str(number))
    assert wrong == {}


@pytest.mark.parametrize("name", SEEN)
def test_no_false_alarm(tmp_path: Path, name: str) -> None:
    """Catches warnings about recordings that are right, however they are declared."""
    right = [
        Mistake("", poses=Convention(axes, inverse).from_opencv,
                settings=f'camera_axes = "{axes}"\nposes = "{direction}"')
        for axes in ("opencv", "opengl", "forward left up")
        for inverse, direction in ((False, "camera-to-world"), (True, "world-to-camera"))
    ]  # fmt: skip
    right.append(Mistake("", settings="depth_scale = 5000", depth=lambda depth: 5 * depth))
    for number, declared in enumerate(right):
        report = check_sequence(write(tmp_path / str(number), name, declared))
        assert report.best is report.fits[0], declared
        assert report.warnings == (), declared


def test_long_way_between_frames(tmp_path: Path) -> None:
    """Catches alarms about fast cameras: frames of a pair then share little."""
    data = seen("office")
    thin = Source(data.colors[::3], data.depths_mm[::3], data.poses[::3], CAMERA)
    write_images(tmp_path, thin)
    (tmp_path / "poses.txt").write_text(matrix_text(thin.poses.reshape(-1, 16)))
    (tmp_path / "intrinsics.txt").write_text(matrix_text(camera_matrix(CAMERA)))
    report = check_sequence(tmp_path)
    assert report.best is report.fits[0]


def test_command_prints_the_sentence_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Catches a picture that is not written, or written unasked into the recording's folder."""
    folder = write(tmp_path / "r", "office", MISTAKES["OpenGL axes"])
    before = sorted(folder.rglob("*"))
    assert main(["data", "check", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "warning: your poses look like OpenGL axes" in printed
    assert "start with: --preset" in printed
    assert main(["data", "check", str(folder), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/check.png").stat().st_size > 5000
    assert sorted(folder.rglob("*")) == before


def test_facts_of_the_report(tmp_path: Path) -> None:
    """Catches shares of the wrong whole: half of one frame has no depth, another is dark."""
    data = seen("office")
    depths, colors = data.depths_mm.copy(), data.colors.copy()
    depths[3], depths[3, :18] = 2000, 0
    colors[5:] = colors[5:] // 2
    folder = tmp_path / "r"
    write(folder, "office", Mistake(""))
    write_images(folder, data._replace(depths_mm=depths, colors=colors))
    report = check_sequence(folder)
    assert report.measured_least == pytest.approx(0.5)
    assert report.measured == pytest.approx((depths > 0).mean())
    assert report.brightness_step > 0.8
    assert any("brightness changes by" in text for text in report.warnings)
    assert 0.3 < report.seen_thrice <= 1
    text = json.dumps(str(report))
    assert "coverage" in text
    assert "exposure" in text
