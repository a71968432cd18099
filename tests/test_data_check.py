"""`data check`: facts by hand; what is declared wrongly must be named, and only that.

Of bare walls with exact depth; of rooms seen with a Kinect's noise, and of a real recording.
"""

import re
import shutil
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import pytest
import recordings
from box_room import BoxRoom, box_sequence, poses_at
from recordings import along_rays, camera, depth, positions, real, source, with_noise
from scipy.spatial.transform import Rotation
from tiny import tiny_words

from nbtrack import load_preset, read_sequence
from nbtrack.checks import check as check_module
from nbtrack.checks.check import DataReport, check_recording, quick_look
from nbtrack.checks.conventions import AXES, axes_name
from nbtrack.cli import main
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.scenes import Scene
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.settings import with_settings
from nbtrack.recordings.formats import WORLD_TO_CAMERA, Declaration
from nbtrack.recordings.recording import open_recording
from nbtrack.synthetic.make import make_room

N_FRAMES = 16
MOVED_MM = 30 * np.linalg.norm([0.55, -0.4, 0.73])
TURNED_DEG = 2 * np.linalg.norm([0.35, 0.8, 0.49])


def check(folder: Path) -> DataReport:
    return check_recording(open_recording(folder))


def walk(n_frames: int, step_m: float = 0.03, step_deg: float = 2.0) -> np.ndarray:
    """Poses that move and turn about no special axis, so that no convention is like another."""
    steps = np.arange(n_frames)
    turns = np.outer(np.radians(step_deg) * steps, [0.35, 0.8, 0.49])
    return poses_at(np.outer(step_m * steps, [0.55, -0.4, 0.73]) - [0, 0, 0.5], turns)


def write_box(folder: Path, poses: np.ndarray, half: tuple = (1.5, 1.2, 1.5)) -> Path:
    """Bare walls with exact depth: rays end where they leave the box."""
    sequence = box_sequence(poses, BoxRoom(half=half, contrast=0.0), 48)
    data = recordings.Source(sequence.colors, sequence.depths_mm, poses, sequence.intrinsics)
    recordings.write_neural_rgbd(folder, data)
    return folder


def as_written(T: np.ndarray, camera_axes: str, poses: str = "camera-to-world") -> np.ndarray:
    """What somebody with this convention writes; nothing of the package's own arithmetic."""
    words = {"opencv": "right down forward", "opengl": "right up backward"}
    way = {"right": 0, "left": 0, "down": 1, "up": 1, "forward": 2, "backward": 2}
    axes = np.zeros((4, 4))
    for i, word in enumerate(words.get(camera_axes, camera_axes).split()):
        axes[i, way[word]] = -1.0 if word in ("left", "up", "backward") else 1.0
    axes[3, 3] = 1
    written = np.diag([1, 1, np.linalg.det(axes), 1]) @ T @ axes.T  # mirrored worlds
    return np.linalg.inv(written) if poses == WORLD_TO_CAMERA else written


def rewrite_poses(folder: Path, poses: np.ndarray) -> None:
    (folder / "poses.txt").write_text(recordings.matrix_text(poses.reshape(-1, 4)))


def test_axes_of_either_hand_come_back() -> None:
    """Catches poses that stay mirrored, or are none, where camera and world are left-handed."""
    poses = walk(3)
    for axes, way in product(AXES, ("camera-to-world", WORLD_TO_CAMERA)):
        written = np.stack([as_written(T, axes, way) for T in poses])
        found = Declaration(camera_axes=axes, poses=way).poses_to_opencv(written)
        np.testing.assert_allclose(found, poses, atol=1e-12)


@pytest.fixture
def box(tmp_path: Path) -> Path:
    return write_box(tmp_path / "box", walk(N_FRAMES))


def test_facts(box: Path) -> None:
    """Catches facts in the wrong unit, ragged columns, and surfaces apart where depth is exact: the
    field of view is 2 atan(32/48) = 67.4 degrees."""
    report = check(box)
    assert report.warnings == []
    assert report.best.reading.declared.camera_axes == "opengl"
    assert report.best.apart < 0.01
    assert report.best.overlap > 0.5
    lines = str(report).splitlines()
    assert "48.00 and 48.00 px (67.4 deg wide), principal point (32, 24)" in lines[1]
    table = [line.split()[:4] for line in lines]
    for name, value in (("measured", 1), ("moved_mm", MOVED_MM), ("turned_deg", TURNED_DEG)):
        assert [name, *[f"{value:.2f}"] * 3] in table


BESIDE = walk(N_FRAMES)
BESIDE[[3, 8, 12], :3, 3] += [0.396, 0.04, 0.04]  # 0.4 m off the path
NOT_PROVED = "poses.txt is not proved: "
ONE_WARNING = {
    "still": (walk(30, 0.0, 0.0), NOT_PROVED + ".* other conventions fit about as well"),
    "one frame": (walk(1), NOT_PROVED + "two frames see too little of the same"),
    "outliers": (walk(N_FRAMES), "3 of 16 poses lie up to .*, first near img3.png"),
}


@pytest.mark.parametrize("case", ONE_WARNING)
def test_one_warning(tmp_path: Path, case: str) -> None:
    """Catches what is called right because nothing contradicts it, and statistics of nothing."""
    poses, says = ONE_WARNING[case]
    folder = write_box(tmp_path / "box", poses)
    if case == "outliers":
        rewrite_poses(folder, as_written(BESIDE, "opengl"))
    report = check(folder)
    assert report.best is report.conventions[0]
    assert len(report.warnings) == 1
    *_, end = str(report).split("\n\n")
    assert re.match(f"verdict: .*{says}", " ".join(end.split()))
    assert max(map(len, str(report).replace(str(tmp_path), "").splitlines())) < 100
    assert "  next: python -m nbtrack data check " in str(report)  # and not to track


def test_a_camera_that_was_moved_between_frames(tmp_path: Path) -> None:
    """Catches right poses that are called wrong since the path has steps."""
    assert check(write_box(tmp_path / "box", BESIDE)).verdict == "read rightly"


def test_a_wall_that_is_seen_straight(tmp_path: Path) -> None:
    """Catches the one depth of a wall, or of a floor from above, taken for no measurement."""
    steps = np.arange(N_FRAMES)
    turns = np.outer(np.radians(3) * steps, [0, 0, 1]) + 1e-4
    poses = poses_at(np.outer(0.02 * steps, [1, 0.4, 0]), turns)
    assert check(write_box(tmp_path / "box", poses, (0.8, 0.6, 1.5))).faults == []


def test_a_unit_that_only_the_depth_tells(tmp_path: Path) -> None:
    """Catches depths and positions that are ten times too short alike."""
    poses = walk(N_FRAMES)
    poses[:, :3, 3] /= 10
    (said,) = check(write_box(tmp_path / "box", poses, (0.15, 0.12, 0.15))).warnings
    assert said.startswith("the median depth is 0.189 m")


def test_frames_without_pose(box: Path, tmp_path: Path) -> None:
    """Catches a motion measured across a gap, frames that slip against their depth, and an odd pose
    between lost ones that nobody looks at."""
    poses = as_written(walk(N_FRAMES), "opengl")
    poses[[0, 6, 7]] = np.nan
    rewrite_poses(box, poses)
    report = check(box)
    assert len(report.frames) == 13
    assert report.best.apart < 0.01
    assert report.frames.moved_mm.max() == pytest.approx(MOVED_MM)
    assert report.frames.turned_deg.max() == pytest.approx(TURNED_DEG)
    poses[8, 0, 3] += 0.2  # three frames after a pose, one before the next
    rewrite_poses(box, poses)
    assert check(box).frames.off_mm[8] == pytest.approx(200.0)
    every_second = as_written(BESIDE, "opengl")
    every_second[::2] = np.nan
    rewrite_poses(write_box(tmp_path / "beside", walk(N_FRAMES)), every_second)
    assert "1 of 8 poses lie up to 40 cm beside" in " ".join(check(tmp_path / "beside").warnings)


def test_a_long_recording_is_read_in_parts(tmp_path: Path, monkeypatch) -> None:
    """Catches 18 GB that 12,000 frames would take, images that are lost between two parts, and a
    repeated image that is not seen since it begins one."""
    folder = write_box(tmp_path / "box", walk(20))
    shutil.copy(folder / "depth_filtered/depth7.png", folder / "depth_filtered/depth8.png")
    whole = check(folder)
    monkeypatch.setattr(check_module, "_FRAMES_AT_ONCE", 8)
    with mock.patch.object(check_module, "read_frames", wraps=check_module.read_frames) as read:
        report = check(folder)
    assert [len(call.args[1]) for call in read.call_args_list] == [8, 8, 4]
    assert report.frames.equals(whole.frames)
    assert list(report.frames.index[report.frames.is_repeated]) == [8]
    assert report.conventions[0].apart == whole.conventions[0].apart
    assert report.best.name == whole.best.name


def test_no_memory_is_told_in_a_line(box: Path, capsys, monkeypatch) -> None:
    """Catches a traceback, and no word of what would help."""
    monkeypatch.setattr("nbtrack.recordings.reading.np.empty", mock.Mock(side_effect=MemoryError))
    assert main(["data", "convert", str(box), str(box.parent / "new")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--frames ::2" in line


def test_far_outliers(tmp_path: Path) -> None:
    """Catches a scene of 140 m around a room of 4 m, which no map can be made of, without a word;
    and that any depth of a right recording is taken for one."""
    data, rng, share = source(), np.random.default_rng(0), 0.08
    depths = data.depths_mm.copy()
    is_far = rng.random(depths.shape) < share
    depths[is_far] = rng.integers(40_000, 65_000, is_far.sum())
    right = recordings.write_recording("plain", tmp_path / "right")
    far = recordings.write_recording("plain", tmp_path / "far", data._replace(depths_mm=depths))
    sequences = [Scene(path.name, path).read() for path in (right, far)]
    assert np.array_equal(sequences[0].depths_mm, read_sequence(right).depths_mm)
    sizes = [np.array([b.minimum, b.maximum]) for b in map(observed_bounds, sequences)]
    np.testing.assert_allclose(*sizes, atol=0.03)
    (told,) = (text for text in check(far).remarks if "outliers" in text)
    assert float(told.split("%")[0]) / 100 == pytest.approx(share, rel=0.5)


@cache
def seen(name: str) -> recordings.Source:
    """A room with a Kinect's noise, or the real recording at a quarter of its size."""
    if name == "real_room":
        return real(name, slice(60, 96, 2), 4)  # before, its poses are off by twice as much
    return with_noise(source(name, 18, 5))


class Case(NamedTuple):
    """How a recording is written, what `sequence.toml` declares, and what the check must say."""

    says: str  # as a regular expression, after "your ... look like"
    settings: str = ""
    change: recordings.Change = lambda data: data


def poses(axes: str, direction: str = "camera-to-world"):
    return lambda data: data._replace(poses=as_written(data.poses, axes, direction))


def rolled(places: int):
    """Matrices made from quaternions whose order was mistaken."""

    def change(data):
        q = np.roll(Rotation.from_matrix(data.poses[:, :3, :3]).as_quat(), places, axis=1)
        wrong = data.poses.copy()
        wrong[:, :3, :3] = Rotation.from_quat(q).as_matrix()
        return data._replace(poses=wrong)

    return change


def turned(*axes: int):
    """Rows or columns of depth images in reverse order."""
    return depth(lambda d: np.flip(d, axes).copy())


def mixed(data):
    """Rotations world-to-camera beside the camera's own place."""
    wrong = data.poses.copy()
    wrong[:, :3, :3] = data.poses[:, :3, :3].mT
    return data._replace(poses=wrong)


MISTAKES = [
    *(
        Case(
            re.escape(axes_name(axes, way)) + "(, or the images.*)?; set ", change=poses(axes, way)
        )
        for way in ("camera-to-world", WORLD_TO_CAMERA)
        for axes in (*AXES[:4], *AXES[4::22])
        if (axes, way) != ("opencv", "camera-to-world")
    ),
    Case('OpenCV axes .*; set camera_axes = "opencv" in', 'camera_axes = "opengl"'),
    Case('OpenCV .*; set poses = "camera-to-world" in', 'poses = "world-to-camera"'),
    Case('quaternions in the order wxyz; set quaternion = "wxyz" in', change=rolled(1)),
    Case("quaternions in .* xyzw; set quat.* = .xyzw. in", 'quaternion = "wxyz"', rolled(-1)),
    Case("5000 depth values a metre; set depth_scale = 5000 in", change=depth(lambda d: 5 * d)),
    # By three bits to the left, as SUN3D stores them: up to 8.19 m times 8.
    Case("8000 depth values a metre; set", change=depth(lambda d: (d << 3) | (d >> 13))),
    *(Case("1000 depth values", f"depth_scale = {n}") for n in (1, 5000000)),
    Case('distances along the ray, not z-depth; set depth_along = "ray" in', change=along_rays),
    Case('depth along the optical axis; set depth_along = "axis" in', 'depth_along = "ray"'),
    Case("one with its principal point in the middle of the image; set", change=camera(1.0, 0.02)),
    Case("one for images twice as large; set", change=camera(2.0, 2.0)),
    Case("one for images half as large; set", change=camera(0.5, 0.5)),
    Case("ones in millimetres; mul.* by 0.001, 0.001 and", change=positions(lambda t: 1000 * t)),
    Case("ones in centimetres; multiply .* by 0.01, 0.01 and", change=positions(lambda t: 100 * t)),
    Case(".*, or the images, or those of depth alone, are turned", change=turned(1)),
    Case(".*, or the images, or those of depth alone, are turned", change=turned(1, 2)),
    Case("ones whose x is mirrored; mul", change=positions(lambda t: t * [-1, 1, 1])),
    Case("ones whose y is mirrored; mul", change=positions(lambda t: t * [1, -1, 1])),
    Case("ones whose z is .* and -1 ", change=positions(lambda t: t * [1, 1, -1])),
    Case(".* whose rotations alone are of the other direction; transp", change=mixed),
    *(
        Case(f"{n} depth values a metre; set", change=depth(lambda d, n=n: n / 1000 * d))
        for n in (100, 256, 4000, 6553.5, 10000)
    ),
]
RIGHT = [
    Case("", f'camera_axes = "{axes}"\nposes = "{direction}"', poses(axes, direction))
    for axes in ("opencv", "opengl", "forward left up")
    for direction in ("camera-to-world", WORLD_TO_CAMERA)
]


def write(folder: Path, name: str, case: Case) -> Path:
    """A plain recording."""
    return recordings.write_matrices(folder, case.change(seen(name)), case.settings)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("place", range(3))
def test_every_mistake_is_named_and_nothing_else(tmp_path: Path, place: int) -> None:
    """Catches a mistake that passes, that is taken for another one, or whose advice does not help,
    and warnings about what is right, however it is declared; by a quick look before mapping, and of
    some by the whole check. Each in one of three places, so that no room alone tells."""
    name = ("living_room", "long_hall", "real_room")[place]
    wrong = {}
    for number, case in enumerate([*MISTAKES, *RIGHT][place::3]):
        folder = write(tmp_path / str(number), name, case)
        recording = open_recording(folder)
        wanted = f"your ((poses|positions) look|(depth|calibration) looks) like {case.says}"
        said = quick_look(recording).removeprefix("warning: ")
        whole = said if number % 4 else next(iter(check_recording(recording).warnings), "")
        for text in (said, whole):
            if not re.match(wanted if case.says else "$", text):
                wrong[number] = text
        advice = re.findall(r'\w+ = (?:"[^"]+"|[\d.]+)', said)
        if advice and "make the matrices anew" not in said:
            (folder / "sequence.toml").write_text("\n".join(advice) + "\n")
            if said := quick_look(open_recording(folder)):
                wrong[f"{number}, as advised"] = said
    assert wrong == {}


def test_absurd_numbers_before_mapping(tmp_path: Path) -> None:
    """Catches statistics of nothing, in a look at a few frames and in the whole check."""
    none = Case("no pixel", change=depth(lambda d: 0 * d))
    far = Case("poses.txt is not proved: two", change=positions(lambda t: 1e5 * t))
    for case in (none, far):
        said = quick_look(open_recording(write(tmp_path / case.says[:5], "office", case)))
        assert case.says in said
    with pytest.raises(DataError, match="has a depth"):
        check(tmp_path / none.says[:5])


def test_commands_warn(tmp_path: Path, capsys) -> None:
    """Catches 153 s of work on wrong axes that end at 5 m with status 0; frames without a pose that
    are left out in silence; and a check that draws nothing, or not again, or by whose status a
    script goes on."""
    folder = write(tmp_path / "r", "office", Case("", change=poses("opengl")))
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[3] = " ".join(["nan"] * 16)
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    assert main(["track", str(folder), "--method", "sdf", "--steps", "1", *tiny_words()]) == 0
    said = capsys.readouterr().err
    assert "nbtrack: warning: your poses look like OpenGL axes" in said
    assert "nbtrack: 1 of 18 frames have no pose: not mapped" in said
    for _ in range(2):  # its own picture is drawn anew
        assert main(["data", "check", str(folder), "--out", str(tmp_path / "out")]) == 1
    assert "verdict: wrong, because your poses look like OpenGL axes" in capsys.readouterr().out
    assert (tmp_path / "out/check.png").stat().st_size > 5000


def test_other_ways_to_move(tmp_path: Path) -> None:
    """Catches alarms about frames 0.4 m and 54 degrees apart: about surfaces of which too little is
    seen twice, about steps that are all long, about light that differs with the view; and pairs so
    far apart that a camera which turns by 5 degrees a frame sees nothing in both, so that nothing
    is told of a right recording."""
    apart = recordings.write_recording("plain", tmp_path / "apart", source("living_room", 12, 80))
    turning = make_room("living_room", tmp_path / "turning", 40, 48, 36, motion="tour")
    assert check(apart).warnings == []
    assert check(turning).verdict == "read rightly"


def test_a_hall(tmp_path: Path) -> None:
    """Catches a right recording that is called mirrored, since more points agree where the camera
    seems to go backwards."""
    poses = walk(40, 0.0, 0.3)
    poses[:, 2, 3] = 0.2 * np.arange(40) - 12
    report = check(write_box(tmp_path / "hall", poses, (1.0, 1.3, 15.0)))
    assert not report.faults
    assert "too little of the same" in report.verdict


def test_black_images(tmp_path: Path) -> None:
    """Catches advice to set what no tracker reads, and points that were not measured."""
    case = Case("", change=lambda data: data._replace(colors=0 * data.colors))
    report = check(write(tmp_path / "r", "office", case))
    assert (report.frames.measured < 1).all()
    assert (report.cloud.depth > 0).all()
    (advice,) = (text for text in report.warnings if "images are black" in text)
    changed = with_settings(load_preset("smoke"), *re.findall(r"tracking\.\w+\.\w+=0", advice))
    assert changed.tracking_of("lm").lambda_intensity == 0
    assert changed.tracking_of("sdf").lambda_color == 0
