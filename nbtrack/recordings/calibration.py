"""A camera's calibration, from a text or a JSON file.

In calibration files, pixel centres lie at whole numbers, as OpenCV's calibration and all supported
datasets have it: the middle of 640 pixels is 319.5. Inside the package they lie at integer + 0.5.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.core.files import naming_damaged
from nbtrack.data.text_files import read_numbers, read_object

_CAMERA_LINE = "fx fy cx cy, a row of the 3x3 camera matrix, or one focal length"
_LARGEST = 1e6  # pixels: no image is so wide
_MIN_FOCAL = 0.1  # pixels: rays of a shorter one overflow sooner or later
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order
# Entries of a camera's JSON file, by names of this package, and how many numbers each may have.
_OTHER_NAMES = {"w": "width", "h": "height", "coeffs": "distortion", "scale": "depth_scale"}
_COUNTS = dict.fromkeys(("fx", "fy", "cx", "cy", "width", "height", "depth_scale", *_LENS), (1,))
_COUNTS |= {"intrinsic_matrix": (9,), "distortion": (0, 4, 5, 8, 12, 14)}
_ADVICE = (
    "write finite numbers: width and height in whole pixels, both or none, depth_scale above 0, "
    f"OpenCV's lens as distortion or by {', '.join(_LENS)}, and undistort images of another lens"
)
# Other entries that tell of the camera, and the words that say what holds anyway.
_TELLING = re.compile(
    r"([kpsb]\d+|tau.*|xi|alpha|skew|gamma)$|.*(radial|tangential|dist|lens|fish|model|unit)", re.I
)
_USUAL = ("", "none", "px", "pixel", "pixels", "pinhole", "simple_pinhole", "perspective")
_USUAL += ("opencv", "full_opencv", "radtan", "plumb_bob", "brown_conrady", "rational_polynomial")


@dataclass(frozen=True)
class Calibration:
    """A camera, before the size of its images is known; pixel centres at integer + 0.5."""

    source: Path  # where it was found, for messages; of an assumed one, words for it
    fx: float
    fy: float
    principal_point: tuple[float, float] | None = None  # None: the middle of the image
    size: tuple[int, int] | None = None  # width, height that the numbers hold for; None: any
    distortion: tuple[float, ...] = ()  # OpenCV's coefficients k1 k2 p1 p2 k3 ...; empty: none
    depth_scale: float | None = None  # depth values a metre, where the file says it
    unused: tuple[str, ...] = ()  # what else the file says

    def for_size(self, width: int, height: int, image: Path) -> Intrinsics:
        """The camera of images of a size: scaled where the calibration is for another one.

        Raises DataError, which names `image`, if the proportions are others, or the principal
        point lies outside.
        """
        factor = width / self.size[0] if self.size else 1.0
        cx, cy = self.principal_point or (width / factor / 2, height / factor / 2)
        fx, fy, cx, cy = (factor * length for length in (self.fx, self.fy, cx, cy))
        is_alike = not self.size or abs(factor * self.size[1] - height) <= 1
        if not (is_alike and 0 <= cx <= width and 0 <= cy <= height):
            size = "{}x{}".format(*self.size) if self.size else "any size"
            raise DataError(
                f"{image} is {width}x{height} but {self.source} is for {size}, with cx, cy then at "
                f"({cx:.0f}, {cy:.0f}): images may be resized but not cropped; give the camera of "
                "these images, or the width and height that its numbers hold for"
            )
        return Intrinsics(width, height, fx, fy, cx, cy)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix, as `read_calibration` takes it."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def calibration(path: Path, K: Float[np.ndarray, "3 3"], **others: Any) -> Calibration:
    """The camera of OpenCV's matrix, and what else is known of it.

    Raises DataError, which names the file, where the numbers are no camera's.
    """
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    # Also false for NaN.
    is_camera = np.allclose(K, camera_matrix(fx, fy, cx, cy), rtol=0, atol=1e-6)
    is_camera &= min(fx, fy) >= _MIN_FOCAL and np.abs(K).max() < _LARGEST
    if is_camera and min(others.get("size", (1,))) >= 1:
        return Calibration(path, fx, fy, **{"principal_point": (cx + 0.5, cy + 0.5), **others})
    raise DataError(
        f"{path} gives the camera matrix {K.tolist()}: it must be fx 0 cx, 0 fy cy, 0 0 1 in "
        "pixels, without skew, the focal lengths positive, all finite; calibrate anew, or write a "
        "negative fy (of a y axis that points up) positive and take the axes from `data check`"
    )


def read_calibration(path: Path) -> Calibration:
    """A camera from a text or a JSON file.

    Text holds `fx fy cx cy` in a line, OpenCV's 3x3 camera matrix, that within a 4x4 matrix, or
    one focal length. JSON holds an object with fx, fy, cx, cy or Open3D's `intrinsic_matrix` (nine
    numbers column by column) and, if known, width and height (or w and h), a lens as `distortion`,
    `coeffs` or k1 to k6, p1, p2, and `depth_scale` or `scale`: depth values a metre, or, below 1,
    metres a value. It may be the value of `camera`, as in Replica's files. Raises DataError if
    something is missing, no number, or impossible, or tells of another lens or unit.
    """
    if path.suffix.lower() == ".json":
        return _from_json(path)
    numbers = read_numbers(path, (1, 3, 4, 9, 16), _CAMERA_LINE)
    if numbers.size == 1:
        focal = numbers.item()
        return calibration(path, camera_matrix(focal, focal, 0.0, 0.0), principal_point=None)
    if numbers.size == 4:
        return calibration(path, camera_matrix(*numbers.flat))
    columns = {9: 3, 12: 4, 16: 4}.get(numbers.size)
    if not columns:
        raise DataError(f"{path} holds {numbers.size} numbers: every line holds {_CAMERA_LINE}")
    return calibration(path, numbers.reshape(-1, columns)[:3, :3])


def _from_json(path: Path) -> Calibration:
    content = read_object(path)
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    camera = {_OTHER_NAMES.get(key, key): value for key, value in camera.items()}
    unused = tuple(sorted(camera.keys() - _COUNTS.keys()))
    others: dict[str, Any] = {"unused": unused}
    with naming_damaged(path, "description of a camera", _ADVICE):
        for key in unused:
            _check_unused(key, camera[key])
        found = {key: _numbers(key, camera[key]) for key in camera.keys() & _COUNTS.keys()}
        lens = [found.get(key, [0.0])[0] for key in _LENS]
        others["distortion"] = tuple(found.get("distortion", lens))
        if "depth_scale" in found:
            (scale,) = found["depth_scale"]
            others["depth_scale"] = scale if scale >= 1 else 1 / scale
        if found.keys() & {"width", "height"}:
            others["size"] = int(*found["width"]), int(*found["height"])
        if "intrinsic_matrix" in found:
            return calibration(path, np.reshape(found["intrinsic_matrix"], (3, 3)).T, **others)
        numbers = (found.get(key, [np.nan])[0] for key in ("fx", "fy", "cx", "cy"))
        return calibration(path, camera_matrix(*numbers), **others)


def _numbers(key: str, value: Any) -> list[float]:
    """The numbers of an entry. Raises ValueError where they are others than it may have."""
    values = value if isinstance(value, list) else [value]
    # NaN is not below anything, and True is no number here.
    is_valid = all(type(v) in (int, float) and abs(v) < _LARGEST for v in values)
    is_valid = is_valid and len(values) in _COUNTS[key]
    if key in ("width", "height"):
        is_valid = is_valid and values[0] % 1 == 0
    if not is_valid or (key == "depth_scale" and values[0] <= 0):
        raise ValueError(f"{key} is {str(value)[:40]!r}")
    return [float(v) for v in values]


def _check_unused(key: str, value: Any) -> None:
    """Raises ValueError where an entry that is not used tells of another lens or unit."""
    is_usual = value.lower() in _USUAL if isinstance(value, str) else not np.any(value)
    if _TELLING.match(key) and not is_usual:
        raise ValueError(f"{key} is {str(value)[:40]!r}, which is not used")
