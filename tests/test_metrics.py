"""Trajectory errors, by hand and by laws of rigid motion; and TUM files, which others read."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from box_room import poses_at
from scipy.spatial.transform import Rotation

from nbtrack.beyond.verdict import score_detection
from nbtrack.checks.in_map import in_world_of_map, other_world
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import json_text, write_atomic
from nbtrack.recordings.pose_files import read_tum, shifted, tum_text
from nbtrack.tracking import Trajectory
from nbtrack.tracking.metrics import align_rigidly, pose_errors, still_metrics, trajectory_metrics


def wandering(frames: int, seed: int = 0) -> np.ndarray:
    """Random positions and orientations."""
    generator = np.random.default_rng(seed)
    positions = generator.normal(size=(frames, 3))
    return poses_at(positions, Rotation.random(frames, rng=generator).as_rotvec())


def test_values_by_hand() -> None:
    """Catches a wrong mean, a frame without reference that counts, a shifted threshold; radians for
    degrees, half angles, and transposed rotations that add instead."""
    true = poses_at([[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]])
    true[:, :3, :3] = Rotation.from_euler("x", 50, degrees=True).as_matrix()
    estimated = poses_at([[1, 0.1, 0], [2, 0, 0.2], [3, 0.4, 0], [9, 9, 9]])
    turned = Rotation.from_euler("x", [[53], [46], [50], [90]], degrees=True)
    estimated[:, :3, :3] = turned.as_matrix()
    np.testing.assert_allclose(pose_errors(estimated, true)[1], [3, 4, 0, 40], atol=1e-9)
    true[3] = np.nan
    metrics = trajectory_metrics(estimated, true)
    assert metrics.pop("ate_rmse_aligned_m") < metrics["ate_rmse_m"]
    assert metrics == {
        "ate_rmse_m": pytest.approx(np.sqrt(0.07)),  # sqrt((0.01 + 0.04 + 0.16) / 3)
        "rotation_rmse_deg": pytest.approx(np.sqrt(25 / 3)),
        "median_error_m": pytest.approx(0.2),
        "max_error_m": pytest.approx(0.4),
        "frames": 4,
        "frames_without_reference": 1,
        "lost_frames": 1,  # 0.2 is not above 0.2
    }
    nothing_known = {"frames": 4, "frames_without_reference": 4}
    assert trajectory_metrics(estimated, np.full_like(true, np.nan)) == nothing_known


def test_standing_still_by_hand() -> None:
    """Catches a baseline that counts the first frame, or a path over frames that are not known."""
    true = poses_at([[1, 0, 0], [1, 3, 0], [0, 0, 0], [1, 3, 4]])
    true[2] = np.nan
    # Distances from the first pose: 3 and 5. Steps: 3 and 4.
    assert still_metrics(true) == {"still_ate_m": pytest.approx(np.sqrt(17)), "path_m": 7.0}
    assert still_metrics(true[:1]) == {}


TRUE = [wandering(20), poses_at([[1, 2, 3]] * 5), poses_at([[1, 2, 3]] * 2)]


@pytest.mark.parametrize("true", TRUE)
def test_an_offset_counts_unless_aligned(true: np.ndarray) -> None:
    """Catches an alignment that slipped into the paper's formula, and NaN where nothing moves."""
    estimated = true.copy()
    estimated[:, :3, 3] += [0.3, -0.4, 1.2]  # length 1.3
    metrics = trajectory_metrics(estimated, true)
    assert metrics["ate_rmse_m"] == pytest.approx(1.3)
    assert metrics["ate_rmse_aligned_m"] == pytest.approx(0, abs=1e-12)
    assert metrics["lost_frames"] == len(true)


def test_aligned_error_ignores_rigid_motion_alone() -> None:
    """Catches an alignment that is transposed, or that hides a wrong scale or a mirror image."""
    true, estimated = wandering(30), wandering(30)
    estimated[:, :3, 3] += np.random.default_rng(5).normal(scale=0.1, size=(30, 3))
    before = trajectory_metrics(estimated, true)
    after = trajectory_metrics(wandering(1, seed=3)[0] @ estimated, true)
    assert after["ate_rmse_aligned_m"] == pytest.approx(before["ate_rmse_aligned_m"], rel=1e-9)
    assert after["ate_rmse_m"] > 2 * before["ate_rmse_m"]
    points, farther = true[:, :3, 3], true.copy()
    farther[:, :3, 3] *= 2
    off_m = np.linalg.norm(points - points.mean(axis=0), axis=1)
    found = trajectory_metrics(farther, true)["ate_rmse_aligned_m"]
    assert found == pytest.approx(np.sqrt((off_m**2).mean()))
    assert np.abs(align_rigidly(points * [1, 1, -1], points) - points).max() > 0.1


def test_another_world_is_told_from_errors() -> None:
    """Catches a recording in a world of its own whose frames all count as wrong; and errors that
    are explained away: of a camera that drifts, or of one that is right."""
    true, moved = wandering(40), wandering(1, seed=3)[0]
    estimated = moved @ true
    estimated[:, :3, 3] += np.random.default_rng(5).normal(scale=0.01, size=(40, 3))
    estimated[::3] = wandering(14, seed=9)  # lost frames do not change the world
    np.testing.assert_allclose(other_world(estimated, true), moved, atol=0.02)
    partly_known = np.concatenate([true[:39], np.full((1, 4, 4), np.nan)])
    frames = pd.DataFrame({"translation_error_m": [9.0] * 40})
    tracked = Trajectory(estimated, partly_known, frames)
    found, is_other = in_world_of_map(tracked)
    assert is_other
    assert found.frames["translation_error_m"].median() < 0.05
    assert tracked.frames["translation_error_m"].eq(9).all()  # the user's stays as it is
    drifting = true.copy()
    drifting[:, 0, 3] += np.linspace(0, 3, 40)
    assert other_world(drifting, true) is None
    partly_lost = true.copy()
    partly_lost[::3] = estimated[::3]
    assert not in_world_of_map(Trajectory(partly_lost, true, frames))[1]
    assert other_world(estimated, np.full_like(true, np.nan)) is None


def test_poses_that_cannot_be_compared() -> None:
    """Catches a NaN error that is reported as a number, and silent broadcasting of one pose over a
    whole trajectory."""
    poses, spoilt = wandering(6), wandering(6)
    spoilt[4, 0, 3] = np.nan
    for ours, true in ((spoilt, poses), (poses, spoilt), (poses[:1], poses), (poses[:0],) * 2):
        with pytest.raises(DataError, match=f"{len(ours)} estimates, {len(true)} true poses: "):
            pose_errors(ours, true)
    with pytest.raises(DataError, match="1 estimates, 6 true poses"):
        trajectory_metrics(poses[:1], poses)


def test_detection_of_lost_frames() -> None:
    """Catches precision taken for recall, and a share of nothing that passes for a number."""
    found = score_detection(np.array([True, False, False, False]), np.array([0.5, 0.5, 0.5, 0.01]))
    assert found == {"lost_precision": 1.0, "lost_recall": pytest.approx(1 / 3)}
    none = score_detection(np.array([False]), np.array([0.01]))
    assert none == {"lost_precision": None, "lost_recall": None}


def test_tum_round_trip(tmp_path: Path) -> None:
    """Catches digits cut off, an inverted pose, a wrong quaternion order; blanks too many and
    negative zeros, which strict readers refuse or show; and poses that are moved in place."""
    true, times = wandering(50, seed=7), 1305031102.175304 + np.arange(50) / 30
    true[0] = np.diag([1.0, -1, -1, 1])
    moved = shifted(true, np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(moved[:, :3, 3] - true[:, :3, 3], [[1.0, -2.0, 3.0]] * 50)
    moved[1, 2, 3] = np.nan
    assert len(tum_text(times, moved).splitlines()) == 1 + 49
    text = tum_text(times, true)
    for line in text.splitlines()[1:]:
        assert line == " ".join(line.split())
        assert "-0.0 " not in line
        assert float(line.split()[7]) >= 0
    write_atomic(tmp_path / "new" / "t.txt", text)
    timestamps, read = read_tum(tmp_path / "new" / "t.txt")
    np.testing.assert_allclose(read, true, atol=1e-12, rtol=0)
    np.testing.assert_array_equal(timestamps, times)


def test_a_rotation_by_hand(tmp_path: Path) -> None:
    """Catches w x y z order: a quarter turn about z has z = w = sqrt(1/2); and a reader that takes
    only our own files: comments, tabs, four-digit quaternions."""
    pose = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1]])
    header, line, end = tum_text(np.array([0.5]), pose[None]).split("\n")
    assert (header, end) == ("# timestamp tx ty tz qx qy qz qw", "")
    assert line.startswith("0.5 1.5 -2.0 0.25 0.0 0.0 0.7071067811865")
    expected = [0.5, 1.5, -2, 0.25, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    np.testing.assert_allclose([float(word) for word in line.split(" ")], expected, atol=1e-15)
    (tmp_path / "other.txt").write_text(" # made elsewhere\n0.5\t1.5 -2 0.25 0 0 0.7071 0.7071\n\n")
    (stamp,), (read,) = read_tum(tmp_path / "other.txt")
    assert stamp == 0.5
    np.testing.assert_allclose(read, pose, atol=1e-12)


def test_json_has_no_nan() -> None:
    """Catches results that other readers of JSON refuse, and keys in another order."""
    assert list(json.loads(json_text({"b": 1.5, "a": [None, "ü"]}))) == ["b", "a"]
    with pytest.raises(ValueError, match="JSON"):
        json_text({"ate": float("nan")})
