"""Which way a pose file's camera axes point, and which way its matrices map."""

import numpy as np
from jaxtyping import Float

from nbtrack.core.arrays import Poses
from nbtrack.core.errors import ConfigError

CAMERA_TO_WORLD, WORLD_TO_CAMERA = "camera-to-world", "world-to-camera"
# Where an axis may point, seen from behind the camera, in OpenCV's x, y and z.
_DIRECTIONS = dict(zip(("right", "down", "forward"), np.eye(3), strict=True))
_DIRECTIONS |= dict(zip(("left", "up", "backward"), 0 - np.eye(3), strict=True))
_SPELLED = {"opencv": "right down forward", "opengl": "right up backward"}
# The common ones first: where several fit alike, the first is named.
_USUAL = {
    "right up backward": "OpenGL axes",
    "right down forward": "OpenCV axes",
    "forward left up": "robot axes",
    "right up forward": "left-handed axes",
    "left up forward": "PyTorch3D axes",
    "left down backward": "right-handed axes",
    "left down forward": "left-handed axes",
    "left up backward": "left-handed axes",
    "right down backward": "left-handed axes",
}


def camera_axes_in_opencv(camera_axes: str) -> Float[np.ndarray, "3 3"]:
    """The file's x, y and z axes, one a row. Raises ConfigError where they are none."""
    words = _SPELLED.get(camera_axes, camera_axes).split()
    axes = np.array([_DIRECTIONS.get(word, np.zeros(3)) for word in words])
    if len(words) != 3 or not np.linalg.det(axes):
        raise ConfigError(
            f"camera_axes = {camera_axes!r}: write 'opencv', 'opengl', or where x, y and z point, "
            "as in 'right up forward' (of right/left, up/down, forward/backward)"
        )
    return axes


def convention_name(camera_axes: str, poses: str) -> str:
    """For people: `OpenGL axes (x right, y up, z backward), camera-to-world`."""
    words = _SPELLED.get(camera_axes, camera_axes)
    x, y, z = words.split()
    return f"{_USUAL.get(words, 'axes')} (x {x}, y {y}, z {z}), {poses}"


def poses_to_opencv(file_poses: Poses, camera_axes: str, poses: str) -> Poses:
    """Camera-to-world poses with OpenCV camera axes, of a file's; NaN poses stay NaN."""
    T, axes = file_poses.copy(), camera_axes_in_opencv(camera_axes)
    if poses == WORLD_TO_CAMERA:
        # A transpose, unlike a solver, takes NaN and never fails.
        T[:, :3, :3] = file_poses[:, :3, :3].mT
        T[:, :3, 3:] = -T[:, :3, :3] @ file_poses[:, :3, 3:]
    T[:, :3, :3] = T[:, :3, :3] @ axes
    T[:, 2] *= np.linalg.det(axes)  # left-handed cameras come with a mirrored world
    return T


_SHORT = {words: name for name, words in _SPELLED.items()}
CONVENTIONS = {  # by name: what `sequence.toml` says of it
    convention_name(axes, poses): {"camera_axes": _SHORT.get(axes, axes), "poses": poses}
    for poses in (CAMERA_TO_WORLD, WORLD_TO_CAMERA)
    for axes in _USUAL
}
