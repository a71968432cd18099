"""Sequences on disk: what is written is read back, and what is damaged is named."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbtrack.core.camera import Intrinsics, swap_opengl_opencv
from nbtrack.core.errors import DataError, MissingError, NbtrackError
from nbtrack.data.images import read_image
from nbtrack.data.readers.neural_rgbd import read_focal, read_poses
from nbtrack.data.sequence import RgbdSequence, parse_frames, read_sequence
from nbtrack.data.writer import SequenceWriter

CAMERA = Intrinsics.from_focal(12, 8, 10.123456789012345)


def random_frames(n_frames: int, camera: Intrinsics = CAMERA):
    """Colors, two kinds of depth and poses: noise shows every mixed-up pixel."""
    rng = np.random.default_rng(0)
    shape = (n_frames, camera.height, camera.width)
    colors = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    depths = rng.integers(0, 1 << 16, (2, *shape), dtype=np.uint16)
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    poses[:, :3, :3] = Rotation.random(n_frames, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(n_frames, 3))
    return colors, depths, poses


def write_scene(folder: Path, n_frames: int, camera: Intrinsics = CAMERA):
    """A scene of noise with the depth folders `depth` and `depth_filtered`."""
    colors, depths, poses = random_frames(n_frames, camera)
    with SequenceWriter(folder, camera, ("depth", "depth_filtered")) as writer:
        for color, depth, filtered, pose in zip(colors, *depths, poses, strict=True):
            writer.add(color, {"depth": depth, "depth_filtered": filtered}, pose)
    return colors, depths, poses


def set_pose_rows(folder: Path, frame: int, rows: list[str]) -> None:
    """Replace the four rows of one frame."""
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[4 * frame : 4 * frame + 4] = rows
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")


NAN_ROWS = ["nan nan nan nan"] * 4


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_scene(tmp_path / "scene", 3)
    return tmp_path / "scene"


def test_round_trip(tmp_path: Path) -> None:
    """Catches swapped colors, lost depth bits, rounded poses and axes converted only one way."""
    colors, depths, poses = write_scene(tmp_path / "scene", 13)
    sequence = read_sequence(tmp_path / "scene")
    assert np.array_equal(sequence.colors, colors)
    assert np.array_equal(sequence.depths_mm, depths[1])
    np.testing.assert_allclose(sequence.T_world_camera, poses, rtol=0, atol=1e-12)
    assert sequence.intrinsics == CAMERA
    assert sequence.frame_ids.tolist() == list(range(13))
    assert (sequence.name, len(sequence), sequence.excluded_frames) == ("scene", 13, 0)
    assert repr(sequence) == "RgbdSequence('scene', 13 frames of 12x8)"


def test_file_holds_opengl_axes(scene: Path) -> None:
    """Catches a file in our own axes: on disk, y and z columns have the other sign."""
    on_disk = read_poses(scene / "poses.txt")
    inside = read_sequence(scene).T_world_camera
    np.testing.assert_array_equal(on_disk[:, :, [0, 3]], inside[:, :, [0, 3]])
    np.testing.assert_array_equal(on_disk[:, :, [1, 2]], -inside[:, :, [1, 2]])


def test_natural_order_with_unpadded_and_padded_numbers(tmp_path: Path) -> None:
    """Catches alphabetical order: img10 before img2 gives frames the poses of others."""
    colors, _, _ = write_scene(tmp_path / "scene", 12)
    names = sorted(path.name for path in (tmp_path / "scene/images").iterdir())
    assert names.index("img10.png") < names.index("img2.png")
    assert np.array_equal(read_sequence(tmp_path / "scene").colors[[2, 10]], colors[[2, 10]])
    for path in (tmp_path / "scene/images").iterdir():
        path.rename(path.with_name(f"frame-{int(path.stem[3:]):06}.color.png"))
    assert np.array_equal(read_sequence(tmp_path / "scene").colors, colors)


def test_frames_without_a_pose_are_left_out_and_counted(tmp_path: Path) -> None:
    """Catches NaN poses that reach the optimizer, and images that slip against the poses."""
    colors, _, _ = write_scene(tmp_path / "scene", 6)
    set_pose_rows(tmp_path / "scene", 1, NAN_ROWS)
    set_pose_rows(tmp_path / "scene", 4, NAN_ROWS)
    sequence = read_sequence(tmp_path / "scene")
    assert sequence.frame_ids.tolist() == [0, 2, 3, 5]
    assert sequence.excluded_frames == 2
    assert np.isfinite(sequence.T_world_camera).all()
    assert np.array_equal(sequence.colors, colors[[0, 2, 3, 5]])
    # Only the frames asked for count: of 0 to 2 one has no pose.
    assert read_sequence(tmp_path / "scene", slice(0, 3)).excluded_frames == 1


@pytest.mark.parametrize("text", [":", "2:", ":3", "1:5:2", "-2:", "::3", "3:100"])
def test_frame_slices_are_pythons(tmp_path: Path, text: str) -> None:
    """Catches a slice that is applied after NaN frames are gone, or an end that is included."""
    _, depths, _ = write_scene(tmp_path / "scene", 6)
    frames = parse_frames(text)
    sequence = read_sequence(tmp_path / "scene", frames)
    assert sequence.frame_ids.tolist() == list(range(6))[frames]
    assert np.array_equal(sequence.depths_mm, depths[1][frames])


def test_depth_folder_and_pose_file_are_chosen(tmp_path: Path) -> None:
    """Catches a choice that is ignored, and a default that prefers the wrong depth."""
    _, depths, poses = write_scene(tmp_path / "scene", 3)
    shifted = swap_opengl_opencv(poses)
    shifted[:, 0, 3] += 1
    np.savetxt(tmp_path / "scene/trainval_poses.txt", shifted.reshape(-1, 4), fmt="%.17g")
    sequence = read_sequence(tmp_path / "scene", slice(None), "depth", "trainval_poses.txt")
    assert np.array_equal(sequence.depths_mm, depths[0])
    offset = sequence.T_world_camera - read_sequence(tmp_path / "scene").T_world_camera
    np.testing.assert_allclose(offset[:, 0, 3], 1)
    shutil.rmtree(tmp_path / "scene/depth_filtered")
    assert np.array_equal(read_sequence(tmp_path / "scene").depths_mm, depths[0])


def test_units_of_a_frame_and_selection(scene: Path) -> None:
    """Catches a depth in millimetres, a color in 0 to 255, and frames selected in file order."""
    sequence = read_sequence(scene)
    np.testing.assert_allclose(sequence.depth(1), sequence.depths_mm[1] / 1000.0, rtol=1e-6)
    np.testing.assert_allclose(sequence.color(1) * 255, sequence.colors[1], atol=1e-4)
    chosen = sequence.select(np.array([2, 0]))
    assert chosen.frame_ids.tolist() == [2, 0]
    assert np.array_equal(chosen.colors, sequence.colors[[2, 0]])
    assert np.array_equal(chosen.T_world_camera, sequence.T_world_camera[[2, 0]])
    assert np.shares_memory(sequence.select(slice(1, 3)).colors, sequence.colors)


def remove_depth(scene: Path) -> None:
    (scene / "depth_filtered/depth2.png").unlink()


def rename_depth(scene: Path) -> None:
    (scene / "depth_filtered/depth2.png").rename(scene / "depth_filtered/depth7.png")


def shrink_depth(scene: Path) -> None:
    cv2.imwrite(str(scene / "depth_filtered/depth1.png"), np.ones((4, 6), np.uint16))


def eight_bit_depth(scene: Path) -> None:
    cv2.imwrite(str(scene / "depth_filtered/depth1.png"), np.ones((8, 12), np.uint8))


def shrink_color(scene: Path) -> None:
    cv2.imwrite(str(scene / "images/img2.png"), np.ones((4, 6, 3), np.uint8))


def cut_color(scene: Path) -> None:
    path = scene / "images/img1.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_color_that_still_ends_well(scene: Path) -> None:
    path = scene / "images/img1.png"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] + content[-12:])


def flip_a_bit_in_the_middle(scene: Path) -> None:
    path = scene / "depth_filtered/depth1.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def empty_color(scene: Path) -> None:
    (scene / "images/img1.png").write_bytes(b"")


def text_as_color(scene: Path) -> None:
    (scene / "images/img0.png").write_text("version https://git-lfs.github.com/spec/v1\n")


def cut_jpeg(scene: Path) -> None:
    encoded = cv2.imencode(".jpg", np.full((8, 12, 3), 99, np.uint8))[1].tobytes()
    (scene / "images/img1.png").unlink()
    (scene / "images/img1.jpg").write_bytes(encoded[: len(encoded) - 20])


def clear_images(scene: Path) -> None:
    shutil.rmtree(scene / "images")
    (scene / "images").mkdir()


def no_depth_folder(scene: Path) -> None:
    shutil.rmtree(scene / "depth")
    shutil.rmtree(scene / "depth_filtered")


def focal(text: str) -> Callable[[Path], None]:
    return lambda scene: (scene / "focal.txt").write_text(text) and None


def pose_row(row: str) -> Callable[[Path], None]:
    identity = ["1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    return lambda scene: set_pose_rows(scene, 1, [row, *identity[1:]])


def no_pose_at_all(scene: Path) -> None:
    for frame in range(3):
        set_pose_rows(scene, frame, NAN_ROWS)


def drop_last_pose(scene: Path) -> None:
    set_pose_rows(scene, 2, [])


def drop_last_row(scene: Path) -> None:
    set_pose_rows(scene, 2, ["1 0 0 0", "0 1 0 0", "0 0 1 0"])


BAD_SCENES = {
    "folder missing": (shutil.rmtree, MissingError, "scene"),
    "no images": (clear_images, MissingError, "scene/images"),
    "no depth folder": (no_depth_folder, MissingError, "scene"),
    "3 images, 2 depths": (remove_depth, DataError, "depth_filtered"),
    "other frame numbers": (rename_depth, DataError, "depth7.png"),
    "depth of another size": (shrink_depth, DataError, "depth1.png is 6x4"),
    "8-bit depth": (eight_bit_depth, DataError, "depth1.png is uint8"),
    "color of another size": (shrink_color, DataError, "img2.png is 6x4"),
    "color cut in half": (cut_color, DataError, "img1.png"),
    "middle cut out": (cut_color_that_still_ends_well, DataError, "img1.png"),
    "one bit flipped": (flip_a_bit_in_the_middle, DataError, "depth1.png"),
    "empty image": (empty_color, DataError, "img1.png is damaged or not a complete PNG or JPEG (0"),
    "text instead of an image": (text_as_color, DataError, "img0.png"),
    "JPEG cut short": (cut_jpeg, DataError, "img1.jpg"),
    "focal missing": (lambda scene: (scene / "focal.txt").unlink(), MissingError, "focal.txt"),
    "focal empty": (focal(" \n"), DataError, "focal.txt"),
    "focal negative": (focal("-525"), DataError, "focal.txt holds '-525'"),
    "focal zero": (focal("0"), DataError, "focal.txt"),
    "focal text": (focal("five hundred"), DataError, "focal.txt holds 'five hundred'"),
    "focal of two numbers": (focal("525\n525"), DataError, "focal.txt"),
    "poses missing": (lambda scene: (scene / "poses.txt").unlink(), MissingError, "poses.txt"),
    "poses empty": (lambda s: (s / "poses.txt").write_text("") and None, DataError, "poses.txt"),
    "pose row of 3 numbers": (pose_row("1 0 0"), DataError, "poses.txt line 5"),
    "pose row with a word": (pose_row("1 0 O 0"), DataError, "poses.txt line 5"),
    "a row too few": (drop_last_row, DataError, "poses.txt has 11 rows"),
    "a pose too few": (drop_last_pose, DataError, "poses.txt has 2 poses"),
    "all poses NaN": (no_pose_at_all, DataError, "poses.txt"),
    "scaled pose": (pose_row("2 0 0 0"), DataError, "poses.txt frame 1"),
    "mirrored pose": (pose_row("-1 0 0 0"), DataError, "poses.txt frame 1"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scene(scene: Path, case: str, capfd: pytest.CaptureFixture) -> None:
    """Catches garbage that is read in silence, a traceback, chatter, or an unnamed file."""
    damage, error_class, expected = BAD_SCENES[case]
    damage(scene)
    with pytest.raises(error_class) as caught:
        read_sequence(scene)
    check_message(caught.value, expected)
    assert capfd.readouterr() == ("", "")


def check_message(error: NbtrackError, expected: str) -> None:
    message = str(error)
    assert expected in message
    assert "\n" not in message
    assert ": " in message  # what was found: what is allowed


def test_named_parts_that_do_not_exist(scene: Path) -> None:
    """Catches a silent fallback to another depth folder or pose file than the one asked for."""
    with pytest.raises(MissingError) as caught:
        read_sequence(scene, depth_folder="depth_with_noise")
    check_message(caught.value, "depth_with_noise")
    with pytest.raises(MissingError) as caught:
        read_sequence(scene, pose_file="pose.txt")
    check_message(caught.value, "pose.txt")


def test_frame_range_that_selects_nothing(scene: Path) -> None:
    """Catches an empty sequence that fails somewhere in the mathematics later."""
    with pytest.raises(DataError) as caught:
        read_sequence(scene, slice(5, 9))
    check_message(caught.value, "5:9")
    assert "0:3" in str(caught.value)


@pytest.mark.parametrize("text", ["", "5", "a:b", "1:2:3:4", "1.5:2", "0:10:0", "0:10:-1", "1-5"])
def test_text_that_is_no_slice(text: str) -> None:
    """Catches a misread range: a single number, a dash, a step that stands still or goes back."""
    with pytest.raises(DataError) as caught:
        parse_frames(text)
    check_message(caught.value, repr(text))


def test_parts_are_readable_alone(scene: Path) -> None:
    """Catches a focal length that loses digits, and NaN rows refused where they are allowed."""
    assert read_focal(scene / "focal.txt") == CAMERA.fx
    set_pose_rows(scene, 1, NAN_ROWS)
    assert np.isnan(read_poses(scene / "poses.txt")[1]).all()


def test_jpeg_colors_are_read(scene: Path) -> None:
    """Catches a check for damage that refuses whole JPEG files."""
    image = np.full((8, 12, 3), 99, np.uint8)
    cv2.imwrite(str(scene / "images/img1.jpg"), image)
    assert np.abs(read_image(scene / "images/img1.jpg", cv2.IMREAD_COLOR) - 99.0).max() <= 1


def test_interrupted_writer_leaves_nothing_behind(tmp_path: Path) -> None:
    """Catches a half-written scene that a later run would take for a whole one."""
    colors, depths, poses = random_frames(1)

    def write_and_stop() -> None:
        with SequenceWriter(tmp_path / "scene", CAMERA, ("depth",)) as writer:
            writer.add(colors[0], {"depth": depths[0, 0]}, poses[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_and_stop()
    assert list(tmp_path.iterdir()) == []


def test_writer_clears_what_a_killed_one_left(tmp_path: Path) -> None:
    """Catches frames of a killed run that stay among those of the next."""
    killed = SequenceWriter(tmp_path / "scene", CAMERA, ("depth",))
    killed.__enter__()
    colors, depths, poses = random_frames(2)
    killed.add(colors[1], {"depth": depths[0, 1]}, poses[1])
    killed.add(colors[1], {"depth": depths[0, 1]}, poses[1])
    with SequenceWriter(tmp_path / "scene", CAMERA, ("depth",)) as writer:
        writer.add(colors[0], {"depth": depths[0, 0]}, poses[0])
    sequence = read_sequence(tmp_path / "scene")
    assert isinstance(sequence, RgbdSequence)
    assert np.array_equal(sequence.colors, colors[:1])


def test_writer_refuses(scene: Path, tmp_path: Path) -> None:
    """Catches a scene that is overwritten, and frames that do not fit the camera."""
    with pytest.raises(DataError) as caught:
        SequenceWriter(scene, CAMERA)
    check_message(caught.value, "scene exists")
    color = np.zeros((4, 6, 3), np.uint8)
    writer = SequenceWriter(tmp_path / "other", CAMERA, ("depth",))
    with pytest.raises(DataError) as caught, writer:
        writer.add(color, {"depth": np.zeros((4, 6), np.uint16)}, np.eye(4))
    check_message(caught.value, "6x4")
    assert not (tmp_path / "other").exists()


def test_writer_without_a_frame(tmp_path: Path) -> None:
    """Catches an empty scene, or a traceback from NumPy, where nothing was added."""
    with pytest.raises(DataError, match="no frame"), SequenceWriter(tmp_path / "scene", CAMERA):
        pass
    assert list(tmp_path.iterdir()) == []


def test_two_writers_of_one_scene(tmp_path: Path) -> None:
    """Catches two commands that spoil each other's files of one room: the first one stands."""
    intrinsics = Intrinsics.from_focal(8, 6, 7.0)
    with SequenceWriter(tmp_path / "room", intrinsics, ("depth",)) as late:
        late._unfinished = late._unfinished.with_name(".room.other.unfinished")
        late.__enter__()
        late.add(np.zeros((6, 8, 3), np.uint8), {"depth": np.ones((6, 8), np.uint16)}, np.eye(4))
        with SequenceWriter(tmp_path / "room", intrinsics, ("depth",)) as early:
            for _ in range(2):
                early.add(
                    np.zeros((6, 8, 3), np.uint8), {"depth": np.ones((6, 8), np.uint16)}, np.eye(4)
                )
    assert len(read_sequence(tmp_path / "room")) == 2
