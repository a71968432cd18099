"""Calibration files: focal lengths and principal point of the camera that recorded.

In files, pixel centres lie at whole numbers, as OpenCV's calibration and all supported datasets
have it: the middle of 640 pixels is 319.5. Inside the package they lie at integer + 0.5, and half
a pixel is added here.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.data.readers.text_files import read_json, read_numbers

_HALF_PIXEL = 0.5
_EXAMPLE = '{"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5}'
_LARGEST = 1e6  # pixels: no image is so wide
_LEAST_FOCAL = 0.1  # pixels: rays of a shorter one overflow sooner or later


@dataclass(frozen=True)
class Calibration:
    """A camera, before the size of its images is known; pixel centres at integer + 0.5."""

    source: Path  # where it was found, for messages
    fx: float
    fy: float
    principal_point: tuple[float, float] | None = None  # None: the middle of the image
    size: tuple[int, int] | None = None  # width, height that the numbers hold for; None: any
    distortion: tuple[float, ...] = ()  # OpenCV's coefficients k1 k2 p1 p2 k3 ...; empty: none

    def for_size(self, width: int, height: int, image: Path) -> Intrinsics:
        """The camera of images of a size: scaled where the calibration is for another one.

        Raises:
            DataError: the images have other proportions than the calibration; names `image`.
        """
        factor = width / self.size[0] if self.size else 1.0
        if self.size and abs(factor * self.size[1] - height) > 1:
            raise DataError(
                f"{image} is {width}x{height} but {self.source} is for {self.size[0]}x"
                f"{self.size[1]}: images may be resized but not cropped; give their calibration"
            )
        cx, cy = self.principal_point or (width / factor / 2, height / factor / 2)
        return Intrinsics(
            width, height, factor * self.fx, factor * self.fy, factor * cx, factor * cy
        )


def read_calibration(path: Path, needed: str) -> Calibration:
    """A camera from a text or a JSON file.

    Text holds `fx fy cx cy` in a line, or OpenCV's 3x3 camera matrix, or that within a 4x4 matrix.
    JSON holds an object with fx, fy, cx, cy and, if known, width and height (or w and h) and
    `distortion`; it may be the value of `camera`, as in Replica's files. Open3D's
    `intrinsic_matrix`, nine numbers column by column, is understood too.

    Raises:
        MissingError: there is no such file.
        DataError: something in it is missing, no number, or impossible.
    """
    if path.suffix.lower() == ".json":
        return _from_json(path, read_json(path, needed))
    meaning = "fx fy cx cy, or a row of the 3x3 camera matrix"
    numbers = read_numbers(path, (3, 4, 9, 16), meaning, needed)
    if numbers.shape in [(1, 9), (1, 16)]:
        numbers = numbers.reshape(3, 3) if numbers.size == 9 else numbers.reshape(4, 4)
    if numbers.shape == (1, 4):
        return _checked(path, *numbers[0].tolist())
    if numbers.shape not in [(3, 3), (4, 4), (3, 4)]:
        shape = "x".join(map(str, numbers.shape))
        raise DataError(
            f"{path} holds {shape} numbers: it must be 'fx fy cx cy' in one line, or a 3x3 or 4x4 "
            "camera matrix"
        )
    return _from_matrix(path, numbers[:3, :3])


def is_focal(length: float) -> bool:
    """Whether a number can be a focal length in pixels; NaN cannot."""
    return _LEAST_FOCAL <= length < _LARGEST


def as_text(intrinsics: Intrinsics) -> str:
    """OpenCV's 3x3 camera matrix, as `read_calibration` takes it; every digit is kept."""
    cx, cy = intrinsics.cx - _HALF_PIXEL, intrinsics.cy - _HALF_PIXEL
    rows = [[intrinsics.fx, 0.0, cx], [0.0, intrinsics.fy, cy], [0.0, 0.0, 1.0]]
    return "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows)


def _from_matrix(
    path: Path, K: Float[np.ndarray, "3 3"], size: tuple[int, int] | None = None
) -> Calibration:
    zeros = [K[0, 1], K[1, 0], K[2, 0], K[2, 1]]
    if not np.allclose(zeros, 0, atol=1e-9) or not np.isclose(K[2, 2], 1):
        raise DataError(
            f"{path} is no camera matrix ({K[0].tolist()} first): rows must be fx 0 cx, 0 fy cy "
            "and 0 0 1, without skew"
        )
    return _checked(path, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])), size=size)


def _from_json(path: Path, content: dict[str, Any]) -> Calibration:
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    width, height = camera.get("width", camera.get("w")), camera.get("height", camera.get("h"))
    size = None
    if width is not None or height is not None:
        sides = [_number(path, "width", width), _number(path, "height", height)]
        if not all(side in range(1, int(_LARGEST)) for side in sides):
            raise DataError(f"{path} gives a size of {width} x {height}: whole pixels, 1 or more")
        size = (int(sides[0]), int(sides[1]))
    if "intrinsic_matrix" in camera:
        numbers = _numbers(path, "intrinsic_matrix", camera["intrinsic_matrix"])
        if len(numbers) != 9:
            raise DataError(f"{path}: intrinsic_matrix has {len(numbers)} numbers: write nine")
        return _from_matrix(path, np.array(numbers).reshape(3, 3).T, size)
    values = [_number(path, key, camera.get(key)) for key in ("fx", "fy", "cx", "cy")]
    distortion = tuple(_numbers(path, "distortion", camera.get("distortion", [])))
    if len(distortion) not in (0, 4, 5, 8):
        raise DataError(
            f"{path}: distortion has {len(distortion)} numbers: write OpenCV's 4, 5 or 8 "
            "(k1, k2, p1, p2, k3, ...), or leave it out"
        )
    return _checked(path, *values, size=size, distortion=distortion)


def _numbers(path: Path, key: str, values: Any) -> list[float]:
    if not isinstance(values, list):
        raise DataError(f"{path}: {key} is {str(values)[:40]!r}: write a list of numbers")
    return [_number(path, key, value) for value in values]


def _number(path: Path, key: str, value: Any) -> float:
    is_number = type(value) in (int, float) and abs(value) < _LARGEST  # NaN is not below either
    if not is_number:
        raise DataError(
            f"{path}: {key} is {str(value)[:40]!r}: it must be a number; an example: {_EXAMPLE}"
        )
    return float(value)


def _checked(
    path: Path,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    size: tuple[int, int] | None = None,
    distortion: tuple[float, ...] = (),
) -> Calibration:
    if not (is_focal(fx) and is_focal(fy)):
        raise DataError(
            f"{path} gives focal lengths {fx:g} and {fy:g}: they must be positive numbers, in "
            "pixels; calibrate anew"
        )
    if not (abs(cx) < _LARGEST and abs(cy) < _LARGEST):
        raise DataError(
            f"{path} gives the principal point ({cx:g}, {cy:g}): it must be finite, in pixels"
        )
    middle = (cx + _HALF_PIXEL, cy + _HALF_PIXEL)
    return Calibration(path, fx, fy, middle, size, distortion)
