"""`sequence.toml`: what a recording does otherwise than its format says.

    format = "plain"             # which reader; by default told by the files there are
    depth_scale = 1000           # depth values a metre: 1000 for millimetres, 5000 for TUM's files
    no_depth = 65535             # a value that means "not measured", besides 0
    depth_along = "axis"         # the optical axis (z-depth), or the "ray" (distance)
    camera_axes = "opencv"       # or "opengl", or where x, y, z point: "right up forward"
    poses = "camera-to-world"    # or "world-to-camera"
    quaternion = "xyzw"          # or "wxyz": the order in pose files with quaternions
    frame_rate = 30              # Hz

Every key may be left out; the format's own value then holds. The file may lie in a folder of any
format.
"""

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from nbtrack.core.errors import ConfigError, DataError, nearest_name
from nbtrack.data.conventions import CAMERA_TO_WORLD, WORLD_TO_CAMERA, Convention
from nbtrack.data.readers.text_files import is_file, read_toml

DECLARATION_FILE = "sequence.toml"
_CHOICES = {
    "depth_along": ("axis", "ray"),
    "poses": (CAMERA_TO_WORLD, WORLD_TO_CAMERA),
    "quaternion": ("xyzw", "wxyz"),
}
_LARGEST_RAW = 65535  # of 16 bits


@dataclass(frozen=True)
class Declaration:
    """How the numbers of a recording are meant."""

    format: str | None = None  # None: told by the files
    depth_scale: float | int = 1000.0  # depth values a metre
    no_depth: int | None = None  # a value that means "not measured", besides 0
    depth_along: str = "axis"  # the optical axis, or "ray"
    camera_axes: str = "opencv"
    poses: str = CAMERA_TO_WORLD
    quaternion: str = "xyzw"
    frame_rate: float | int = 30.0  # Hz

    @property
    def convention(self) -> Convention:
        """Axes and direction of the pose file's matrices."""
        return Convention(self.camera_axes, self.poses == WORLD_TO_CAMERA)


def declared_in(folder: Path, defaults: Declaration) -> Declaration:
    """The format's own declaration with what `sequence.toml` in the folder changes, if it is there.

    Raises:
        DataError: the file is no TOML, a key is unknown, or a value is not allowed.
    """
    path = folder / DECLARATION_FILE
    if not is_file(path):
        return defaults
    content = read_toml(path, "the sequence")
    for key, value in content.items():
        _check_entry(path, key, value)
    return replace(defaults, **content)


def _check_entry(path: Path, key: str, value: Any) -> None:
    """Refuse an unknown key or a value that is not allowed; DataError names both."""
    names = [field.name for field in fields(Declaration)]
    if key not in names:
        raise DataError(f"{path} has an unknown key {key[:40]!r}: {nearest_name(key[:40], names)}")
    found = f"{path}: {key} = {str(value)[:60]!r}"
    if key in _CHOICES and value not in _CHOICES[key]:
        raise DataError(f"{found}: write {' or '.join(map(repr, _CHOICES[key]))}")
    if key in ("depth_scale", "frame_rate") and not _is_positive(value):
        raise DataError(f"{found}: it must be a positive number, such as 1000 or 30")
    if key == "no_depth" and not (type(value) is int and 0 <= value <= _LARGEST_RAW):
        raise DataError(f"{found}: it must be a whole number from 0 to {_LARGEST_RAW}")
    if key == "format" and not isinstance(value, str):
        raise DataError(f"{found}: it must be a format's name in quotes")
    if key == "camera_axes":
        try:
            Convention(value if isinstance(value, str) else "")
        except ConfigError as error:
            raise DataError(f"{path}: {error}") from None


def _is_positive(value: Any) -> bool:
    # Integers of TOML may be too large for a float; limits far beyond any camera's suffice.
    return type(value) in (int, float) and 1e-9 < value < 1e9 and math.isfinite(value)
