"""Texts of recordings, read strictly: objects, tables of numbers, poses, calibration.

In calibration files, pixel centres lie at whole numbers, as OpenCV's calibration and all supported
datasets have it: the middle of 640 pixels is 319.5. Inside the package they lie at integer + 0.5.
"""

import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Poses
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError
from nbtrack.core.files import naming_damaged

Times = Float[np.ndarray, "_"]  # s
_TOLERANT = {"encoding": "utf-8-sig", "errors": "replace"}  # of a byte-order mark, and of any bytes
_DECIMAL_COMMA = re.compile(r"(?<!\S)[-+]?\d+,\d+(e[-+]?\d+)?(?!\S)")
_POSE_LINE = "'timestamp tx ty tz qx qy qz qw', 16 or 12 numbers of a matrix, or 4 of a row of one"
_CAMERA_LINE = "fx fy cx cy, a row of the 3x3 camera matrix, or one focal length"
_FARTHEST = 1e7  # m from the origin: beyond map coordinates, within what floats can square
_ALONE = 1000.0  # m from the middle, and so many times as far as nine in ten: no camera went there
_LATEST = 1e12  # s: no timestamp is larger, and larger numbers overflow
_RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below
_LARGEST = 1e6  # pixels: no image is so wide
_LENS = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order
# Entries of a camera's JSON file, and how many numbers each may have.
_COUNTS = dict.fromkeys(("fx", "fy", "cx", "cy", "width", "height", *_LENS), (1,))
_COUNTS |= {"depth_scale": (1,), "scale": (1,), "intrinsic_matrix": (9,)}
_COUNTS |= {"distortion": (0, 4, 5, 8), "coeffs": (0, 4, 5, 8)}
_MIN_FOCAL = 0.1  # pixels: rays of a shorter one overflow sooner or later


def read_object(path: Path) -> dict[str, Any]:
    """A JSON or TOML file, by its name, that holds an object. Raises DataError otherwise."""
    kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
    with naming_damaged(path, f"{kind} file of names and values", "correct it or write it anew"):
        text = path.read_text(**_TOLERANT)
        return {**(tomllib.loads(text) if kind == "TOML" else json.loads(text))}


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are neither blank nor comments. DataError if there is none."""
    lines = path.read_text(**_TOLERANT).splitlines()
    if lines := [line for line in lines if line.partition("#")[0].strip()]:
        return lines
    raise DataError(f"{path} is empty: write it anew")


def read_numbers(path: Path, columns: tuple[int, ...], meaning: str) -> Float[np.ndarray, "n m"]:
    """A table of numbers, separated by blanks or commas; NaN and infinity are kept.

    Raises DataError for anything else, or if it has not one of the numbers of columns.
    """
    lines = read_lines(path)
    if path.suffix == ".log":  # Open3D's, with a head of three numbers before each matrix
        lines = [line for line in lines if len(line.split()) != 3]
    with naming_damaged(path, "table", f"every line holds {meaning}"):
        if any(map(_DECIMAL_COMMA.search, lines)):
            raise ValueError("write decimal points, not commas")
        numbers = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
        if numbers.shape[1] not in columns:
            raise ValueError(f"there are {numbers.shape[1]} columns")
    return numbers


def read_poses(path: Path, quaternion: str = "xyzw") -> tuple[Poses, Times | None]:
    """Poses as they stand in a file, checked, and their timestamps (s) where it has quaternions.

    Lines hold `timestamp tx ty tz` and a quaternion in the order that is given, a 4x4 or 3x4
    matrix, or one of the rows of a matrix; else DataError is raised. NaN gives NaN poses.
    """
    numbers = read_numbers(path, (4, 8, 12, 16), _POSE_LINE)
    if numbers.shape[1] == 8:
        stamps = np.where(np.abs(numbers[:, 0]) < _LATEST, numbers[:, 0], np.nan)
        return _from_quaternions(numbers, quaternion, path), stamps
    if numbers.shape == (3, 4):
        numbers = numbers.reshape(1, 12)
    if numbers.shape[1] == 12:
        numbers = np.hstack([numbers, np.tile([0.0, 0, 0, 1], (len(numbers), 1))])
    if numbers.size % 16:
        raise DataError(f"{path} has {len(numbers)} rows: it needs the four of each 4x4 matrix")
    return checked_poses(numbers.reshape(-1, 4, 4), path), None


def _from_quaternions(numbers: Float[np.ndarray, "n 8"], order: str, path: Path) -> Poses:
    """Poses of rows with a timestamp, a position and a quaternion.

    NaN for a frame if a number is none, or its quaternion is zero, as tools write a lost frame.
    """
    is_known = np.isfinite(numbers[:, 1:]).all(axis=1) & (numbers[:, 4:] != 0).any(axis=1)
    values = np.where(is_known[:, None], numbers, 4 * [np.nan] + 4 * [0.5])
    # Clipped, so that absurd numbers are refused and overflow nothing here.
    norms = np.linalg.norm(values[:, 4:].clip(-1e6, 1e6), axis=1)
    is_timed = np.abs(numbers[:, 0]) < _LATEST
    for i in np.flatnonzero((np.abs(norms - 1) > _RIGID) | (is_known & ~is_timed)):
        raise DataError(
            f"{path} pose {i} has the time {numbers[i, 0]:.13g} and a quaternion of norm "
            f"{norms[i]:.3g}: columns must be finite timestamps (s), tx ty tz and a unit "
            f"quaternion ({' '.join('q' + axis for axis in order)})"
        )
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    q_xyzw = values[:, [4 + order.index(axis) for axis in "xyzw"]]
    poses[:, :3, :3] = Rotation.from_quat(q_xyzw).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return checked_poses(poses, path)


def checked_poses(poses: Poses, path: Path) -> Poses:
    """The poses, all NaN where a number is not finite or all are 0: those frames have no pose.

    Raises DataError if a pose is no rigid transform, or absurdly far from the origin.
    """
    is_known = np.isfinite(poses).all(axis=(1, 2)) & (poses[:, :3] != 0).any(axis=(1, 2))
    # Clipped, so that absurd numbers are refused and overflow nothing.
    T = np.where(is_known[:, None, None], poses, np.eye(4)).clip(-1e8, 1e8)
    R = T[:, :3, :3]
    is_wrong = (np.abs(R @ R.mT - np.eye(3)) > _RIGID).any(axis=(1, 2))
    is_wrong |= np.abs(np.linalg.det(R) - 1) > _RIGID
    is_wrong |= (np.abs(T[:, 3] - [0, 0, 0, 1]) > _RIGID).any(axis=1)
    is_wrong |= (np.abs(T[:, :3, 3]) > _FARTHEST).any(axis=1)
    if is_known.any():
        away = np.linalg.norm(T[:, :3, 3] - np.median(T[is_known, :3, 3], axis=0), axis=1)
        usual = np.quantile(away[is_known], 0.9, method="lower")
        is_wrong |= is_known & (away > _ALONE * max(1.0, usual))
    for i in np.flatnonzero(is_wrong):
        frame = f" frame {i}" if len(poses) > 1 else ""
        numbers = " ".join(f"{number:.4g}" for number in poses[i].flat)
        raise DataError(
            f"{path}{frame} is no rigid transform in metres ({numbers}): "
            f"rows must be [R | t], right-handed rotation R and t up to {_FARTHEST:g} and near the "
            "other frames', and 0 0 0 1; write nan for a frame that is lost"
        )
    return np.where(is_known[:, None, None], poses, np.nan)


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
    if not (is_matrix and is_camera):
        advice = "calibrate anew"
        if fy < 0:  # as in ICL-NUIM
            advice = (
                "a negative fy is that of a camera whose y axis points up: write it positive, and "
                "if `data check` then finds other axes, the camera_axes that it names"
            )
        raise DataError(
            f"{path} gives the camera matrix {K.tolist()}: it must be fx 0 cx, 0 fy cy, 0 0 1 in "
            f"pixels, without skew, the focal lengths positive, all finite; {advice}"
        )
    return Calibration(path, fx, fy, **{"principal_point": (cx + 0.5, cy + 0.5), **others})


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix, as `read_calibration` takes it."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def _from_text(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    numbers = read_numbers(path, (1, 3, 4, 9, 16), _CAMERA_LINE)
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
    others: dict[str, Any] = {"unused": tuple(sorted(camera.keys() - _COUNTS.keys()))}
    found = {}
    for key in camera.keys() & _COUNTS.keys():
        values = camera[key] if isinstance(camera[key], list) else [camera[key]]
        # NaN is not below anything, and True is no number here.
        are_numbers = all(type(v) in (int, float) and abs(v) < _LARGEST for v in values)
        if not are_numbers or len(values) not in _COUNTS[key]:
            counts = " or ".join(map(str, _COUNTS[key]))
            said = f"{path}: {key} is {str(camera[key])[:40]!r}"
            raise DataError(f"{said}: write {counts} finite number(s)")
        found[key] = [float(value) for value in values]
    if found.keys() & _LENS:
        others["distortion"] = tuple(found.get(key, [0.0])[0] for key in _LENS)
    for key in found.keys() & {"distortion", "coeffs"}:
        others["distortion"] = tuple(found[key])
    for key in found.keys() & {"depth_scale", "scale"}:
        (value,) = found[key]
        if value <= 0:
            raise DataError(f"{path}: {key} is {value:g}: write how many depth values make a metre")
        others["depth_scale"] = value if value >= 1 else 1 / value
    if found.keys() & {"width", "height"}:
        size = [*found.get("width", []), *found.get("height", [])]
        if len(size) < 2 or min(size) < 1 or any(side % 1 for side in size):
            raise DataError(f"{path} gives the size {size}: write width and height, whole pixels")
        others["size"] = tuple(map(int, size))
    if "intrinsic_matrix" in found:
        return np.array(found["intrinsic_matrix"]).reshape(3, 3).T, others
    named = (found.get(key, [np.nan])[0] for key in ("fx", "fy", "cx", "cy"))
    return camera_matrix(*named), others
