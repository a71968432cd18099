"""A folder's report: facts by hand, and pose conventions told apart by the depth maps alone."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.check import DataReport, check_sequence
from nbtrack.data.conventions import CONVENTIONS, OPENGL, Convention
from nbtrack.data.readers.neural_rgbd import read_poses
from nbtrack.data.writer import SequenceWriter

pytestmark = pytest.mark.usefixtures("one_thread")
REAL_ROOM = Path(__file__).resolve().parents[2] / "shared/data/real_room"
CAMERA = Intrinsics.from_focal(64, 48, 56.0)
ROOM = SceneBounds((-1.5, -1.2, -1.0), (1.5, 1.2, 2.0))
N_FRAMES = 16


def walk(n_frames: int, step_m: float = 0.03, step_deg: float = 2.0) -> np.ndarray:
    """Poses that move and turn about no special axis, so that no convention is like another."""
    steps = np.arange(n_frames)[:, None]
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    turn = np.radians(step_deg) * steps * np.array([0.35, 0.8, 0.49])
    poses[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    poses[:, :3, 3] = step_m * steps * np.array([0.55, -0.4, 0.73])
    return poses


def empty_room_depth(T_world_camera: np.ndarray) -> np.ndarray:
    """Depth (mm) of the bare walls: rays end where they leave the box."""
    rows, columns = torch.meshgrid(
        torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij"
    )
    pose = torch.from_numpy(T_world_camera).float()
    directions = pixel_directions(CAMERA, columns, rows).flatten(0, 1) @ pose[:3, :3].T
    depth = ROOM.exit_depth(pose[:3, 3].expand_as(directions), directions)
    return (1000 * depth).round().numpy().astype(np.uint16).reshape(CAMERA.height, CAMERA.width)


def write_room(folder: Path, poses: np.ndarray, depth_scale: float = 1.0) -> Path:
    gray = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    with SequenceWriter(folder, CAMERA, ("depth",)) as writer:
        for pose in poses:
            depth = (empty_room_depth(pose) * depth_scale).astype(np.uint16)
            writer.add(gray, {"depth": depth}, pose)
    return folder


def rewrite_poses(folder: Path, poses: np.ndarray) -> None:
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 4), fmt="%.17g")


def best_name(report: DataReport) -> str:
    return report.best.reading.name


def obey(folder: Path, warning: str) -> None:
    """Set in `sequence.toml` what a warning says."""
    settings = re.findall(r'\w+ = (?:"[^"]+"|[\d.]+)', warning)
    assert settings
    (folder / "sequence.toml").write_text("\n".join(settings) + "\n")


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return write_room(tmp_path / "room", walk(N_FRAMES))


def test_right_poses(room: Path) -> None:
    """Catches an overlap that is not zero for exact data, and facts in the wrong unit.

    Walls are planar, so that only rounding to pixels and millimetres is left of the overlap.
    The field of view is 2 atan(32/56) = 59.49 degrees.
    """
    report = check_sequence(room)
    assert report.median_overlap_m < 0.02
    assert report.best is report.fits[0]
    assert report.best.reading.convention == OPENGL
    assert report.fits[0].overlap > 0.5
    assert report.warnings == ()
    assert (report.name, report.frames, report.excluded_frames) == ("room", N_FRAMES, 0)
    assert (report.size, report.focal, report.measured) == ((64, 48), (56.0, 56.0), 1.0)
    assert report.field_of_view_deg == pytest.approx(59.49, abs=0.01)
    direction = np.linalg.norm([0.55, -0.4, 0.73])
    axis = np.linalg.norm([0.35, 0.8, 0.49])
    assert report.motion.mean_mm == pytest.approx(30 * direction, abs=1e-6)
    assert report.motion.max_mm == pytest.approx(30 * direction, abs=1e-6)
    assert report.motion.mean_deg == pytest.approx(2 * axis, abs=1e-6)
    assert report.bounds.maximum[2] == pytest.approx(2.0 + 0.1, abs=0.01)  # 0.1 m of margin


@pytest.mark.parametrize("convention", CONVENTIONS[1:], ids=lambda c: c.name)
def test_wrong_poses_are_named_and_declared(room: Path, convention: Convention) -> None:
    """Catches a check that passes wrong axes, names others, or advises a wrong setting."""
    rewrite_poses(room, convention.from_opencv(walk(N_FRAMES)))
    report = check_sequence(room)
    assert best_name(report) == convention.name
    assert len(report.warnings) == 1
    assert f"your poses look like {convention.name}; set " in report.warnings[0]
    assert report.median_overlap_m > 0.03
    obey(room, report.warnings[0])
    declared = check_sequence(room)
    assert declared.best is declared.fits[0]
    assert declared.best.reading.convention == convention
    assert declared.median_overlap_m < 0.02
    assert declared.warnings == ()


def test_still_camera_proves_nothing(tmp_path: Path) -> None:
    """Catches a folder called right because all readings of identical poses agree."""
    report = check_sequence(write_room(tmp_path / "room", walk(8, 0.0, 0.0)))
    assert report.best is report.fits[0]
    assert "not proved" in report.warnings[0]


def test_single_frame(tmp_path: Path) -> None:
    """Catches a division by zero pairs; NaN must warn of nothing itself."""
    report = check_sequence(write_room(tmp_path / "room", walk(1)))
    assert np.isnan(report.median_overlap_m)
    assert np.isnan(report.motion.mean_mm)
    assert "not proved" in report.warnings[0]
    assert "room" in str(report)


@pytest.mark.parametrize("scale", [10.0, 5.0, 0.1])
def test_wrong_depth_unit(tmp_path: Path, scale: float) -> None:
    """Catches axes blamed for a wrong unit, and another unit advised than the one it is."""
    report = check_sequence(write_room(tmp_path / "room", walk(N_FRAMES), scale))
    assert len(report.warnings) == 1
    wanted = f"your depth looks like {1000 * scale:g} depth values a metre; set depth_scale"
    assert report.warnings[0].startswith(wanted)
    obey(tmp_path / "room", report.warnings[0])
    assert check_sequence(tmp_path / "room").warnings == ()


def test_no_reading_fits(tmp_path: Path) -> None:
    """Catches something usual advised where depth is off by a factor that nobody uses."""
    report = check_sequence(write_room(tmp_path / "room", walk(N_FRAMES), 2.0))
    assert report.best is report.fits[0]
    assert "no other reading fits: check focal.txt, the depth unit" in report.warnings[0]


def test_jump(tmp_path: Path) -> None:
    """Catches a pose that leaps away: the step that leaps is the one after frame 7."""
    poses = walk(N_FRAMES)
    poses[8:, 0, 3] += 0.5
    report = check_sequence(write_room(tmp_path / "room", poses))
    assert len(report.warnings) == 1
    assert "1 of 15 steps" in report.warnings[0]
    assert "after frame 7" in report.warnings[0]
    assert report.median_overlap_m < 0.02


def test_frames_without_pose(room: Path) -> None:
    """Catches a motion measured across a gap, and frames that slip against their depth."""
    poses = read_poses(room / "poses.txt")
    poses[[0, 6, 7]] = np.nan
    rewrite_poses(room, poses)
    report = check_sequence(room)
    assert (report.frames, report.excluded_frames) == (N_FRAMES - 3, 3)
    assert report.median_overlap_m < 0.02
    assert report.motion.max_mm == pytest.approx(report.motion.mean_mm, abs=1e-6)


def test_long_sequences_are_read_in_stretches(tmp_path: Path, monkeypatch) -> None:
    """Catches counts or pairs that depend on how many frames are read at once, and empty ones."""
    write_room(tmp_path / "room", walk(N_FRAMES))
    poses = read_poses(tmp_path / "room/poses.txt")
    poses[4:8] = np.nan
    rewrite_poses(tmp_path / "room", poses)
    whole = check_sequence(tmp_path / "room")
    monkeypatch.setattr("nbtrack.data.scan._FRAMES_AT_ONCE", 4)
    assert str(check_sequence(tmp_path / "room")) == str(whole)
    smaller = np.ones((24, 32), np.uint16)
    cv2.imwrite(str(tmp_path / "room/images/img9.png"), np.ones((24, 32, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "room/depth/depth9.png"), smaller)
    with pytest.raises(DataError, match=r"img9\.png is 32x24"):
        check_sequence(tmp_path / "room")


def test_other_size_between_stretches(room: Path, monkeypatch) -> None:
    """Catches sizes that are compared within a stretch only."""
    monkeypatch.setattr("nbtrack.data.scan._FRAMES_AT_ONCE", 8)
    for number in range(8, N_FRAMES):
        cv2.imwrite(str(room / f"images/img{number}.png"), np.ones((24, 32, 3), np.uint8))
        cv2.imwrite(str(room / f"depth/depth{number}.png"), np.ones((24, 32), np.uint16))
    with pytest.raises(DataError, match=r"img8\.png is 32x24 but .*img0\.png is 64x48"):
        check_sequence(room)


def test_errors_are_the_readers(room: Path, tmp_path: Path) -> None:
    """Catches a check that reports on what cannot be read."""
    with pytest.raises(MissingError, match="nowhere"):
        check_sequence(tmp_path / "nowhere")
    with pytest.raises(MissingError, match="depth_filtered"):
        check_sequence(room, depth_folder="depth_filtered")
    poses = read_poses(room / "poses.txt")
    rewrite_poses(room, poses[:-1])
    with pytest.raises(DataError, match="15 poses"):
        check_sequence(room)
    rewrite_poses(room, np.full_like(poses, np.nan))
    with pytest.raises(DataError, match="NaN"):
        check_sequence(room)


def test_no_depth_at_all(tmp_path: Path) -> None:
    """Catches quantiles of nothing."""
    with pytest.raises(DataError, match="no pixel"):
        check_sequence(write_room(tmp_path / "room", walk(3), 0.0))


def test_text_of_the_report(room: Path) -> None:
    """Catches lines without a unit, ragged columns, and a warning that is not shown."""
    lines = str(check_sequence(room)).splitlines()
    assert lines[0] == "room"
    assert "  frames          16 (0 more without a pose)" in lines
    assert "  size            64 x 48 px" in lines
    assert "  focal length    56.00 px (59.5 deg wide)" in lines
    assert max(map(len, lines)) <= 100
    rewrite_poses(room, CONVENTIONS[1].from_opencv(walk(N_FRAMES)))
    assert "  warning: your poses look like OpenCV axes" in str(check_sequence(room))


@pytest.mark.skipif(not REAL_ROOM.is_dir(), reason="the real recording is not on this machine")
def test_real_recording() -> None:
    """Catches a wrong convention in the reader itself: real surfaces must meet within 2 cm."""
    report = check_sequence(REAL_ROOM)
    assert report.median_overlap_m < 0.02
    assert report.best is report.fits[0]
    assert report.warnings == ()
    others = [fit.relative for fit in report.fits[1:]]
    assert min(others) > 4 * report.fits[0].relative
