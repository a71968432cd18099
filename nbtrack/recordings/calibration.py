"""A camera's calibration, from a text or a JSON file.

In calibration files the centre of a pixel has whole coordinates, as OpenCV's calibration and all
supported datasets have it: the middle of 640 pixels is at 319.5. Inside the package the centre of a
pixel lies at integer + 0.5, and the middle at 320.
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
_LARGEST = 1e6  # a larger number in a calibration is a mistake: no image is so many pixels wide
_SHORTEST = 0.1  # of the width: a focal length that gives a view of 157 degrees
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order
# Names of entries in a camera's JSON file that have another name in this package.
_OTHER_NAMES = {"w": "width", "h": "height", "scale": "depth_scale"}
_OTHER_NAMES |= {"coeffs": "distortion", "D": "distortion"}
# The entries that are read, and how many numbers each may have.
_COUNTS = dict.fromkeys(("fx", "fy", "cx", "cy", "width", "height", "depth_scale", *_LENS), (1,))
_COUNTS |= {"intrinsic_matrix": (9,), "distortion": (0, 4, 5, 8, 12, 14)}
_ADVICE = (
    "write finite numbers: fx, fy, cx and cy or intrinsic_matrix, width and height in whole "
    "pixels, both or none, depth_scale above 0, "
    f"OpenCV's lens as distortion or by {', '.join(_LENS)}, and undistort images of another lens"
)
# Names of entries that are not read but may tell of another lens or unit, and the values (in lower
# case) of such entries that tell of the usual lens and unit.
_TELLING = re.compile(
    r"([kpsb]\d+|tau.*|xi|alpha|skew|gamma)$|.*(radial|tangential|dist|lens|fish|model|unit)", re.I
)
_USUAL = ("", "none", "px", "pixel", "pixels", "pinhole", "simple_pinhole", "perspective")
_USUAL += ("opencv", "full_opencv", "radtan", "plumb_bob", "brown_conrady", "rational_polynomial")


@dataclass(frozen=True)
class Calibration:
    """A camera, before the size of its images is known; pixel centres at integer + 0.5."""

    source: Path  # the file, for messages; for an assumed calibration, words that describe it
    fx: float  # pixels, as fy
    fy: float
    principal_point: tuple[float, float] | None = None  # pixels; None: the middle of the image
    # Width and height of the images for which the numbers hold; None: they hold for any size.
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = ()  # OpenCV's coefficients k1 k2 p1 p2 k3 ...; empty: none
    depth_scale: float | None = None  # depth values a metre; None: the file does not say it
    unused: tuple[str, ...] = ()  # names of the file's entries that are not read

    def for_size(self, width: int, height: int, image: Path) -> Intrinsics:
        """The camera of images of a size (pixels), to which the calibration is scaled.

        Raises DataError, which names the file `image`, if the calibration is for images of other
        proportions, if the principal point lies outside of the images, or if the focal length is
        so short that it cannot be in pixels.
        """
        old_width, old_height = self.size or (width, height)
        factor = width / old_width
        # Without a principal point it is the middle of the image.
        old_cx, old_cy = self.principal_point or (width / factor / 2, height / factor / 2)
        cx, cy = factor * old_cx, factor * old_cy
        # Resizing rounds sides to whole pixels, so that heights may differ by one.
        has_proportions = abs(factor * old_height - height) <= 1
        if not (has_proportions and 0 <= cx <= width and 0 <= cy <= height):
            of_size = f"{old_width}x{old_height}" if self.size else "images of another size"
            found = f"{image} is {width}x{height} but {self.source} is for {of_size}"
            advice = "images may be resized but not cropped; give their own camera, or its size"
            raise DataError(f"{found}, with cx, cy then at ({cx:.0f}, {cy:.0f}): {advice}")
        if factor * self.fx < _SHORTEST * width:
            found = f"{self.source} gives fx = {factor * self.fx:g} px for images {width} px wide"
            raise DataError(f"{found}, a view of more than 157 degrees: give it in pixels")
        return Intrinsics(width, height, factor * self.fx, factor * self.fy, cx, cy)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix of focal lengths and a principal point (pixels)."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def calibration(path: Path, K: Float[np.ndarray, "3 3"], size: tuple | None = None) -> Calibration:
    """The camera of OpenCV's matrix K, for images of a size (width, height), or of any size.

    Raises DataError, which names the file `path`, if K has skew or numbers that no camera has.
    """
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    # NaN is not close to anything, not even to NaN.
    has_form = np.allclose(K, camera_matrix(fx, fy, cx, cy), rtol=0, atol=1e-6)
    # Rays of a focal length below 0.1 pixels overflow sooner or later.
    is_in_range = min(fx, fy) >= 0.1 and np.abs(K).max() < _LARGEST
    if has_form and is_in_range and (size is None or min(size) >= 1):
        # In the matrix pixel centres have whole coordinates, in a `Calibration` integer + 0.5.
        return Calibration(path, fx, fy, principal_point=(cx + 0.5, cy + 0.5), size=size)
    raise DataError(
        f"{path} gives the camera matrix {K.tolist()}: it must be fx 0 cx, 0 fy cy, 0 0 1 in "
        "pixels row by row, without skew, the focal lengths positive, all finite; calibrate anew, "
        "or write a negative fy (of a y axis that points up) positive and take the axes from "
        "`data check`"
    )


def read_calibration(path: Path) -> Calibration:
    """Read a camera from a JSON file, or from a text file if the name does not end in `.json`.

    A text file holds OpenCV's 3x3 camera matrix, a 4x4 matrix with this one at its upper left,
    `fx fy cx cy` in a line, or one focal length.

    A JSON file holds an object; in Replica's files this is the value of `camera`. Its entries are
    fx, fy, cx, cy or Open3D's `intrinsic_matrix` (nine numbers column by column); if known, width
    and height (or w and h); a lens as `distortion`, `coeffs`, `D` or k1 to k6, p1, p2; and
    `depth_scale` or `scale`: depth values a metre, or, if below 1, metres a depth value.

    Raises DataError if a number is missing or impossible, or if an entry tells of another lens or
    unit.
    """
    if path.suffix.lower() == ".json":
        return _from_json(path)
    numbers = read_numbers(path, (1, 3, 4, 9, 16), _CAMERA_LINE)  # the columns that a file may have
    if numbers.size == 1:
        f = numbers.item()
        # The zeros are placeholders, which None replaces: the middle of the image.
        return replace(calibration(path, camera_matrix(f, f, 0.0, 0.0)), principal_point=None)
    if numbers.size == 4:
        return calibration(path, camera_matrix(*numbers.flat))
    # 9 numbers are a 3x3 matrix, 12 a 4x4 matrix without its last row, 16 a 4x4 matrix.
    n_columns = {9: 3, 12: 4, 16: 4}.get(numbers.size)
    if not n_columns:
        raise DataError(f"{path} holds {numbers.size} numbers: every line holds {_CAMERA_LINE}")
    return calibration(path, numbers.reshape(-1, n_columns)[:3, :3])


def _from_json(path: Path) -> Calibration:
    """The camera of a JSON file, whose entries `read_calibration` describes."""
    content = read_object(path)
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    entries = {_OTHER_NAMES.get(key, key): value for key, value in camera.items()}
    unused = tuple(sorted(entries.keys() - _COUNTS.keys()))
    with naming_damaged(path, "description of a camera", _ADVICE):
        numbers = {key: _numbers(key, entries[key]) for key in entries.keys() & _COUNTS.keys()}
        # Without distortion it does not matter what the lens is called.
        is_ideal = "distortion" in numbers and not any(numbers["distortion"])
        for key in filter(_TELLING.match, unused):
            if not (is_ideal and key.endswith("model")):
                _check_unused(key, entries[key])
        # Entries that are one number: all but a matrix and a list of distortion.
        single = {key: values[0] for key, values in numbers.items() if len(values) == 1}
        lens = tuple(numbers.get("distortion", [single.get(key, 0.0) for key in _LENS]))
        scale = single.get("depth_scale")  # None if the file does not say it
        # A scale below 1 gives metres a depth value instead of depth values a metre.
        scale = 1 / scale if scale and scale < 1 else scale
        has_size = "width" in single or "height" in single
        # A width without a height is a KeyError, which `naming_damaged` makes a DataError.
        size = (int(single["width"]), int(single["height"])) if has_size else None
        if "intrinsic_matrix" in numbers:
            # The file has the matrix column by column.
            K = np.reshape(numbers["intrinsic_matrix"], (3, 3)).T
        else:  # a missing number is a KeyError
            K = camera_matrix(*[single[key] for key in ("fx", "fy", "cx", "cy")])
    return replace(calibration(path, K, size), distortion=lens, depth_scale=scale, unused=unused)


def _numbers(key: str, value: Any) -> list[float]:
    """The numbers of the entry `key`, whose value is one number or a list of numbers.

    Raises ValueError for any other value, for a count of numbers that `_COUNTS` does not allow, and
    for a number that no camera has.
    """
    values = value if isinstance(value, list) else [value]
    # NaN fails since it is not below anything, and True since its type is bool.
    is_valid = all(type(v) in (int, float) and abs(v) < _LARGEST for v in values)
    is_valid = is_valid and len(values) in _COUNTS[key]
    is_valid = is_valid and (key not in ("width", "height") or values[0] % 1 == 0)
    if not is_valid or (key == "depth_scale" and values[0] <= 0):
        raise ValueError(f"{key} is {str(value)[:40]!r}")
    return [float(v) for v in values]


def _check_unused(key: str, value: Any) -> None:
    """Raises ValueError if an entry that is not read, but `_TELLING`, is of another lens or unit.

    A word in `_USUAL`, zeros, false, null or an empty list as its value stands for the usual lens
    and unit.
    """
    is_usual = value.lower() in _USUAL if isinstance(value, str) else not np.any(value)
    if not is_usual:
        raise ValueError(f"{key} is {str(value)[:40]!r}, which is not used")
