"""Every format is read back as it was written: poses, depth, colour, camera."""

import json
import sys
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import recordings
from PIL import Image
from recordings import CAMERA, N_FRAMES, WRITERS, Source, matrix_text, source, write_recording

from nbtrack.cli import main
from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.errors import ConfigError, DataError, MissingError
from nbtrack.recordings.formats import holds_recording
from nbtrack.recordings.images import images_of
from nbtrack.recordings.reading import parse_frames, read_frames, read_sequence, select_frames
from nbtrack.recordings.recording import open_recording
from nbtrack.recordings.writer import convert_sequence

LOSSY = ("replica", "scannet", "record3d", "polycam")  # colour is JPEG
STEPS = {"tum": 0.1, "record3d": 1 / 60, "polycam": 0.033333}  # s between frames, else 1/30


def check_equal(sequence, data: Source, lossy: bool = False) -> None:
    """The sequence is the source, to rounding; JPEG colours to a few levels on average."""
    np.testing.assert_allclose(sequence.T_world_camera, data.poses, rtol=0, atol=1e-9)
    assert np.array_equal(sequence.depths_mm, data.depths_mm)
    difference = np.abs(sequence.colors.astype(int) - data.colors)
    assert difference.max() == 0 or (lossy and difference.mean() < 6)
    assert astuple(sequence.intrinsics) == pytest.approx(astuple(data.camera), abs=1e-9)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_recording("neural_rgbd", tmp_path / "scene")


@pytest.mark.parametrize("format", WRITERS)
def test_round_trip(tmp_path: Path, format: str) -> None:
    """Catches wrong axes, a wrong depth factor, half a pixel, swapped colours, a wrong guess; depth
    or poses that change on their way into the Neural RGB-D layout; times by the images' numbers
    where a phone gives others; and maps that are not made anew when images, times, poses,
    calibration or declaration change."""
    folder, out = write_recording(format, tmp_path / "recording"), tmp_path / "out"
    assert open_recording(folder).declared.format == format
    check_equal(read_sequence(folder), source(), format in LOSSY)
    part = read_sequence(folder, slice(1, 5, 2), format=format)
    assert part.frame_ids.tolist() == [1, 3]
    np.testing.assert_allclose(part.T_world_camera, source().poses[1:5:2], atol=1e-9)
    assert main(["data", "convert", str(folder), str(out), "--format", format]) == 0
    assert open_recording(out).declared.format == "neural_rgbd"
    check_equal(read_sequence(out), source(), format in LOSSY)
    assert (out / "focal.txt").is_file()
    assert not (out / "intrinsics.txt").exists()
    recording = open_recording(folder)
    assert np.diff(recording.times) == pytest.approx(STEPS.get(format, 1 / 30), abs=1e-6)
    other = recording.color_files[1:] + recording.color_files[:1]
    changes = (
        {"times": recording.times + 1}, {"file_poses": 2 * recording.file_poses},
        {"calibration": replace(recording.calibration, fx=9.0)}, {"color_files": other},
        {"declared": replace(recording.declared, depth_scale=9.0)},
    )  # fmt: skip
    seen = {str(images_of(replace(recording, **change)).contents()) for change in changes}
    seen |= {str(images_of(each).contents()) for each in (open_recording(folder), recording)}
    assert len(seen) == len(changes) + 1


def test_depth_and_poses_of_a_phone(tmp_path: Path, monkeypatch) -> None:
    """Catches compressed depth that is read as numbers, or refused without a way out; and images
    of a cut recording that get the poses of others, where stamps have another rate than numbers."""
    folder = write_recording("record3d", tmp_path / "r")
    for path in folder.glob("rgbd/[345].*"):
        path.unlink()
    np.testing.assert_allclose(open_recording(folder).T_world_camera, source().poses[:3], atol=1e-9)
    times = np.array([0, 2, 3]) / 60  # of the images, on the clock of the poses
    np.savetxt(folder / "timestamps.txt", times)
    poses = source().poses[[0, 2, 3]]
    np.testing.assert_allclose(open_recording(folder).T_world_camera, poses, atol=1e-9)
    (folder / "timestamps.txt").unlink()
    for path in (folder / "rgbd").glob("*.depth"):
        path.write_bytes(b"bvx2" + path.read_bytes())
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(DataError, match="pip install pyliblzfse"):
        read_sequence(folder)
    reader = SimpleNamespace(decompress=lambda content: content[4:])
    monkeypatch.setitem(sys.modules, "liblzfse", reader)
    assert np.array_equal(read_sequence(folder).depths_mm, source().depths_mm[:3])


def test_a_sequence(scene: Path) -> None:
    """Catches frames selected in file order, and copies of what could be shared."""
    sequence = read_sequence(scene)
    chosen = sequence.select(np.array([2, 0]))
    assert chosen.frame_ids.tolist() == [2, 0]
    check_equal(chosen, Source(*(a[[2, 0]] for a in source()[:3])))
    assert np.shares_memory(sequence.select(slice(1, 3)).colors, sequence.colors)


def test_frames_without_a_pose_are_left_out_and_counted(scene: Path, tmp_path: Path) -> None:
    """Catches NaN poses, or ScanNet's -inf, that reach the optimizer, images that slip against the
    poses, and numbers that are lost where it is converted."""
    lines = (scene / "poses.txt").read_text().splitlines(keepends=True)
    lines[4:8], lines[16:20] = 4 * ["nan nan nan nan\n"], 4 * ["-inf -inf -inf -inf\n"]
    (scene / "poses.txt").write_text("".join(lines))
    said = convert_sequence(open_recording(scene), tmp_path / "out")
    assert "6 frames (2 without a pose) of 48x36, read as Neural" in said
    for folder in (scene, tmp_path / "out"):
        sequence = read_sequence(folder)
        assert sequence.frame_ids.tolist() == [0, 2, 3, 5]
        assert np.isfinite(sequence.T_world_camera).all()
        assert np.array_equal(sequence.colors, source().colors[[0, 2, 3, 5]])
    assert read_sequence(scene, slice(0, 3)).frame_ids.tolist() == [0, 2]
    assert len(select_frames(open_recording(scene), slice(None), needs_poses=False)) == 6


@pytest.mark.parametrize("text", ["", "5", "a:b", "1:2:3:4", "1.5:2", "0:10:0", "0:10:-1"])
def test_text_that_is_no_slice(text: str) -> None:
    """Catches a misread range: a single number, a step that stands still or goes back."""
    with pytest.raises(DataError, match=f"^frames '{text}' .*: "):
        parse_frames(text)


def test_depth_folder_and_pose_file_are_chosen(scene: Path) -> None:
    """Catches a choice that is ignored or replaced, and a default that prefers the wrong depth."""
    moved = source().poses.copy()
    moved[:, 0, 3] += 1
    other = source()._replace(depths_mm=source().depths_mm + 1, poses=moved)
    folder = write_recording("neural_rgbd", scene.parent / "other", other)
    (folder / "depth_filtered").rename(scene / "depth")
    (folder / "poses.txt").rename(scene / "other.txt")
    check_equal(read_sequence(scene), source())
    # A folder may lie anywhere.
    chosen = {"depth_folder": str(scene / "depth"), "pose_file": "other.txt"}
    check_equal(read_sequence(scene, **chosen), other)
    with pytest.raises(MissingError, match=r"no depth maps .* needs depth_with_noise/\*"):
        read_sequence(scene, depth_folder="depth_with_noise")
    with pytest.raises(MissingError, match=r"needs pose\.txt;"):
        read_sequence(scene, pose_file="pose.txt")


def test_poses_of_a_plain_folder(plain: Path) -> None:
    """Catches pose files of one shape read as another, and a single frame whose time, as that of
    its pose, is not a number."""
    T = source().poses
    (plain / "poses").mkdir()
    (plain / "trajectory.txt").unlink()
    for texts in (
        {"poses.txt": matrix_text(T.reshape(-1, 16))},
        {"poses.txt": matrix_text(T[:, :3].reshape(-1, 12)).replace(" ", ", ")},
        {"poses.txt": matrix_text(T.reshape(-1, 4))},
        # As Open3D writes them: three numbers before each matrix.
        {"trajectory.log": "".join(f"{i} {i} {i + 1}\n{matrix_text(T[i])}" for i in range(len(T)))},
        {f"poses/{i:04}.txt": matrix_text(pose) for i, pose in enumerate(T)},
    ):
        for name, text in texts.items():
            (plain / name).write_text(text)
        check_equal(read_sequence(plain), source())
        for name in texts:
            (plain / name).unlink()
    one = recordings.write_matrices(plain.parent / "one", source(n_frames=1))
    assert open_recording(one).times == [0]


ENCODINGS = 2 * ["utf-16", "utf-8-sig", "utf-32", "utf-16-le"]


@pytest.mark.parametrize(("format", "encoding"), [*zip(WRITERS, ENCODINGS, strict=True)])
def test_texts_say_how_they_are_encoded(tmp_path: Path, format: str, encoding: str) -> None:
    """Catches the texts that Windows PowerShell writes, refused as no text or no TOML."""
    folder = write_recording(format, tmp_path / "r" / "r")
    (folder / "sequence.toml").write_text("no_depth = 9\n")
    for path in tmp_path.rglob("*.*"):
        if path.suffix in (".txt", ".json", ".toml"):
            text = path.read_text().replace("\n", "\r\n").replace(" rgb/", " rgb\\")
            mark = "\ufeff" if encoding == "utf-16-le" else ""
            path.write_bytes((mark + text).encode(encoding))
    check_equal(read_sequence(folder), source(), format in LOSSY)
    assert open_recording(folder).declared.no_depth == (9,)


def test_cameras_of_other_names(scene: Path, tmp_path: Path) -> None:
    """Catches a calibration that is passed over: 7-Scenes' own, one folder up too, and K.txt."""
    (scene / "focal.txt").rename(scene / "K.txt")
    (scene / "K.txt").write_text(matrix_text(recordings.camera_matrix(CAMERA)))
    check_equal(read_sequence(scene), source())
    folder = write_recording("7scenes", tmp_path / "chess/seq-01")
    (note,) = open_recording(folder).notes
    assert note.startswith("the camera assumed for 7-Scenes, 585 px at 640x480: no intrinsics")
    for number, place in enumerate((folder.parent, folder)):
        camera = replace(CAMERA, fx=40.0 + number)
        (place / "camera-intrinsics.txt").write_text(matrix_text(recordings.camera_matrix(camera)))
        check_equal(read_sequence(folder), source()._replace(camera=camera))
    assert open_recording(folder).notes == []


def test_calibration_by_the_folders_name(tmp_path: Path) -> None:
    """Catches another camera's numbers, the half pixel, a lens taken out of depth, where the
    benchmark has a pinhole camera, and an assumption or images left out in silence."""
    folder = write_recording("tum", tmp_path / "rgbd_dataset_freiburg3_desk")
    (folder / "calibration.txt").unlink()
    sequence = read_sequence(folder)
    assert sequence.intrinsics.fx == pytest.approx(535.4 * 48 / 640)
    assert sequence.intrinsics.cy == pytest.approx((247.6 + 0.5) * 48 / 640)
    assert np.array_equal(sequence.depths_mm, source().depths_mm)
    said = convert_sequence(open_recording(folder), tmp_path / "out")
    assert "assumed for TUM RGB-D, 535.4 px at 640x480" in said
    assert "1 of the 7 images in rgb.txt are left out: no depth map of depth.txt" in said


def test_everything_declared_otherwise(tmp_path: Path) -> None:
    """Catches a key of `sequence.toml` that is ignored, or applied the wrong way round, and one
    that a converted recording needs once more."""
    data = source()
    # In quarters of a millimetre, with the error of a camera.
    in_quarters = recordings.depth(lambda d: 4.0 * d)(data)
    short_by = recordings.short(0.0012 / 4)(in_quarters)
    raw = recordings.along_rays(short_by).depths_mm
    raw[data.depths_mm == 0] = 60000
    recordings.write_images(tmp_path, data._replace(depths_mm=raw), "image/{:06}.png")
    opengl = np.linalg.inv(data.poses @ np.diag([1.0, -1, -1, 1]))
    lines = recordings.tum_lines(np.arange(N_FRAMES) / 10, opengl, "wxyz")
    (tmp_path / "poses.txt").write_text(lines)
    matrix = recordings.camera_matrix(CAMERA).T.ravel().tolist()  # by columns, as Open3D writes it
    open3d = {"width": 48, "height": 36, "intrinsic_matrix": matrix}
    (tmp_path / "camera_primesense.json").write_text(json.dumps(open3d))
    (tmp_path / "sequence.toml").write_text(
        'depth_scale = 4000\nno_depth = 60000\ndepth_along = "ray"\ncamera_axes = "opengl"\n'
        'poses = "world-to-camera"\nquaternion = "wxyz"\nframe_rate = 10\n'
        "depth_error_per_m = 0.0012\n"
    )
    check_equal(read_sequence(tmp_path), data)
    convert_sequence(open_recording(tmp_path), tmp_path / "converted")
    check_equal(read_sequence(tmp_path / "converted"), data)
    assert open_recording(tmp_path).times == pytest.approx(np.arange(N_FRAMES) / 10)


def test_a_lens_is_corrected(tmp_path: Path) -> None:
    """Catches a correction that goes the wrong way: a distorted grid must come out straight.

    A lens with k1 < 0 pulls the corners inwards: what a pinhole camera shows at x = 0.5 it shows
    at x (1 + k1 x²) = 0.475.
    """
    depth, color = np.full((1, 160, 200), 1000, np.uint16), np.zeros((1, 160, 200, 3), np.uint8)
    depth[..., round(100 + 100 * 0.475) :] = 2000
    data = Source(color, depth, np.eye(4)[None], Intrinsics.from_focal(200, 160, 100.0))
    folder = write_recording("plain", tmp_path / "r", data)
    recordings.change_camera(folder, distortion=[-0.2, 0, 0, 0])
    row = read_sequence(folder).depths_mm[0, 80]
    assert abs(int((row == 1000).sum()) - 150) <= 1


def test_formats_are_told_apart(plain: Path, tmp_path: Path) -> None:
    """Catches a guess where two formats are whole, a declared format ignored, a misspelt name."""
    write_recording("7scenes", tmp_path / "seven")
    for path in (tmp_path / "seven").iterdir():
        path.rename(plain / path.name)
    with pytest.raises(DataError, match=r"read as 7scenes or plain: choose with --format"):
        read_sequence(plain)
    check_equal(read_sequence(plain, format="7scenes"), source())
    (plain / "sequence.toml").write_text('format = "plain"\n')
    assert open_recording(plain).declared.format == "plain"
    with pytest.raises(ConfigError, match="did you mean 'replica'"):
        read_sequence(plain, format="replika")
    with pytest.raises(MissingError, match=r"needs the files of neural_rgbd"):
        read_sequence(tmp_path / "seven")
    (tmp_path / "seven/1.color.png").touch()
    assert (holds_recording(plain), holds_recording(tmp_path / "seven")) == (True, False)


def test_a_lens_by_any_name(plain: Path) -> None:
    """Catches a lens that a camera file gives under another name and that is ignored in silence, or
    one without distortion that is refused for its name."""
    seen = [read_sequence(plain).depths_mm]
    lens = [0.5, -2.7, 0.001, -0.002, 1.6, 0.4, -2.5, 1.5]
    named = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), lens, strict=True))
    for words in (
        {"distortion": lens},
        {"distortion": None, "coeffs": lens},
        {"coeffs": None, "D": lens},
        {"D": None, **named, "distortion_model": "rational_polynomial", "skew": 0},
    ):
        recordings.change_camera(plain, **words)
        seen.append(read_sequence(plain).depths_mm)
    assert (seen[0] != seen[1]).any()
    assert all(np.array_equal(seen[1], depths) for depths in seen[2:])
    recordings.change_camera(plain, **dict.fromkeys(named), coeffs=[0] * 5, model="fisheye")
    assert np.array_equal(read_sequence(plain).depths_mm, seen[0])  # a lens that does nothing
    recordings.change_camera(plain, tangential=[0, 0.1])
    with pytest.raises(DataError, match=r"tangential is .*, which is not used"):
        read_sequence(plain)


@pytest.mark.parametrize("scale", [{"depth_scale": 4000}, {"scale": 4000.0}, {"scale": 0.00025}])
def test_a_unit_of_depth_in_a_camera_file(plain: Path, scale: dict[str, float]) -> None:
    """Catches a unit that is ignored, or that is stronger than the declaration; what is not used of
    the file is named."""
    before = read_sequence(plain).depths_mm
    recordings.change_camera(plain, **scale, serial="17", parts=[[1], [1, 2]])
    np.testing.assert_allclose(read_sequence(plain).depths_mm, before / 4, atol=1)
    assert "not used of intrinsics.json: parts, serial" in open_recording(plain).notes
    (plain / "sequence.toml").write_text("depth_scale = 2000")
    np.testing.assert_allclose(read_sequence(plain).depths_mm, before / 2, atol=1)


def test_images_of_other_sizes(plain: Path) -> None:
    """Catches full-size intrinsics used for reduced images (of cropped ones: BROKEN), the refusal
    of what LiDAR phones record, and a calibration of no size that is taken for any."""
    large = recordings.larger(source(), 4)
    recordings.change_camera(plain, **recordings.camera_words(large.camera, "width", "height"))
    for notes in ([], ["colour is made as small as depth: 192x144 and 48x36"]):
        recording = open_recording(plain)
        check_equal(read_frames(recording), source())
        assert recording.notes == notes
        recordings.write_images(plain, large)
    recordings.change_camera(plain, width=None, height=None)
    with pytest.raises(DataError, match=r"192x144 and 48x36, and .* does not say which"):
        read_sequence(plain)


def test_images_as_cameras_write_them(plain: Path) -> None:
    """Catches colours that a viewer's mark turns against their depth, a JPEG that is called damaged
    for what a camera has appended, saturated depth that is taken for a wall 65 m away, and gray
    images refused or copied into one channel."""
    before = read_sequence(plain)
    for path in sorted((plain / "color").iterdir()):
        mark = Image.Exif()
        mark[0x0112] = 3  # "turn by 180 degrees"
        jpeg = path.with_suffix(".jpg")
        Image.open(path).save(jpeg, exif=mark, quality=100, subsampling=0)
        jpeg.write_bytes(jpeg.read_bytes() + bytes(4096))
        path.unlink()
    after = read_sequence(plain)
    assert np.abs(after.colors.astype(int) - before.colors).mean() < 3
    depth = before.depths_mm[0].copy()
    depth[:9] = 65535
    recordings.write_image(plain / "depth/000000.png", depth)
    after = read_sequence(plain)
    assert (after.depths_mm[0, :9] == 0).all()
    assert (after.depths_mm[0, 9:] == before.depths_mm[0, 9:]).all()
    cv2.imwrite(str(plain / "color/000000.jpg"), np.full((36, 48), 77, np.uint8))
    assert (read_sequence(plain).colors[0] == 77).all()
    jpeg.write_bytes(jpeg.read_bytes()[: jpeg.stat().st_size // 2 - 2048])
    with pytest.raises(DataError, match="readable PNG or JPEG"):
        read_sequence(plain)
