"""Which way a pose file's camera axes point, and which way its matrices map."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbtrack.core.errors import ConfigError

# Where an axis may point, seen from behind the camera, in OpenCV's x (right), y (down), z
# (forward).
_DIRECTIONS = {
    "right": (1, 0, 0), "left": (-1, 0, 0), "down": (0, 1, 0), "up": (0, -1, 0),
    "forward": (0, 0, 1), "backward": (0, 0, -1),
}  # fmt: skip
_NAMED_AXES = {"opencv": "right down forward", "opengl": "right up backward"}
_NAMES = {words: name for name, words in _NAMED_AXES.items()}
_USUAL_NAMES = {
    "opengl": "OpenGL axes", "opencv": "OpenCV axes", "forward left up": "robot axes",
    "left up forward": "PyTorch3D axes", "right up forward": "left-handed axes",
}  # fmt: skip
CAMERA_TO_WORLD, WORLD_TO_CAMERA = "camera-to-world", "world-to-camera"


@dataclass(frozen=True)
class Convention:
    """A reading of pose files: camera axes, and which way the matrix maps.

    Args:
        camera_axes: `opencv`, `opengl`, or where the camera's x, y and z axes point as three
            words, such as `right up forward`.
        world_to_camera: matrices take world points to the camera, not the other way.

    Raises:
        ConfigError: the words name no three axes at right angles.
    """

    camera_axes: str
    world_to_camera: bool = False

    def __post_init__(self) -> None:
        words = _NAMED_AXES.get(self.camera_axes, self.camera_axes).split()
        known = len(words) == 3 and all(word in _DIRECTIONS for word in words)
        if not known or not np.linalg.det([_DIRECTIONS[word] for word in words]):
            raise ConfigError(
                f"camera_axes = {self.camera_axes!r}: write 'opencv', 'opengl', or where x, y and "
                "z point, as in 'right up forward' (of right/left, up/down, forward/backward)"
            )
        # One spelling a convention, so that equal ones compare equal.
        object.__setattr__(self, "camera_axes", _NAMES.get(" ".join(words), " ".join(words)))

    @property
    def name(self) -> str:
        """For people: `OpenGL axes (x right, y up, z backward), camera-to-world`."""
        words = _NAMED_AXES.get(self.camera_axes, self.camera_axes).split()
        pointing = ", ".join(f"{axis} {word}" for axis, word in zip("xyz", words, strict=True))
        handed = "right" if self._is_right_handed else "left"
        usual = _USUAL_NAMES.get(self.camera_axes, f"{handed}-handed axes")
        return f"{usual} ({pointing}), {self.direction}"

    @property
    def direction(self) -> str:
        """`camera-to-world` or `world-to-camera`."""
        return WORLD_TO_CAMERA if self.world_to_camera else CAMERA_TO_WORLD

    def to_opencv(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Camera-to-world poses with OpenCV camera axes, if `poses` follow this convention.

        NaN poses stay NaN. Left-handed cameras come with a mirrored world, mirrored back here.
        """
        T_world_camera = _inverse(poses) if self.world_to_camera else poses
        return self._mirror @ T_world_camera @ self._T_file_opencv

    def from_opencv(self, T_world_camera: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """What somebody with this convention would write: the inverse of `to_opencv`."""
        poses = self._mirror @ T_world_camera @ self._T_file_opencv.T
        return _inverse(poses) if self.world_to_camera else poses

    @property
    def _T_file_opencv(self) -> Float[np.ndarray, "4 4"]:
        matrix = np.eye(4)
        words = _NAMED_AXES.get(self.camera_axes, self.camera_axes).split()
        matrix[:3, :3] = [_DIRECTIONS[word] for word in words]  # rows: the file's x, y, z
        return matrix

    @property
    def _is_right_handed(self) -> bool:
        return bool(np.linalg.det(self._T_file_opencv) > 0)

    @property
    def _mirror(self) -> Float[np.ndarray, "4 4"]:
        return np.diag([1.0, 1.0, 1.0 if self._is_right_handed else -1.0, 1.0])


def _inverse(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Inverse of rigid transforms. A transpose, unlike a solver, takes NaN and never fails."""
    inverse = T.copy()
    inverse[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3:] = -inverse[:, :3, :3] @ T[:, :3, 3:]
    return inverse


# The common ones first: where several fit alike, the first is named.
_USUAL_AXES = (
    "opengl", "opencv", "forward left up", "right up forward", "left up forward",
    "left down backward", "left down forward", "left up backward", "right down backward",
)  # fmt: skip
CONVENTIONS = tuple(
    Convention(axes, world_to_camera) for world_to_camera in (False, True) for axes in _USUAL_AXES
)
OPENGL, OPENCV = CONVENTIONS[0], CONVENTIONS[1]
