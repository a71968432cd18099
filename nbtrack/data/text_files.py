"""Texts of recordings, read strictly: objects, tables of numbers, poses, calibration.

In calibration files, pixel centres lie at whole numbers, as OpenCV's calibration and all supported
datasets have it: the middle of 640 pixels is 319.5. Inside the package they lie at integer + 0.5.
"""

import json
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError

Times = Float[np.ndarray, "_"]  # s
Parse = Callable[[str], Sequence]
_TOLERANT = {"encoding": "utf-8-sig", "errors": "replace"}  # of a byte-order mark, and of any bytes
_NO_ROW = r"\s*(#|$)"
_HEAD = r"|\s*-?\d+\s+-?\d+\s+-?\d+\s*$"  # of each matrix in Open3D's .log: three whole numbers
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_CAMERA_LINE = "fx fy cx cy, a row of the 3x3 camera matrix, or one focal length"
_FARTHEST = 1e7  # m from the origin: beyond map coordinates, within what floats can square
_RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below
_LARGEST = 1e6  # pixels: no image is so wide
_LENS = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order
_CAMERA_KEYS = {
    "fx", "fy", "cx", "cy", "width", "height", "intrinsic_matrix", "distortion", "coeffs",
    "depth_scale", "scale", *_LENS,
}  # fmt: skip
_MIN_FOCAL = 0.1  # pixels: rays of a shorter one overflow sooner or later


def read_object(path: Path) -> dict[str, Any]:
    """A JSON or TOML file, by its name, that holds an object. Raises DataError otherwise."""
    kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
    try:
        text = path.read_text(**_TOLERANT)
        content = tomllib.loads(text) if kind == "TOML" else json.loads(text)
    # Nesting thousands deep ends the parser's recursion.
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no {kind} ({error}): correct it or write it anew") from None
    if not isinstance(content, dict):
        raise DataError(f"{path} holds {content!r:.40}: it must be an object of names and values")
    return content


def read_rows(
    path: Path, parse: Parse, columns: tuple[int, ...], meaning: str, skipped: str = _NO_ROW
) -> list[Sequence]:
    """What `parse` makes of every line that does not begin as `skipped`: blank, or with `#`.

    Raises DataError for a line of other columns, or for which `parse` raises ValueError.
    """
    rows: list[Sequence] = []
    for number, line in enumerate(path.read_text(**_TOLERANT).splitlines(), start=1):
        if re.match(skipped, line):
            continue
        try:
            row = parse(line)
        except ValueError:
            row = ()
        if len(row) not in (columns if not rows else (len(rows[0]),)):
            advice = "; write decimal points, not commas" * _has_decimal_commas(line)
            found = f"{path} line {number} is {line[:60]!r}"
            raise DataError(f"{found}: every line holds {meaning}{advice}")
        rows.append(row)
    if not rows:
        raise DataError(f"{path} is empty: every line holds {meaning}; write it anew")
    return rows


def _has_decimal_commas(line: str) -> bool:
    """Whether its words are numbers with a comma in place of the point."""
    words = line.split()
    return len(words) > 1 and any(re.fullmatch(r"[-+]?\d+,\d+(e[-+]?\d+)?", w) for w in words)


def _numbers(line: str) -> list[float]:
    """Separated by blanks or commas; NaN and infinity are kept."""
    if _has_decimal_commas(line):
        raise ValueError
    return [float(word) for word in line.replace(",", " ").split()]


def read_poses(path: Path, quaternion: str = "xyzw") -> tuple[Poses, Times | None]:
    """Poses as they stand in a file, checked, and their timestamps (s) where it has quaternions.

    Lines hold `timestamp tx ty tz` and a quaternion in the order that is given, a 4x4 or 3x4
    matrix, or one of the rows of a matrix; else DataError is raised. NaN gives NaN poses.
    """
    skipped = _NO_ROW + _HEAD * (path.suffix == ".log")
    numbers = np.array(read_rows(path, _numbers, (4, 8, 12, 16), _POSE_LINE, skipped))
    if numbers.shape[1] == 8:
        return _from_quaternions(numbers[:, 1:], quaternion, path), numbers[:, 0]
    if numbers.shape == (3, 4):
        numbers = numbers.reshape(1, 12)
    if numbers.shape[1] == 12:
        numbers = np.hstack([numbers, np.tile([0.0, 0, 0, 1], (len(numbers), 1))])
    if numbers.size % 16:
        raise DataError(f"{path} has {len(numbers)} rows: it needs the four of each 4x4 matrix")
    return checked_poses(numbers.reshape(-1, 4, 4), path), None


def _from_quaternions(numbers: np.ndarray, order: str, path: Path) -> Poses:
    """Poses of rows with a position and a quaternion.

    NaN for a frame if a number is none, or its quaternion is zero, as tools write a lost frame.
    """
    is_known = np.isfinite(numbers).all(axis=1, keepdims=True)
    is_known &= (numbers[:, 3:] != 0).any(axis=1, keepdims=True)
    numbers = np.where(is_known, numbers, 3 * [np.nan] + 4 * [0.5])
    # Clipped, so that absurd numbers are refused below and overflow nothing here.
    norms = np.linalg.norm(numbers[:, 3:].clip(-1e6, 1e6), axis=1)
    for i in np.flatnonzero(np.abs(norms - 1) > _RIGID):
        raise DataError(
            f"{path} pose {i} has a quaternion of norm {norms[i]:.3g}: columns must be "
            f"tx ty tz and a unit quaternion ({' '.join('q' + axis for axis in order)})"
        )
    q_xyzw = numbers[:, [3 + order.index(axis) for axis in "xyzw"]]
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(q_xyzw).as_matrix(), numbers[:, :3]
    return checked_poses(poses, path)


def checked_poses(poses: Poses, path: Path) -> Poses:
    """The poses, all NaN where a number is not finite or all are 0: those frames have no pose.

    Raises DataError if a pose is no rigid transform, or absurdly far from the origin.
    """
    is_known = np.isfinite(poses).all(axis=(1, 2))[:, None, None]
    is_known &= (poses[:, :3] != 0).any(axis=(1, 2))[:, None, None]  # of zeros: a lost frame
    # Clipped, so that absurd numbers are refused and overflow nothing.
    T = np.where(is_known, poses, np.eye(4)).clip(-1e8, 1e8)
    R, bottom, far = T[:, :3, :3], T[:, 3] - [0, 0, 0, 1], np.abs(T[:, :3, 3]) > _FARTHEST
    is_wrong = (np.abs(R @ R.mT - np.eye(3)) > _RIGID).any(axis=(1, 2))
    is_wrong |= np.abs(np.linalg.det(R) - 1) > _RIGID
    is_wrong |= (np.abs(bottom) > _RIGID).any(axis=1) | far.any(axis=1)
    for i in np.flatnonzero(is_wrong):
        frame = f" frame {i}" if len(poses) > 1 else ""
        numbers = " ".join(f"{number:.4g}" for number in poses[i].flat)
        raise DataError(
            f"{path}{frame} is no rigid transform in metres ({numbers}): "
            f"rows must be [R | t], right-handed rotation R and t up to {_FARTHEST:g}, and 0 0 0 1"
        )
    return np.where(is_known, poses, np.nan)


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

        Raises DataError, which names `image`, if the proportions are others.
        """
        factor = width / self.size[0] if self.size else 1.0
        if self.size and abs(factor * self.size[1] - height) > 1:
            raise DataError(
                f"{image} is {width}x{height} but {self.source} is for {self.size[0]}x"
                f"{self.size[1]}: images may be resized but not cropped; give their calibration"
            )
        cx, cy = self.principal_point or (width / factor / 2, height / factor / 2)
        in_pixels = (factor * length for length in (self.fx, self.fy, cx, cy))
        return Intrinsics(width, height, *in_pixels)


def read_calibration(path: Path) -> Calibration:
    """A camera from a text or a JSON file.

    Text holds `fx fy cx cy` in a line, OpenCV's 3x3 camera matrix, that within a 4x4 matrix, or
    one focal length. JSON holds an object with fx, fy, cx, cy or Open3D's `intrinsic_matrix` (nine
    numbers column by column) and, if known, width and height (or w and h), a lens as `distortion`,
    `coeffs` or k1, k2, p1, p2, k3, and `depth_scale` or `scale`: depth values a metre, or, below 1,
    metres a value. It may be the value of `camera`, as in Replica's files. Raises DataError if
    something is missing, no number, or impossible.
    """
    K, others = _from_json(path) if path.suffix.lower() == ".json" else _from_text(path)
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    is_matrix = np.allclose(K, camera_matrix(fx, fy, cx, cy), rtol=0, atol=1e-6)
    # NaN fails both: numpy's minimum keeps it, unlike Python's.
    is_camera = np.min([fx, fy]) >= _MIN_FOCAL and np.abs([fx, fy, cx, cy]).max() < _LARGEST
    if fx >= _MIN_FOCAL and -_LARGEST < fy <= -_MIN_FOCAL:
        raise DataError(
            f"{path} gives fy = {fy:g}, as ICL-NUIM does, whose camera has its y axis up: write "
            f'{-fy:g} and, where the poses are of that camera, camera_axes = "right up forward" in '
            "sequence.toml"
        )
    if not (is_matrix and is_camera):
        raise DataError(
            f"{path} gives the camera matrix {K.tolist()}: it must be fx 0 cx, 0 fy cy, 0 0 1 in "
            "pixels, without skew, the focal lengths positive, all finite; calibrate anew"
        )
    return Calibration(path, fx, fy, **{"principal_point": (cx + 0.5, cy + 0.5), **others})


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """OpenCV's, as `read_calibration` takes it."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def _from_text(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    numbers = np.array(read_rows(path, _numbers, (1, 3, 4, 9, 16), _CAMERA_LINE))
    if numbers.size == 1:
        focal = numbers.item()
        return camera_matrix(focal, focal, 0.0, 0.0), {"principal_point": None}
    if numbers.size == 4:
        return camera_matrix(*numbers.flat), {}
    columns = {9: 3, 12: 4, 16: 4}.get(numbers.size)
    if not columns:
        raise DataError(f"{path} holds {numbers.size} numbers: every line holds {_CAMERA_LINE}")
    return numbers.reshape(-1, columns)[:3, :3], {}


def _from_json(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    content = read_object(path)
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    camera = {{"w": "width", "h": "height"}.get(key, key): camera[key] for key in camera}

    def numbers(key: str, *counts: int) -> list[float]:
        """The list of an entry; a single number counts as a list of one."""
        values = camera[key] if isinstance(camera.get(key), list) else [camera.get(key)]
        # NaN is not below anything, and True is no number here.
        are_numbers = all(type(v) in (int, float) and abs(v) < _LARGEST for v in values)
        if not (are_numbers and len(values) in counts):
            text = f"{path}: {key} is {str(camera.get(key))[:40]!r}: write"
            raise DataError(f"{text} {' or '.join(map(str, counts))} finite number(s)")
        return [float(value) for value in values]

    others: dict[str, Any] = {"unused": tuple(sorted(camera.keys() - _CAMERA_KEYS))}
    if lens := camera.keys() & _LENS:
        others["distortion"] = tuple(numbers(key, 1)[0] if key in lens else 0.0 for key in _LENS)
    for key in camera.keys() & {"distortion", "coeffs"}:
        others["distortion"] = tuple(numbers(key, 0, 4, 5, 8))
    for key in camera.keys() & {"depth_scale", "scale"}:
        (value,) = numbers(key, 1)
        if value <= 0:
            raise DataError(f"{path}: {key} is {value:g}: write how many depth values make a metre")
        others["depth_scale"] = value if value >= 1 else 1 / value
    if camera.keys() & {"width", "height"}:
        width, height = *numbers("width", 1), *numbers("height", 1)
        if not (width % 1 == height % 1 == 0 and min(width, height) > 0):
            raise DataError(f"{path} gives a size of {width} x {height}: whole pixels, 1 or more")
        others["size"] = (int(width), int(height))
    if "intrinsic_matrix" in camera:
        return np.array(numbers("intrinsic_matrix", 9)).reshape(3, 3).T, others
    return camera_matrix(*(numbers(key, 1)[0] for key in ("fx", "fy", "cx", "cy"))), others
