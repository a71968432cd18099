"""Text files, read strictly: objects, lines, tables of numbers."""

import codecs
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged

# By the byte-order mark; that of UTF-32 begins with that of UTF-16.
_ENCODINGS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
# "Not a number" as Python, its decimals, C, and Microsoft's C print it: -nan(ind), 1.#QNAN, 1.#R.
_NOT_A_NUMBER = re.compile(r"(?i)(?<![^\s,])[-+]?(?:s?nan\d*(?:\(\w*\))?|\d\.#\w*)(?![^\s,])")
_DECIMAL_COMMA = re.compile(r"(?<!\S)[-+]?\d+,\d+(e[-+]?\d+)?(?!\S)")


def read_object(path: Path, kind: str = "") -> dict[str, Any]:
    """A JSON or TOML file, by its name if not said, of an object. Raises DataError otherwise."""
    kind = kind or ("JSON" if path.suffix.lower() == ".json" else "TOML")
    with naming_damaged(path, f"{kind} file of names and values", "correct it or write it anew"):
        text = read_text(path)
        # Braces, since they raise TypeError for a list or a number.
        return {**(tomllib.loads(text) if kind == "TOML" else json.loads(text))}


def read_text(path: Path) -> str:
    """The text of a file, decoded by its byte-order mark, else as UTF-8, whatever its bytes are."""
    with path.open("rb") as file:
        start = file.read(4)
    of_mark = (encoding for mark, encoding in _ENCODINGS.items() if start.startswith(mark))
    return path.read_text(encoding=next(of_mark, "utf-8-sig"), errors="replace")


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are neither blank nor comments. DataError if there is none."""
    lines = read_text(path).splitlines()
    full = [line for line in lines if line.partition("#")[0].strip()]
    if not full:
        raise DataError(f"{path} is empty: write it anew")
    return full


def read_numbers(path: Path, columns: tuple[int, ...], meaning: str) -> Float[np.ndarray, "n m"]:
    """A table of numbers, separated by blanks or commas; NaN, however it is spelled, and infinity
    are kept.

    Raises DataError for anything else, or if the number of columns is none of `columns`. The
    message says what every line should hold: the `meaning`.
    """
    # First: some spellings hold a `#`, which else begins a comment.
    lines = [_NOT_A_NUMBER.sub("nan", line) for line in read_lines(path)]
    if path.suffix == ".log":  # Open3D's, with a head of three numbers before each matrix
        lines = [line for line in lines if len(line.split()) != 3]
    with naming_damaged(path, "table", f"every line holds {meaning}"):
        if any(_DECIMAL_COMMA.search(line) for line in lines):
            raise ValueError("write decimal points, not commas")
        numbers = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
        if numbers.shape[1] not in columns:
            raise ValueError(f"there are {numbers.shape[1]} columns")
    return numbers
