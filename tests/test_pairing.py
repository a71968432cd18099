"""Which image, depth map and pose belong together: never a neighbour's, and never by a guess."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from box_room import poses_at
from recordings import N_FRAMES, START, matrix_text, source, tum_lines, write_recording

from nbtrack.machinery.errors import DataError
from nbtrack.recordings.pose_files import read_poses
from nbtrack.recordings.reading import read_sequence
from nbtrack.recordings.recording import Recording, open_recording

RUN = tuple(range(N_FRAMES))


def rename(recording: Path, colors, depths=None) -> None:
    """Give images and depth maps other names, and take away those for which there is none."""
    is_plain = (recording / "color").is_dir()
    kinds = ("color", "depth") if is_plain else ("images", "depth_filtered")
    for kind, names in zip(kinds, (colors, depths or colors), strict=True):
        contents = [(path, path.read_bytes()) for path in sorted((recording / kind).iterdir())]
        for path, _ in contents:
            path.unlink()
        for name, (path, content) in zip(names, contents, strict=False):
            path.with_name(name + path.suffix).write_bytes(content)


NAMED = pd.read_csv(Path(__file__).parent / "data/names_of_frames.csv")


@pytest.mark.parametrize(("color", "depth", "listed"), NAMED.to_numpy())
def test_numbers_in_names(plain: Path, color: str, depth: str, listed: str) -> None:
    """Catches a number of the camera, the bits or the date that is taken for the frame's, and an
    image that is refused, or put in another place, for it."""
    numbers = [*map(int, listed.split())]
    rename(plain, [color.format(i) for i in numbers], [depth.format(i) for i in numbers])
    (plain / "poses.txt").write_text(matrix_text(source().poses.reshape(-1, 16)))
    sequence = read_sequence(plain, pose_file="poses.txt")
    assert np.array_equal(sequence.colors, source().colors)
    assert np.array_equal(sequence.depths_mm, source().depths_mm)
    if "1305" not in color:
        np.testing.assert_allclose(sequence.times, (np.array(numbers) - numbers[0]) / 30)


FELL_BACK = START + np.array([0, 0.1, 0.2, 0.05, 0.15, 0.25])
COARSE = START + np.array([0, 0, 0, 1, 1, 1])
# Names of images that cannot be paired with depth maps, which have the same ones if none are given,
# or that do not tell in which order they were recorded; and what is said of them.
REFUSED = pd.read_csv(Path(__file__).parent / "data/refused_names.csv", keep_default_na=False)


@pytest.mark.parametrize(("case", "colors", "depths", "says"), REFUSED.to_numpy())
def test_refused_names(plain: Path, case: str, colors: str, depths: str, says: str) -> None:
    """Catches images with their neighbours' depth where one of each is lost, two files of a number
    that shift all poses behind them, two sessions that are shuffled into one, and a recording that
    is shuffled in silence, since its names were sorted."""
    rename(plain, colors.split(), depths.split())
    with pytest.raises(DataError, match=says):
        open_recording(plain)


@pytest.mark.parametrize("times", [FELL_BACK, COARSE], ids=["fell back", "coarse"])
@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt", "timestamps.txt"])
def test_times_that_tell_no_order(tmp_path: Path, name: str, times: np.ndarray) -> None:
    """Catches lists that are sorted by a clock that fell back, and rows of one time."""
    folder = write_recording("tum" if name != "timestamps.txt" else "plain", tmp_path / "r")
    lines = [f"{time:.6f}" for time in times]
    if name in ("rgb.txt", "depth.txt"):
        rows = (folder / name).read_text().splitlines()[1:]
        lines = [f"{t} {row.split()[1]}" for t, row in zip(lines, rows, strict=False)]
    elif name == "groundtruth.txt":
        lines = tum_lines(times, source().poses).splitlines()
    (folder / name).write_text("# head\n" + "\n".join(lines))
    with pytest.raises(DataError, match=rf"{name}, row {4 if times is FELL_BACK else 2}: 1305"):
        open_recording(folder)


# By case: images' numbers, whole multiples of the frame's time with which poses are stamped (none:
# without stamps), format, and whose pose each image has to get: -1 for none; none for a refusal.
LISTS = pd.read_csv(Path(__file__).parent / "data/lists_of_poses.csv", index_col="case")


def of_case(case: str) -> tuple:
    """The row, its numbers as tuples."""
    cells = LISTS.fillna("").loc[case]
    parts = {n: tuple(map(float, cells[n].split())) for n in ("numbers", "stamps", "expected")}
    return parts["numbers"], parts["stamps"], cells["format"], parts["expected"]


def listed(folder: Path, case: str) -> Recording:
    numbers, stamps, format, _ = of_case(case)
    write_recording(format, folder)
    rename(folder, [f"{i:06.0f}" for i in numbers])
    if stamps:
        times = np.array(stamps) / 30
        is_plain = format == "plain"
        poses = source().poses[: len(times)] * (1 if is_plain else [1, -1, -1, 1])
        name = "trajectory.txt" if is_plain else "poses.txt"
        (folder / name).write_text(tum_lines(times, poses))
    elif format == "plain":
        (folder / "trajectory.txt").write_text(matrix_text(source().poses.reshape(-1, 16)))
    return open_recording(folder)


@pytest.mark.parametrize("case", LISTS.index)
def test_poses_of_a_list_without_names(tmp_path: Path, case: str) -> None:
    """Catches poses of neighbours: of images that count from 1, of a recording that was cut, or of
    one that lost some; as many poses as images prove nothing where stamps say otherwise."""
    numbers, _, _, expected = of_case(case)
    if not expected:
        with pytest.raises(DataError, match=r"poses but there are .*, or timestamps\.txt"):
            listed(tmp_path / "r", case)
        return
    recording = listed(tmp_path / "r", case)
    has_pose = np.array(expected) >= 0
    assert np.array_equal(recording.has_pose, has_pose)
    wanted = source().poses[[int(i) for i in expected if i >= 0]]
    np.testing.assert_allclose(recording.T_world_camera[has_pose], wanted, atol=1e-9)
    # What is taken by its place, or left out, is said.
    is_proven = numbers == RUN or case == "from 1, stamped"
    assert bool(recording.notes) != is_proven


SPELLINGS = ["nan", "NaN", "-nan", "NAN(0x8000)", "-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND00"]
SPELLINGS += ["1.#R", "-1.#J", "1.#INF", "sNaN", "-NaN123", "inf", "-Infinity"]


LOST = [7 * [spelling] for spelling in SPELLINGS]
LOST += [row.split() for row in ("0 0 0 0 0 0 0", "1.5 1 2 0 0 0 0", "1 2 3 nan 0 0 1")]


@pytest.mark.parametrize("words", LOST, ids=" ".join)
def test_a_lost_frame_however_it_is_spelled(plain: Path, words: list[str]) -> None:
    """Catches a whole file that is refused for one frame that a tool has lost, or rows that end
    where its `#` begins."""
    path = plain / "trajectory.txt"
    lines = path.read_text().splitlines()
    for between in (" ", ","):
        row = between.join([lines[2].split()[0], *words])
        path.write_text("\n".join(["# a comment", *lines[:2], f"{row} # lost", *lines[3:]]))
        assert np.flatnonzero(~open_recording(plain).has_pose).tolist() == [2]


def test_times_of_images_settle_it(tmp_path: Path) -> None:
    """Catches advice that does not help: where poses are refused, a file of times is enough, and
    an own trajectory of images that count from 1 is known by its times to the last digit."""
    with pytest.raises(DataError, match=r"timestamps\.txt"):
        listed(tmp_path / "r", "from 1, cut, stamped")
    (tmp_path / "r/timestamps.txt").write_text(matrix_text(np.arange(4)[:, None] / 30))
    np.testing.assert_allclose(open_recording(tmp_path / "r").T_world_camera, source().poses[:4])
    times = listed(tmp_path / "own", "from 1").times
    (tmp_path / "own/trajectory.txt").write_text(tum_lines(times[1:], source().poses[1:]))
    own = open_recording(tmp_path / "own")
    assert np.flatnonzero(~own.has_pose).tolist() == [0]
    np.testing.assert_allclose(own.T_world_camera[1:], source().poses[1:])


@pytest.mark.parametrize("per_second", [1, 10**3, 10**9])
def test_one_unit_of_times_wherever_they_stand(plain: Path, per_second: int) -> None:
    """Catches nanoseconds that are taken for seconds, in files of times, of poses and in names, a
    time beyond all others, and frame numbers in place of a recording's own times."""
    seconds = 1403636579.25 + np.arange(N_FRAMES) / 4
    stamps = [str(round(s * per_second)) if per_second > 1 else f"{s}" for s in seconds]
    rows = tum_lines(seconds, source().poses).splitlines()
    stamped = [f"{t} {row.split(maxsplit=1)[1]}" for t, row in zip(stamps, rows, strict=True)]
    (plain / "trajectory.txt").write_text("\n".join(stamped))
    of_poses = open_recording(plain).times
    (plain / "timestamps.txt").write_text("\n".join(stamps))
    recording = open_recording(plain)
    np.testing.assert_allclose(recording.T_world_camera, source().poses, atol=1e-9)
    (plain / "timestamps.txt").write_text("\n".join([*stamps[:-1], "1e30"]))
    with pytest.raises(DataError, match="one each, rising, in seconds"):
        open_recording(plain)
    (plain / "timestamps.txt").unlink()
    rename(plain, stamps)
    for times in (of_poses, recording.times, open_recording(plain).times):
        np.testing.assert_allclose(times, seconds, atol=1e-3)


def test_times_in_names(plain: Path) -> None:
    """Catches times in the order of their digits, .175304 behind .2, and times from 0 for images
    that are named after theirs, whatever the poses are stamped with."""
    names = ["1305031102.175304", "1305031102.2", "1305031102.25"]
    names += ["1305031103.0", "1305031103.040", "1305031103.5"]
    rename(plain, names)
    lines = tum_lines(np.arange(N_FRAMES) / 30, source().poses)
    (plain / "trajectory.txt").write_text(lines)
    recording, sequence = open_recording(plain), read_sequence(plain)
    assert recording.times == pytest.approx(list(map(float, names)))
    assert np.array_equal(sequence.colors, source().colors)
    np.testing.assert_allclose(recording.T_world_camera, source().poses, atol=1e-9)
    # A tool has lost a frame, and its time.
    lines = tum_lines(recording.times + 0.001, source().poses).splitlines()
    (plain / "trajectory.txt").write_text("\n".join([*lines[:2], "nan " * 8, *lines[3:]]))
    assert np.flatnonzero(~open_recording(plain).has_pose).tolist() == [2]
    # Two clocks: as many poses as images, each with a moment of its own, prove nothing.
    uneven = np.array([3.0, 3.1, 3.4, 3.5, 3.9, 4.0])
    (plain / "trajectory.txt").write_text(tum_lines(uneven, source().poses))
    with pytest.raises(DataError, match="nothing tells whose each is"):
        open_recording(plain)


def test_few_poses_and_names_that_tell_no_number(tmp_path: Path) -> None:
    """Catches a single pose between no two stamps, and names in which two numbers vary."""
    folder = write_recording("tum", tmp_path / "r")
    (folder / "groundtruth.txt").write_text(tum_lines(np.array([START]) + 0.1, source().poses[:1]))
    assert np.flatnonzero(open_recording(folder).has_pose).tolist() == [1]
    plain = write_recording("plain", tmp_path / "plain")
    rename(plain, [f"{i // 3}_{i % 3}" for i in RUN])
    (plain / "trajectory.txt").write_text(tum_lines(np.array(RUN) / 7, source().poses))
    assert "one after another" in open_recording(plain).notes[0]
    (plain / "trajectory.txt").write_text(tum_lines(np.arange(5) / 7, source().poses[:5]))
    with pytest.raises(DataError, match="5 poses but there are 6"):
        open_recording(plain)


def moving(times: np.ndarray) -> np.ndarray:
    """Poses far from the origin that go straight and turn evenly."""
    positions = np.outer(times, [0.4, -0.3, 0.5]) - [9, 4, 7]
    return poses_at(positions, np.outer(times, [0.3, 0.9, -0.2]))


@pytest.mark.parametrize(("step", "pose_step"), [(80, 4), (80, 1), (4, 10)])
def test_lists_of_one_clock_have_one_unit(plain: Path, step: int, pose_step: int) -> None:
    """Catches ms of fast poses that are read as s, and frame numbers of sparse ones as ms."""
    times, stamps = step * np.arange(N_FRAMES), np.arange(0, 5 * step + 1, pose_step)
    (plain / "timestamps.txt").write_text(matrix_text(times[:, None]))
    (plain / "trajectory.txt").write_text(tum_lines(stamps, moving(stamps / 1e3)))
    has_pose, T = np.isin(times, stamps), open_recording(plain).T_world_camera
    np.testing.assert_allclose(T[has_pose], moving(times / 1e3)[has_pose], atol=1e-6)


@pytest.mark.parametrize("direction", ["camera-to-world", "world-to-camera"])
def test_poses_between_stamps_are_interpolated(tmp_path: Path, direction: str) -> None:
    """Catches the nearest pose of a slow list for images between two, which is millimetres off;
    poses made up over a gap or from one that was lost, or at either end; and a pose of an image's
    very time that comes back with another digit."""
    frames = np.arange(N_FRAMES) / 10
    folder = write_recording("tum", tmp_path / "r", source()._replace(poses=moving(frames)))
    late = {0: (0.0, 0.03), 1: (-0.02, 0.02), 2: (-0.01, 0.05), 3: (-0.025, 0.03)}
    late |= {4: (-0.025, 0.01), 5: (-0.015,)}
    times = np.concatenate([frames[i] + np.array(late[i]) for i in late])
    poses = moving(times)
    if direction == "world-to-camera":
        poses = np.linalg.inv(poses)
        (folder / "sequence.toml").write_text(f'poses = "{direction}"\n')
    lines = tum_lines(START + times, poses).splitlines()
    lines[9] = f"{lines[9].split()[0]} nan nan nan nan nan nan nan"
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    recording = open_recording(folder)
    assert recording.has_pose.tolist() == [True, True, True, False, False, True]
    in_file = read_poses(folder / "groundtruth.txt")[0]
    assert np.array_equal(recording.file_poses[[0, 2, 5]], in_file[[0, 4, 10]])
    np.testing.assert_allclose(recording.T_world_camera[1], moving(frames)[1], atol=1e-6)
    (note,) = (text for text in recording.notes if "interpolated" in text)
    assert note.startswith("groundtruth.txt: 1 of 6 poses")
    assert "20.0 ms" in note


@pytest.mark.parametrize("name", ["replica", "neural_rgbd"])
def test_a_recording_that_counts_from_0_and_was_cut(tmp_path: Path, name: str) -> None:
    """Catches poses of other frames, or an alarm, where numbers are places in the list."""
    folder = write_recording(name, tmp_path / "r")
    whole = open_recording(folder)
    for file in [*whole.color_files[:3], *whole.depth_files[:3]]:
        file.unlink()
    cut = open_recording(folder)
    np.testing.assert_allclose(cut.T_world_camera, whole.T_world_camera[3:], atol=1e-9)
