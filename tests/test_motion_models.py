"""Where a frame's search starts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import ConfigError
from nbtrack.tracking.motion_models import motion_model


def turned(angle: float, x: float) -> np.ndarray:
    """A pose turned about y and moved along its own x."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, angle, 0]).as_matrix()
    T[:3, 3] = T[:3, :3] @ [x, 0.0, 0.0]
    return T


def test_constant_velocity_repeats_the_motion_seen_from_the_camera() -> None:
    """Catches velocities taken in the world: on a circle they would leave it along the tangent."""
    step = turned(0.1, 0.05)
    poses = [np.eye(4)]
    for _ in range(3):
        poses.append(poses[-1] @ step)
    (predicted,) = motion_model("constant_velocity")(poses[:3])
    np.testing.assert_allclose(predicted, poses[3], atol=1e-12)


def test_the_first_frames() -> None:
    """Catches a velocity made of nothing, and a model that moves the camera where none is asked."""
    poses = [turned(0.2, 1.0), turned(0.3, 1.1)]
    np.testing.assert_array_equal(motion_model("constant_velocity")(poses[:1]), [poses[0]])
    np.testing.assert_array_equal(motion_model("previous_pose")(poses), [poses[1]])
    np.testing.assert_array_equal(motion_model("better_of_both")(poses[:1]), [poses[0]])


def test_both_starts_are_offered() -> None:
    """Catches a choice made here: only the tracker can tell which start fits the frame."""
    poses = [turned(0.2, 1.0), turned(0.3, 1.1)]
    offered = motion_model("better_of_both")(poses)
    single = [motion_model(name)(poses)[0] for name in ("constant_velocity", "previous_pose")]
    np.testing.assert_array_equal(offered, single)


def test_unknown_model() -> None:
    """Catches a silent fall-back where the name is misspelt."""
    with pytest.raises(ConfigError, match="did you mean 'constant_velocity'"):
        motion_model("constant_velocty")
