"""Every format is read back as it was written: poses, depth, colour, camera."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import (
    CAMERA,
    N_FRAMES,
    START,
    WRITERS,
    Source,
    camera_matrix,
    matrix_text,
    source,
    tum_lines,
    write_image,
    write_images,
    write_recording,
)
from test_lm import ExactRoom

from nbtrack.cli import main
from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import PRESETS, ScenesConfig
from nbtrack.core.errors import ConfigError, DataError, MissingError
from nbtrack.data.convert import convert_sequence
from nbtrack.data.readers import FORMATS, Format, open_recording, register
from nbtrack.data.sequence import RgbdSequence, read_sequence
from nbtrack.data.writer import SequenceWriter
from nbtrack.experiments.scenes import Scene, find_scene
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.metrics import trajectory_metrics
from nbtrack.tracking.sequence import track_sequence

pytestmark = pytest.mark.usefixtures("one_thread")
LOSSY = ("replica", "scannet")  # colour is JPEG


def check_equal(sequence: RgbdSequence, data: Source, lossy: bool = False) -> None:
    """The sequence is the source, to rounding; JPEG colours to a few levels on average."""
    np.testing.assert_allclose(sequence.T_world_camera, data.poses, rtol=0, atol=1e-9)
    assert np.array_equal(sequence.depths_mm, data.depths_mm)
    difference = np.abs(sequence.colors.astype(int) - data.colors)
    assert difference.max() == 0 or (lossy and difference.mean() < 6)
    found, wanted = sequence.intrinsics, data.camera
    assert (found.width, found.height) == (wanted.width, wanted.height)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), abs=1e-9), name


@pytest.mark.parametrize("format", WRITERS)
def test_round_trip(tmp_path: Path, format: str) -> None:
    """Catches wrong axes, a wrong depth factor, half a pixel, swapped colours, a wrong guess."""
    folder = write_recording(format, tmp_path / "recording")
    assert open_recording(folder).declared.format == format
    check_equal(read_sequence(folder), source(), format in LOSSY)
    check_equal(read_sequence(folder, format=format), source(), format in LOSSY)
    part = read_sequence(folder, slice(1, 5, 2))
    assert part.frame_ids.tolist() == [1, 3]
    np.testing.assert_allclose(part.T_world_camera, source().poses[1:5:2], atol=1e-9)


@pytest.mark.parametrize("format", WRITERS)
def test_converted_is_the_same(tmp_path: Path, format: str) -> None:
    """Catches depth or poses that change on their way into the layout."""
    folder = write_recording(format, tmp_path / "recording")
    out = tmp_path / "out"
    assert main(["data", "convert", str(folder), str(out), "--format", format]) == 0
    assert open_recording(out).declared.format == "neural_rgbd"
    check_equal(read_sequence(out), source(), format in LOSSY)
    assert (out / "focal.txt").is_file()
    assert not (out / "intrinsics.txt").exists()


def track(sequence: RgbdSequence) -> np.ndarray:
    """Poses found by the second-order tracker in the room's exact distance, without colour."""
    config = replace(PRESETS["smoke"].tracking["lm"], lambda_color=0.0, n_pixels=200)
    return track_sequence(
        "lm", ExactRoom("living_room"), sequence, StepBudget(4), config
    ).T_estimated


def test_tracking_is_the_same_in_every_format(tmp_path: Path) -> None:
    """Catches whatever a reader changes that a comparison of arrays does not show."""
    errors = {}
    for format in WRITERS:
        sequence = read_sequence(write_recording(format, tmp_path / format / "recording"))
        errors[format] = trajectory_metrics(track(sequence), source().poses).ate_rmse_m
    assert errors["neural_rgbd"] < 0.02
    for format, error in errors.items():
        # Colour has no weight, but JPEG's still moves the last digits.
        tolerance = 1e-5 if format in LOSSY else 1e-7
        assert error == pytest.approx(errors["neural_rgbd"], abs=tolerance), format


PLAIN_TEXTS = {
    "4x4 in a line": lambda f, d: (f / "poses.txt").write_text(
        matrix_text(d.poses.reshape(-1, 16))
    ),
    "3x4 in a line": lambda f, d: (f / "poses.txt").write_text(
        matrix_text(d.poses[:, :3].reshape(-1, 12)).replace(" ", ", ")
    ),
    "a file a frame": lambda f, d: [
        (f / "poses").mkdir(),
        *((f / f"poses/{i:04}.txt").write_text(matrix_text(p)) for i, p in enumerate(d.poses)),
    ],
    "BOM and CRLF": lambda f, d: (f / "trajectory.txt").write_bytes(
        b"\xef\xbb\xbf# timestamp ...\r\n" + tum_lines(np.zeros(N_FRAMES), d.poses)
        .replace("\n", "\r\n").encode()
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", PLAIN_TEXTS)
def test_poses_of_a_plain_folder(tmp_path: Path, case: str) -> None:
    """Catches pose files of one shape read as another, and Windows line ends refused."""
    write_images(tmp_path, source())
    (tmp_path / "intrinsics.txt").write_text(matrix_text(camera_matrix(CAMERA)))
    PLAIN_TEXTS[case](tmp_path, source())
    check_equal(read_sequence(tmp_path), source())


def test_everything_declared_otherwise(tmp_path: Path) -> None:
    """Catches a key of `sequence.toml` that is ignored, or applied the wrong way round."""
    data = source()
    rows, columns = np.indices(data.depths_mm.shape[1:])
    x, y = (columns + 0.5 - CAMERA.cx) / CAMERA.fx, (rows + 0.5 - CAMERA.cy) / CAMERA.fy
    raw = np.rint(4 * data.depths_mm * np.sqrt(1 + x**2 + y**2)).astype(np.uint16)
    raw = np.where(data.depths_mm == 0, np.uint16(60000), raw)
    write_images(tmp_path, data._replace(depths_mm=raw))
    opengl = np.linalg.inv(data.poses @ np.diag([1.0, -1, -1, 1]))
    (tmp_path / "poses.txt").write_text(tum_lines(np.arange(N_FRAMES) / 10, opengl, "wxyz"))
    K = camera_matrix(CAMERA)
    open3d = {"width": 48, "height": 36, "intrinsic_matrix": K.T.ravel().tolist()}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(open3d))
    (tmp_path / "sequence.toml").write_text(
        'depth_scale = 4000\nno_depth = 60000\ndepth_along = "ray"\ncamera_axes = "opengl"\n'
        'poses = "world-to-camera"\nquaternion = "wxyz"\nframe_rate = 10\n'
    )
    check_equal(read_sequence(tmp_path), data)
    assert open_recording(tmp_path).rate_hz == 10


@pytest.mark.parametrize("axes", ["forward left up", "right up forward"])
def test_axes_in_words(tmp_path: Path, axes: str) -> None:
    """Catches axes of robots and left-handed engines misread: the motion must be the same."""
    data = source()
    rows = {"forward": [0, 0, 1.0], "left": [-1.0, 0, 0], "right": [1.0, 0, 0], "up": [0, -1.0, 0]}
    T_file_opencv = np.eye(4)
    T_file_opencv[:3, :3] = [rows[word] for word in axes.split()]
    mirror = np.eye(4) if np.linalg.det(T_file_opencv) > 0 else np.diag([1.0, 1, -1, 1])
    poses = mirror @ data.poses @ np.linalg.inv(T_file_opencv)
    folder = write_recording("plain", tmp_path / "r", data)
    (folder / "trajectory.txt").write_text(matrix_text(poses.reshape(-1, 16)))
    (folder / "sequence.toml").write_text(f'camera_axes = "{axes}"\n')
    check_equal(read_sequence(folder), data)


def test_own_trajectory_names_frames_by_time(tmp_path: Path) -> None:
    """Catches a trajectory without its first frame that slips by one."""
    folder = write_recording("plain", tmp_path / "r")
    text = tum_lines(np.arange(1, N_FRAMES) / 30, source().poses[1:])
    (folder / "trajectory.txt").write_text(text)
    sequence = read_sequence(folder)
    assert sequence.frame_ids.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(sequence.T_world_camera, source().poses[1:], atol=1e-9)


def test_times_of_tum(tmp_path: Path) -> None:
    """Catches streams paired by position: odd images, and poses of other moments, are left out."""
    folder = write_recording("tum", tmp_path / "r")
    recording = open_recording(folder)
    np.testing.assert_allclose(recording.times, START + np.arange(N_FRAMES) / 10, atol=1e-5)
    assert recording.rate_hz == pytest.approx(10, abs=1e-3)
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:2] + lines[4:]) + "\n")
    sequence = read_sequence(folder)  # the first pose is gone, and with it the first frame
    assert sequence.frame_ids.tolist() == [1, 2, 3, 4, 5]
    assert sequence.excluded_frames == 1
    np.testing.assert_allclose(sequence.T_world_camera, source().poses[1:], atol=1e-9)


@pytest.mark.parametrize(("camera", "fx", "cy"), [("1", 517.3, 255.3), ("3", 535.4, 247.6)])
def test_calibration_by_the_folders_name(tmp_path: Path, camera: str, fx: float, cy: float) -> None:
    """Catches another camera's numbers, the half pixel, and a lens that is not corrected."""
    folder = write_recording("tum", tmp_path / f"rgbd_dataset_freiburg{camera}_desk")
    (folder / "calibration.txt").unlink()
    sequence = read_sequence(folder)
    assert sequence.intrinsics.fx == pytest.approx(fx * 48 / 640)
    assert sequence.intrinsics.cy == pytest.approx((cy + 0.5) * 48 / 640)
    is_straight = np.array_equal(sequence.depths_mm, source().depths_mm)
    assert is_straight == (camera == "3")


def test_a_lens_is_corrected(tmp_path: Path) -> None:
    """Catches a correction that goes the wrong way: a distorted grid must come out straight.

    A lens with k1 < 0 pulls the corners inwards: what a pinhole camera shows at x = 0.5 it shows
    at x (1 + k1 x²) = 0.475.
    """
    camera = Intrinsics.from_focal(200, 160, 100.0)
    depth = np.full((160, 200), 1000, np.uint16)
    depth[:, round(100 + 100 * 0.475) :] = 2000
    color = np.zeros((160, 200, 3), np.uint8)
    data = Source(color[None], depth[None], np.eye(4)[None], camera)
    folder = write_recording("plain", tmp_path / "r", data)
    content = json.loads((folder / "intrinsics.json").read_text())
    content["distortion"] = [-0.2, 0, 0, 0]
    (folder / "intrinsics.json").write_text(json.dumps(content))
    row = read_sequence(folder).depths_mm[0, 80]
    assert abs(int((row == 1000).sum()) - 150) <= 1


def test_poses_that_are_not_there(tmp_path: Path) -> None:
    """Catches ScanNet's -inf and a line of NaN taken for poses."""
    folder = write_recording("scannet", tmp_path / "scannet")
    (folder / "pose/2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    assert read_sequence(folder).frame_ids.tolist() == [0, 1, 3, 4, 5]
    folder = write_recording("replica", tmp_path / "replica" / "r")
    lines = (folder / "traj.txt").read_text().splitlines()
    lines[0] = " ".join(["nan"] * 16)
    (folder / "traj.txt").write_text("\n".join(lines))
    sequence = read_sequence(folder)
    assert sequence.frame_ids.tolist() == [1, 2, 3, 4, 5]
    out = tmp_path / "out"
    converted = convert_sequence(folder, out)
    assert (converted.frames, converted.without_pose) == (6, 1)
    assert read_sequence(out).frame_ids.tolist() == [1, 2, 3, 4, 5]


def test_camera_that_the_layout_cannot_say(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches a focal length or a principal point that is dropped in silence."""
    camera = Intrinsics(48, 36, 43.0, 44.5, 25.25, 17.0)
    folder = write_recording("plain", tmp_path / "r", source()._replace(camera=camera))
    out = tmp_path / "out"
    assert main(["data", "convert", str(folder), str(out)]) == 0
    assert "more than focal.txt can say: it is in intrinsics.txt" in capsys.readouterr().out
    assert not (out / "focal.txt").exists()
    check_equal(read_sequence(out), source()._replace(camera=camera))


def test_converter_refuses_and_selects(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches an overwritten folder, and a slice that is ignored."""
    folder = write_recording("7scenes", tmp_path / "r")
    assert main(["data", "convert", str(folder), str(tmp_path / "out"), "--frames", "2:5"]) == 0
    assert np.array_equal(read_sequence(tmp_path / "out").depths_mm, source().depths_mm[2:5])
    capsys.readouterr()
    assert main(["data", "convert", str(folder), str(tmp_path / "out")]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["data", "convert", str(folder), str(tmp_path / "new"), "--frames", "9:"]) == 2
    assert "select nothing of the 6 frames" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_calibration_for_another_size(tmp_path: Path) -> None:
    """Catches full-size intrinsics used for reduced images, and cropped images scaled."""
    folder = write_recording("plain", tmp_path / "r")
    content = json.loads((folder / "intrinsics.json").read_text())
    large = {
        "w": 96, "h": 72, "fx": 2 * CAMERA.fx, "fy": 2 * CAMERA.fy, "cx": 47.5, "cy": 35.5
    }  # fmt: skip
    (folder / "intrinsics.json").write_text(json.dumps(large))
    check_equal(read_sequence(folder), source())
    (folder / "intrinsics.json").write_text(json.dumps(content | {"height": 40}))
    with pytest.raises(DataError, match=r"48x36 but .* is for 48x40"):
        read_sequence(folder)


def test_formats_are_told_apart(tmp_path: Path) -> None:
    """Catches a guess where two formats are whole, a declared format ignored, a misspelt name."""
    folder = write_recording("plain", tmp_path / "both")
    write_recording("7scenes", tmp_path / "seven")
    for path in (tmp_path / "seven").iterdir():
        path.rename(folder / path.name)
    with pytest.raises(DataError, match=r"7scenes|plain.*--format"):
        read_sequence(folder)
    check_equal(read_sequence(folder, format="7scenes"), source())
    (folder / "sequence.toml").write_text('format = "plain"\n')
    assert open_recording(folder).declared.format == "plain"
    with pytest.raises(ConfigError, match="did you mean 'replica'"):
        read_sequence(folder, format="replika")
    with pytest.raises(MissingError, match="like no known recording: it needs the files of neural"):
        read_sequence(tmp_path / "seven")
    with pytest.raises(MissingError, match="no folder"):
        read_sequence(tmp_path / "nowhere")


def test_a_new_format_is_one_registration(tmp_path: Path, monkeypatch) -> None:
    """Catches formats listed anywhere but in the registry."""
    monkeypatch.setattr("nbtrack.data.readers.base.FORMATS", formats := dict(FORMATS))
    own = Format("own", "own", ("own.txt",), FORMATS["plain"].open)
    register(own)
    folder = write_recording("plain", tmp_path / "r")
    assert formats["own"] is own
    check_equal(read_sequence(folder, format="own"), source())
    with pytest.raises(ConfigError, match="registered twice"):
        register(own)


def test_scenes_of_every_format(tmp_path: Path) -> None:
    """Catches maps that are not made anew when poses, calibration or declaration change."""
    for format in WRITERS:
        folder = write_recording(format, tmp_path / format / "r")
        scene = find_scene(str(folder), ScenesConfig(), format=format)
        assert scene.frame_numbers("1:4") == range(1, 4)
        assert len(scene.read(slice(0, 2))) == 2
        seen = {scene.fingerprint, Scene("r", folder).fingerprint}
        assert len(seen) == 1, format
        for text in open_recording(folder).text_files:
            text.write_text(text.read_text() + "\n")
            seen.add(Scene("r", folder).fingerprint)
        (folder / "sequence.toml").write_text("frame_rate = 5\n")
        seen.add(Scene("r", folder).fingerprint)
        n_texts = len(open_recording(folder).text_files)
        assert len(seen) == 1 + n_texts, format


def test_tracking_command_reads_any_format(tmp_path: Path, monkeypatch, capsys) -> None:
    """Catches a --format that the command line drops on its way to map and track."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    folder = write_recording("tum", tmp_path / "r")
    command = [
        "track", str(folder), "--field", "neus", "--tracker", "sdf", "--steps", "1",
        "--set", "mapping.neus.iterations=2", "--set", "mapping.neus.n_rays=8",
        "--set", "network.neus.width=16", "--set", "tracking.sdf.n_pixels=16",
    ]  # fmt: skip
    assert main([*command, "--format", "tum"]) == 0
    capsys.readouterr()
    assert main([*command, "--format", "plain"]) == 2
    assert "no images in" in capsys.readouterr().err


def test_depth_too_far_for_16_bits(tmp_path: Path) -> None:
    """Catches a depth that wraps around; a wrong scale must say so."""
    folder = write_recording("plain", tmp_path / "r")
    (folder / "sequence.toml").write_text("depth_scale = 1\n")
    with pytest.raises(DataError, match=r"1 depth values a metre: at most 65\.535 m"):
        read_sequence(folder)


def test_writer_keeps_a_camera_of_its_own(tmp_path: Path) -> None:
    """Catches the layout's writer dropping fy or the principal point."""
    camera = Intrinsics(8, 6, 7.0, 7.5, 4.0, 3.0)
    with SequenceWriter(tmp_path / "r", camera, ("depth",)) as writer:
        writer.add(np.zeros((6, 8, 3), np.uint8), {"depth": np.ones((6, 8), np.uint16)}, np.eye(4))
    assert read_sequence(tmp_path / "r").intrinsics == camera


def test_gray_images_are_colours(tmp_path: Path) -> None:
    """Catches one-channel images refused, or copied into one channel only."""
    folder = write_recording("plain", tmp_path / "r")
    cv2.imwrite(str(folder / "color/000000.png"), np.full((36, 48), 77, np.uint8))
    assert (read_sequence(folder).colors[0] == 77).all()
    write_image(folder / "color/000001.png", source().colors[1])
