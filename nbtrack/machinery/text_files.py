"""Text files, read strictly: objects, lines, tables of numbers."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged

_TOLERANT = {"encoding": "utf-8-sig", "errors": "replace"}  # of a byte-order mark, and of any bytes
_DECIMAL_COMMA = re.compile(r"(?<!\S)[-+]?\d+,\d+(e[-+]?\d+)?(?!\S)")


def read_object(path: Path, kind: str = "") -> dict[str, Any]:
    """A JSON or TOML file, by its name if not said, of an object. Raises DataError otherwise."""
    kind = kind or ("JSON" if path.suffix.lower() == ".json" else "TOML")
    with naming_damaged(path, f"{kind} file of names and values", "correct it or write it anew"):
        text = path.read_text(**_TOLERANT)
        # Braces, since they raise TypeError for a list or a number.
        return {**(tomllib.loads(text) if kind == "TOML" else json.loads(text))}


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are neither blank nor comments. DataError if there is none."""
    lines = path.read_text(**_TOLERANT).splitlines()
    full = [line for line in lines if line.partition("#")[0].strip()]
    if not full:
        raise DataError(f"{path} is empty: write it anew")
    return full


def read_numbers(path: Path, columns: tuple[int, ...], meaning: str) -> Float[np.ndarray, "n m"]:
    """A table of numbers, separated by blanks or commas; NaN and infinity are kept.

    Raises DataError for anything else, or if the number of columns is none of `columns`. The
    message says what every line should hold: the `meaning`.
    """
    lines = read_lines(path)
    if path.suffix == ".log":  # Open3D's, with a head of three numbers before each matrix
        lines = [line for line in lines if len(line.split()) != 3]
    with naming_damaged(path, "table", f"every line holds {meaning}"):
        if any(_DECIMAL_COMMA.search(line) for line in lines):
            raise ValueError("write decimal points, not commas")
        numbers = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
        if numbers.shape[1] not in columns:
            raise ValueError(f"there are {numbers.shape[1]} columns")
    return numbers
