"""TUM files and atomic writes: what other tools read must be exact, complete and in order."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.files import json_text, write_atomic
from nbtrack.tracking.trajectories import read_tum, tum_text

GOOD_LINE = "0.5 1 2 3 0 0 0 1"


def test_round_trip(tmp_path: Path) -> None:
    """Catches digits cut off, an inverted pose, a wrong quaternion order; and blanks too many and
    negative zeros, which strict readers refuse or show."""
    generator = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, :3] = Rotation.random(50, rng=generator).as_matrix()
    poses[:, :3, 3] = generator.normal(scale=3, size=(50, 3))
    poses[0] = np.diag([1.0, -1, -1, 1])
    frame_ids = np.arange(3, 153, 3)
    text = tum_text(frame_ids, poses)
    for line in text.splitlines()[1:]:
        assert line == " ".join(line.split())
        assert "-0.0 " not in line
        assert float(line.split()[7]) >= 0
    write_atomic(tmp_path / "new" / "t.txt", text)
    timestamps, read = read_tum(tmp_path / "new" / "t.txt")
    np.testing.assert_allclose(read, poses, atol=1e-12, rtol=0)
    np.testing.assert_array_equal(timestamps, frame_ids / 30)


def test_a_rotation_by_hand() -> None:
    """Catches w x y z order: a quarter turn about z has z = w = sqrt(1/2)."""
    pose = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1]])
    header, line, end = tum_text(np.array([15]), pose[None]).split("\n")
    assert (header, end) == ("# timestamp tx ty tz qx qy qz qw", "")
    assert line.startswith("0.5 1.5 -2.0 0.25 0.0 0.0 0.7071067811865")
    expected = [0.5, 1.5, -2, 0.25, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    np.testing.assert_allclose([float(word) for word in line.split(" ")], expected, atol=1e-15)


MALFORMED = [
    ("0.5 1 2 3 0 0 0", "line 4"),
    (GOOD_LINE + " 9", "line 4"),
    ("0.5 1 2 x 0 0 0 1", "line 4"),
    ("0.5 1 2 nan 0 0 0 1", "not a finite pose in every line"),
    ("0.5 1 2 3 0 0 0 0", "pose 1 has a quaternion of norm 0"),
    ("0.5 0 0 1 1 2 3 4", "pose 1 has a quaternion of norm 5.48"),
]


@pytest.mark.parametrize(("line", "found"), MALFORMED)
def test_malformed_lines(tmp_path: Path, line: str, found: str) -> None:
    """Catches a wrong file that is read as a trajectory, or an error without its place."""
    path = tmp_path / "bad.txt"
    path.write_text(f"# header\n{GOOD_LINE}\n\n{line}\n")
    with pytest.raises(DataError, match=rf"bad\.txt.*{found}.*timestamp|bad.txt {found}"):
        read_tum(path)


def test_no_poses_and_no_file(tmp_path: Path) -> None:
    """Catches an empty trajectory that fails only later, far from its file."""
    (tmp_path / "empty.txt").write_text("# only a header\n")
    with pytest.raises(DataError, match=r"empty\.txt is empty"):
        read_tum(tmp_path / "empty.txt")
    with pytest.raises(MissingError, match=r"no file .*absent\.txt"):
        read_tum(tmp_path / "absent.txt")


def test_rounded_and_commented_files_of_others(tmp_path: Path) -> None:
    """Catches a reader that takes only our own files: comments, tabs, four-digit quaternions."""
    path = tmp_path / "other.txt"
    path.write_text(" # made elsewhere\n1305031102.1758\t1 2 3 0.6574 0.6126 -0.2949 -0.3248\n\n")
    timestamps, T_world_camera = read_tum(path)
    assert timestamps[0] == 1305031102.1758
    rotation = T_world_camera[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_atomic_writes(tmp_path: Path) -> None:
    """Catches missing parents, changed line ends, and files left aside."""
    folder = tmp_path / "a" / "b"
    write_atomic(folder / "t.txt", "–\n1\n")
    write_atomic(folder / "t.bin", b"\x00\r\n")
    write_atomic(folder / "t.json", json_text({"b": 1.5, "a": [None, "ü"]}))
    assert (folder / "t.txt").read_bytes() == "–\n1\n".encode()
    assert (folder / "t.bin").read_bytes() == b"\x00\r\n"
    assert list(json.loads((folder / "t.json").read_text(encoding="utf-8"))) == ["b", "a"]
    assert sorted(path.name for path in folder.iterdir()) == ["t.bin", "t.json", "t.txt"]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a result destroyed by a full disk, or by a NaN that JSON cannot hold."""
    path = tmp_path / "metrics.json"
    write_atomic(path, json_text({"ate": 1}))
    with pytest.raises(ValueError, match="JSON"):
        json_text({"ate": float("nan")})

    def full_disk(self: Path, content: bytes) -> int:
        with self.open("wb") as file:
            file.write(content[:3])
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write_atomic(path, json_text({"ate": 2}))
    assert json.loads(path.read_text()) == {"ate": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.json"]
