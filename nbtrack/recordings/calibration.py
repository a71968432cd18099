"""A camera's calibration, from a text or a JSON file.

In calibration files, pixel centres lie at whole numbers, as OpenCV's calibration and all supported
datasets have it: the middle of 640 pixels is 319.5. Inside the package they lie at integer + 0.5.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged
from nbtrack.machinery.inputs import read_numbers, read_object

_CAMERA_LINE = "fx fy cx cy, a row of the 3x3 camera matrix, or one focal length"
_LARGEST = 1e6  # of any number of a camera: no image is so many pixels wide
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order
# Entries of a camera's JSON file, by names of this package, and how many numbers each may have.
_OTHER_NAMES = {"w": "width", "h": "height", "coeffs": "distortion", "scale": "depth_scale"}
_COUNTS = dict.fromkeys(("fx", "fy", "cx", "cy", "width", "height", "depth_scale", *_LENS), (1,))
_COUNTS |= {"intrinsic_matrix": (9,), "distortion": (0, 4, 5, 8, 12, 14)}
_ADVICE = (
    "write finite numbers: width and height in whole pixels, both or none, depth_scale above 0, "
    f"OpenCV's lens as distortion or by {', '.join(_LENS)}, and undistort images of another lens"
)
# Unused entries by whose names a camera may have another lens or unit than is read here, and the
# values (small letters) with which it has not.
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
        own_width, own_height = self.size or (width, height)
        factor = width / own_width
        # In pixels of the calibration; without a principal point it is the middle of the image.
        own_cx, own_cy = self.principal_point or (width / factor / 2, height / factor / 2)
        cx, cy = factor * own_cx, factor * own_cy
        # Resizing rounds sides to whole pixels, so that heights may differ by one.
        if not (abs(factor * own_height - height) <= 1 and 0 <= cx <= width and 0 <= cy <= height):
            found = f"{image} is {width}x{height} but {self.source} is for {own_width}x{own_height}"
            advice = "images may be resized but not cropped; give their own camera, or its size"
            raise DataError(f"{found}, with cx, cy then at ({cx:.0f}, {cy:.0f}): {advice}")
        return Intrinsics(width, height, factor * self.fx, factor * self.fy, cx, cy)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix, as `read_calibration` takes it."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def calibration(path: Path, K: Float[np.ndarray, "3 3"], size: tuple | None = None) -> Calibration:
    """The camera of OpenCV's matrix, for images of a size (width, height), or of any.

    Raises DataError, which names the file, where the numbers are no camera's.
    """
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    # Also false for NaN.
    has_form = np.allclose(K, camera_matrix(fx, fy, cx, cy), rtol=0, atol=1e-6)
    # Rays of a focal length below 0.1 pixels overflow sooner or later.
    is_in_range = min(fx, fy) >= 0.1 and np.abs(K).max() < _LARGEST
    if has_form and is_in_range and (size is None or min(size) >= 1):
        # In the matrix pixel centres are whole numbers.
        return Calibration(path, fx, fy, principal_point=(cx + 0.5, cy + 0.5), size=size)
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
    numbers = read_numbers(path, (1, 3, 4, 9, 16), _CAMERA_LINE)  # so many may stand in a line
    if numbers.size == 1:
        f = numbers.item()
        # The 0 are placeholders: without a principal point it is the middle of the image.
        return replace(calibration(path, camera_matrix(f, f, 0.0, 0.0)), principal_point=None)
    if numbers.size == 4:
        return calibration(path, camera_matrix(*numbers.flat))
    # By how many numbers there are: 3x3, 4x4 without its last row, 4x4.
    n_columns = {9: 3, 12: 4, 16: 4}.get(numbers.size)
    if not n_columns:
        raise DataError(f"{path} holds {numbers.size} numbers: every line holds {_CAMERA_LINE}")
    return calibration(path, numbers.reshape(-1, n_columns)[:3, :3])


def _from_json(path: Path) -> Calibration:
    """As `read_calibration`; a missing number of the matrix is NaN, which `calibration` refuses."""
    content = read_object(path)
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    entries = {_OTHER_NAMES.get(key, key): value for key, value in camera.items()}
    unused = tuple(sorted(entries.keys() - _COUNTS.keys()))
    with naming_damaged(path, "description of a camera", _ADVICE):
        for key in unused:
            _check_unused(key, entries[key])
        used = {key: _numbers(key, entries[key]) for key in entries.keys() & _COUNTS.keys()}
        single = {key: numbers[0] for key, numbers in used.items() if len(numbers) == 1}
        lens = tuple(used.get("distortion", [single.get(key, 0.0) for key in _LENS]))
        stored = single.get("depth_scale")
        scale = 1 / stored if stored and stored < 1 else stored  # below 1 it is metres a value
        has_size = "width" in single or "height" in single
        # One without the other is a KeyError, which `naming_damaged` makes a DataError.
        size = (int(single["width"]), int(single["height"])) if has_size else None
        K = camera_matrix(*[single.get(key, np.nan) for key in ("fx", "fy", "cx", "cy")])
        if "intrinsic_matrix" in used:
            K = np.reshape(used["intrinsic_matrix"], (3, 3)).T  # the file has it by columns
    return replace(calibration(path, K, size), distortion=lens, depth_scale=scale, unused=unused)


def _numbers(key: str, value: Any) -> list[float]:
    """The numbers of the entry `key`, whose value is one number or a list of them.

    Raises ValueError if it is anything else, has a count of numbers that is not in `_COUNTS`, or a
    number that no camera has.
    """
    values = value if isinstance(value, list) else [value]
    # NaN is not below anything, and True is no number here.
    is_valid = all(type(v) in (int, float) and abs(v) < _LARGEST for v in values)
    is_valid = is_valid and len(values) in _COUNTS[key]
    is_valid = is_valid and (key not in ("width", "height") or values[0] % 1 == 0)
    if not is_valid or (key == "depth_scale" and values[0] <= 0):
        raise ValueError(f"{key} is {str(value)[:40]!r}")
    return [float(v) for v in values]


def _check_unused(key: str, value: Any) -> None:
    """Raises ValueError if an entry that is not used means another lens or unit.

    Only entries with names as in `_TELLING` are checked. They may hold a word of `_USUAL`, zeros,
    false, null or an empty list, which stand for the usual lens and unit.
    """
    is_usual = value.lower() in _USUAL if isinstance(value, str) else not np.any(value)
    if _TELLING.match(key) and not is_usual:
        raise ValueError(f"{key} is {str(value)[:40]!r}, which is not used")
