"""Numbers, arrays, images, poses and text files that a user gives, checked."""

import codecs
import json
import re
import tomllib
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from nbtrack.machinery.errors import ConfigError, DataError
from nbtrack.machinery.files import naming_damaged

_FARTHEST = 1e7  # m from the origin: beyond geographic coordinates; floats can square it
# A pose is wrong if its distance from the median position is more than so many times the distance
# within which nine in ten poses lie, or more than so many metres, whichever is larger.
_ALONE = 1000.0
MILLIMETRE = 1e-3  # m; depth images are kept in this unit
_MAX_MILLIMETRES = np.iinfo(np.uint16).max
_MAX_METRES = 100.0  # a median depth beyond it is in another unit (our choice)
_DEPTH_UNITS = "uint16 in mm, or floating point in metres"
RIGID = 1e-2  # deviation of R Rᵀ from the identity: files rounded to a few decimals stay below

# Encodings by their byte-order marks. UTF-32 comes first, since its little-endian mark begins with
# the mark of UTF-16.
_ENCODINGS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
# "Not a number" as Python, its decimals, C, and Microsoft's C print it: -nan(ind), 1.#QNAN, 1.#R.
_NOT_A_NUMBER = re.compile(r"(?i)(?<![^\s,])[-+]?(?:s?nan\d*(?:\(\w*\))?|\d\.#\w*)(?![^\s,])")
_DECIMAL_COMMA = re.compile(r"(?<!\S)[-+]?\d+,\d+(e[-+]?\d+)?(?!\S)")


def check_array(
    what: str, array: Any, shape: tuple, kinds: list, asked: str, of: type = np.ndarray
) -> None:
    """Raises DataError unless `array` is of the class `of` and has this shape and an allowed type.

    `kinds` are the allowed types as jaxtyping has them, as `UInt8`. The message calls the array
    `what`, and describes its allowed types by the words in `asked`.
    """
    if not any(isinstance(array, _type_of(kind, of, shape)) for kind in kinds):
        is_of = isinstance(array, of)
        found = f"{array.dtype} of shape {tuple(array.shape)}" if is_of else type(array).__name__
        wanted = "numpy array" if of is np.ndarray else "tensor"
        raise DataError(f"{what} is {found}: give a {wanted}, {asked}, of shape {shape}")


@cache  # frames and queries are checked thousands of times, and a type takes 50 us to make
def _type_of(kind: Any, of: type, shape: tuple) -> type:
    """The type, for `isinstance`, of arrays of this class, kind of numbers and shape."""
    return kind[of, " ".join(map(str, shape))]


def tensor_of(array: np.ndarray) -> Tensor:
    """A tensor with an array's values; it shares the array's memory where PyTorch can do so."""
    # PyTorch refuses foreign byte orders and negative strides. `from_dlpack`, unlike `from_numpy`,
    # does not warn of read-only memory.
    is_plain = array.dtype.isnative and min(array.strides, default=0) >= 0
    return torch.from_dlpack(array if is_plain else array.astype(array.dtype.newbyteorder("=")))


def checked_images(color: Any, depth: Any, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A camera's colour and depth image, checked and copied.

    Args:
        color: RGB, (rows, columns, 3), uint8.
        depth: z-depth, (rows, columns): uint16 in millimetres, or floating point in metres.
        size: the rows and columns that both must have.

    Returns the colour as it is, and the depth in whole millimetres as int32. A depth is 0, which
    means "not measured", where it was 0, negative, not finite, masked, or at least 65535 mm. Raises
    DataError for another size or type, for masked colour, and for a median above `_MAX_METRES`.
    """
    check_array("color", color, (*size, 3), [UInt8], "uint8")
    check_array("depth", depth, size, [UInt16, Float], _DEPTH_UNITS)
    if np.ma.is_masked(color):
        raise DataError("color has masked pixels: fill them; only depth may lack some")
    filled = np.ma.filled(depth, 0)
    if filled.dtype.type != np.uint16:  # then in metres; `type` is the same for both byte orders
        metres = np.where(np.isfinite(filled) & (filled > 0), filled, 0).astype(np.float64)
        median = np.median(metres[metres > 0]) if metres.any() else 0
        if median > _MAX_METRES:
            raise DataError(f"depth is {median:.4g} m in the median: give {_DEPTH_UNITS}")
        filled = (metres / MILLIMETRE).round().clip(0, _MAX_MILLIMETRES)
    depth_mm = filled.astype(np.int32)
    # This largest value means "farther than 16 bits can say", so it is no measurement.
    depth_mm[depth_mm >= _MAX_MILLIMETRES] = 0
    return np.array(np.ma.getdata(color), order="C"), depth_mm


def number(name: str, value: Any, minimum: float, maximum: float, kind: type = Real) -> Any:
    """A number from `minimum` to `maximum`, as a float; with the kind `Integral`, as an int.

    Raises ConfigError, whose message calls the number `name`, for any other value.
    """
    if not isinstance(value, kind) or isinstance(value, bool) or not minimum <= value <= maximum:
        what = "a whole number" if kind is Integral else "a number"
        raise ConfigError(f"{name} is {value!r:.80}: give {what} from {minimum:g} to {maximum:g}")
    return int(value) if kind is Integral else float(value)


def whole_number(name: str, value: Any, minimum: int = 0) -> int:
    """A whole number of 32 bits from `minimum` on, as an int; generators take no larger seed.

    Raises ConfigError, whose message calls the number `name`, for any other value.
    """
    return number(name, value, minimum, 2**32 - 1, Integral)


def checked_pose(T_world_camera: Any) -> Float[np.ndarray, "4 4"]:
    """One pose (m), 4 x 4, copied in double precision.

    Raises DataError if it is no rigid transform, or is not known: not finite, or all 0.
    """
    if isinstance(T_world_camera, Tensor):  # perhaps on a GPU, or with gradients
        T_world_camera = T_world_camera.detach().cpu().numpy()
    try:
        # Unlike `dtype`, this refuses complex numbers and texts.
        pose = np.asarray(T_world_camera).astype(np.float64, casting="same_kind")
    except (TypeError, ValueError):
        pose = np.empty(0)  # of a shape that is refused
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not pose[:3].any():
        raise DataError("T_world_camera is no rigid transform: give 4 x 4 finite numbers")
    return checked_poses(pose[None], Path("T_world_camera"))[0]


def checked_start(
    pose: Any, minimum: tuple[float, ...], maximum: tuple[float, ...]
) -> Float[np.ndarray, "4 4"]:
    """`checked_pose` of a camera in a map, whose box (m) the corners `minimum` and `maximum` span.

    It also raises DataError if no depth image reaches the box from there: so a pose in another
    world than the map's, or in millimetres, is found.
    """
    start = checked_pose(pose)
    outside_m = np.linalg.norm(start[:3, 3] - start[:3, 3].clip(minimum, maximum))
    if outside_m > MILLIMETRE * _MAX_MILLIMETRES:
        found = f"the start lies {outside_m:.0f} m outside of the map"
        advice = "give it in the map's world, as by read_sequence(origin=room.record['origin'])"
        raise DataError(f"{found}: {advice}")
    return start


def checked_poses(poses: Float[np.ndarray, "_ 4 4"], path: Path) -> Float[np.ndarray, "_ 4 4"]:
    """Check the poses (m) of a file's frames; returns them with NaN for frames that have none.

    A frame has no pose if a number of its matrix is not finite, or if the first three rows are 0.
    Raises DataError if a pose is no rigid transform, or is absurdly far from the origin or from the
    other poses. The message names `path`.
    """
    is_known = np.isfinite(poses).all(axis=(1, 2)) & (poses[:, :3] != 0).any(axis=(1, 2))
    # The identity stands for unknown poses, and passes all checks. Clipped numbers are still far
    # enough off to be refused, and overflow nothing.
    T = np.where(is_known[:, None, None], poses, np.eye(4)).clip(-1e8, 1e8)
    R = T[:, :3, :3]
    is_wrong = (np.abs(R @ R.mT - np.eye(3)) > RIGID).any(axis=(1, 2))
    is_wrong |= np.abs(np.linalg.det(R) - 1) > RIGID
    is_wrong |= (np.abs(T[:, 3] - [0, 0, 0, 1]) > RIGID).any(axis=1)
    is_wrong |= (np.abs(T[:, :3, 3]) > _FARTHEST).any(axis=1)
    if is_known.any():
        center = np.median(T[is_known, :3, 3], axis=0)
        distances = np.linalg.norm(T[:, :3, 3] - center, axis=1)
        # "lower" takes the distance of one pose, which is never the farthest of several.
        usual = np.quantile(distances[is_known], 0.9, method="lower")
        is_wrong |= is_known & (distances > _ALONE * max(1.0, usual))
    if is_wrong.any():
        i = is_wrong.argmax()  # the first wrong pose
        frame = f" frame {i}" if len(poses) > 1 else ""
        numbers = " ".join(f"{number:.4g}" for number in poses[i].flat)
        raise DataError(
            f"{path}{frame} is no rigid transform in metres ({numbers}): "
            f"rows must be [R | t], right-handed rotation R and t up to {_FARTHEST:g} and near the "
            "other frames', and 0 0 0 1; write nan for a frame that is lost"
        )
    return np.where(is_known[:, None, None], poses, np.nan)


def read_object(path: Path, kind: str = "") -> dict[str, Any]:
    """The names and values in a file with a JSON object or a TOML document.

    `kind` is "JSON" or "TOML". Without it, a file whose name ends in `.json` is read as JSON, and
    any other as TOML. Raises DataError for any other content.
    """
    kind = kind or ("JSON" if path.suffix.lower() == ".json" else "TOML")
    with naming_damaged(path, f"{kind} file of names and values", "correct it or write it anew"):
        text = read_text(path)
        # Unpacking raises TypeError where the JSON is no object but a list, text or number.
        return {**(tomllib.loads(text) if kind == "TOML" else json.loads(text))}


def read_text(path: Path) -> str:
    """The text of a file, decoded by its byte-order mark, or as UTF-8 if it has none.

    Bytes that cannot be decoded are replaced.
    """
    with path.open("rb") as file:
        start = file.read(4)
    marked = [encoding for mark, encoding in _ENCODINGS.items() if start.startswith(mark)]
    encoding = marked[0] if marked else "utf-8-sig"  # this one skips the mark of UTF-8
    return path.read_text(encoding=encoding, errors="replace")


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that hold more than blanks and a comment after `#`.

    Raises DataError if there is none.
    """
    full = [line for line in read_text(path).splitlines() if line.partition("#")[0].strip()]
    if not full:
        raise DataError(f"{path} is empty: write it anew")
    return full


def read_numbers(path: Path, columns: tuple[int, ...], meaning: str) -> Float[np.ndarray, "n m"]:
    """Read a table of numbers that are separated by blanks or commas.

    NaN, as `_NOT_A_NUMBER` spells it, and infinity are kept. Raises DataError for anything else,
    and if the number of columns is not one of `columns`. The message says what a line should hold
    by the words in `meaning`.
    """
    # Some spellings of NaN hold a `#`, with which comments begin for `np.loadtxt`.
    lines = [_NOT_A_NUMBER.sub("nan", line) for line in read_lines(path)]
    if path.suffix == ".log":  # a trajectory of Open3D: a line of three numbers before each matrix
        lines = [line for line in lines if len(line.split()) != 3]
    with naming_damaged(path, "table", f"every line holds {meaning}"):
        if any(_DECIMAL_COMMA.search(line) for line in lines):
            raise ValueError("write decimal points, not commas")
        numbers = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
        if numbers.shape[1] not in columns:
            raise ValueError(f"there are {numbers.shape[1]} columns")
    return numbers
