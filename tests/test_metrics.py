"""Trajectory errors: values worked by hand, and laws that any rigid motion must keep."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import DataError, NumericalError
from nbtrack.tracking.metrics import (
    align_rigidly,
    pose_errors,
    score_detection,
    trajectory_metrics,
)


def poses(positions: list[list[float]]) -> np.ndarray:
    """Unrotated cameras at these positions."""
    T_world_camera = np.tile(np.eye(4), (len(positions), 1, 1))
    T_world_camera[:, :3, 3] = positions
    return T_world_camera


def wandering(frames: int, seed: int = 0) -> np.ndarray:
    """Random positions and orientations."""
    generator = np.random.default_rng(seed)
    T_world_camera = poses(generator.normal(size=(frames, 3)).tolist())
    T_world_camera[:, :3, :3] = Rotation.random(frames, rng=generator).as_matrix()
    return T_world_camera


def test_values_by_hand() -> None:
    """Catches a wrong mean, a counted first frame, a shifted threshold."""
    true = poses([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    # The first row is wrong on purpose: it was given, so it must not count.
    estimated = poses([[9, 9, 9], [1, 0.1, 0], [2, 0, 0.2], [3, 0.4, 0]])
    metrics = trajectory_metrics(estimated, true)
    assert metrics.pop("ate_rmse_aligned_m") < metrics["ate_rmse_m"]
    assert metrics == {
        "ate_rmse_m": pytest.approx(np.sqrt(0.07)),  # sqrt((0.01 + 0.04 + 0.16) / 3)
        "rotation_rmse_deg": 0,
        "median_error_m": pytest.approx(0.2),
        "max_error_m": pytest.approx(0.4),
        "frames": 3,
        "lost_frames": 1,  # 0.2 is not above 0.2
    }


def test_rotation_by_hand() -> None:
    """Catches radians for degrees, half angles, and transposed rotations that add instead."""
    true = poses([[0, 0, 0]] * 3)
    true[:, :3, :3] = Rotation.from_euler("x", 50, degrees=True).as_matrix()
    estimated = true.copy()
    estimated[1:, :3, :3] = Rotation.from_euler("x", [[53], [46]], degrees=True).as_matrix()
    np.testing.assert_allclose(pose_errors(estimated, true)[1], [0, 3, 4], atol=1e-9)
    assert trajectory_metrics(estimated, true)["rotation_rmse_deg"] == pytest.approx(12.5**0.5)


@pytest.mark.parametrize("true", [wandering(20), poses([[1, 2, 3]] * 5), poses([[1, 2, 3]] * 2)])
def test_an_offset_counts_unless_aligned(true: np.ndarray) -> None:
    """Catches an alignment that slipped into the paper's formula, and NaN where nothing moves."""
    estimated = true.copy()
    estimated[:, :3, 3] += [0.3, -0.4, 1.2]  # length 1.3
    metrics = trajectory_metrics(estimated, true)
    assert metrics["ate_rmse_m"] == pytest.approx(1.3)
    assert metrics["ate_rmse_aligned_m"] == pytest.approx(0, abs=1e-12)
    assert metrics["lost_frames"] == len(true) - 1


def test_aligned_error_ignores_rigid_motion_alone() -> None:
    """Catches an alignment that is transposed, or that hides a wrong scale or a mirror image."""
    true, estimated = wandering(30), wandering(30)
    estimated[:, :3, 3] += np.random.default_rng(5).normal(scale=0.1, size=(30, 3))
    before = trajectory_metrics(estimated, true)
    after = trajectory_metrics(wandering(1, seed=3)[0] @ estimated, true)
    assert after["ate_rmse_aligned_m"] == pytest.approx(before["ate_rmse_aligned_m"], rel=1e-9)
    assert after["ate_rmse_m"] > 2 * before["ate_rmse_m"]
    points = true[:, :3, 3]
    doubled = align_rigidly(2 * points, points)
    np.testing.assert_allclose(doubled, 2 * points - points.mean(axis=0), atol=1e-12)
    assert np.abs(align_rigidly(points * [1, 1, -1], points) - points).max() > 0.1


@pytest.mark.parametrize("position", [0, 1])
def test_nan_names_the_frame(position: int) -> None:
    """Catches a NaN error that is reported as a number, or without saying where it is."""
    pair = [wandering(6), wandering(6)]
    pair[position][4, 0, 3] = np.nan
    with pytest.raises(NumericalError, match="pose of frame 4 is not finite"):
        trajectory_metrics(*pair)


@pytest.mark.parametrize(("estimated", "true"), [(1, 6), (0, 0)])
def test_numbers_of_poses(estimated: int, true: int) -> None:
    """Catches silent broadcasting of one pose over a whole trajectory."""
    with pytest.raises(DataError, match=f"{estimated} estimated and {true} true"):
        trajectory_metrics(wandering(6)[:estimated], wandering(6)[:true])


def test_detection_of_lost_frames() -> None:
    """Catches precision taken for recall, and a share of nothing that passes for a number."""
    errors = np.array([0.5, 0.5, 0.5, 0.01])
    found = score_detection(np.array([True, False, False, False]), errors)
    assert found == {"lost_precision": 1.0, "lost_recall": pytest.approx(1 / 3)}
    none = score_detection(np.array([False]), np.array([0.01]))
    assert none == {"lost_precision": None, "lost_recall": None}
