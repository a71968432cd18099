"""Text files of numbers: read strictly, and named with the line where they are wrong."""

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbtrack.core.errors import DataError, MissingError


def is_file(path: Path) -> bool:
    """Whether a file is there; False, not an exception, for names that no file can have."""
    return os.path.isfile(path)


def read_text(path: Path, needed: str) -> str:
    """A text file; a byte-order mark and any line ends are allowed.

    Args:
        needed: which layout needs the file, or what for; told when it is missing.

    Raises:
        MissingError: there is no such file.
    """
    if not is_file(path):
        raise MissingError(
            f"no file {path}: {needed} needs it; add it, or name another format with --format"
        )
    return path.read_text(encoding="utf-8-sig", errors="replace")


def read_lines(path: Path, needed: str) -> list[tuple[int, str]]:
    """Line numbers (from 1) and lines, without blank ones and those that start with `#`."""
    lines = enumerate(read_text(path, needed).splitlines(), start=1)
    return [(n, line) for n, line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_numbers(
    path: Path, columns: tuple[int, ...], meaning: str, needed: str
) -> Float[np.ndarray, "rows columns"]:
    """A table of numbers separated by blanks or commas; NaN and infinity are kept.

    Args:
        columns: how many numbers a line may hold; all lines hold the same.
        meaning: of a line, told when one is wrong.
        needed: as `read_text` takes it.

    Raises:
        MissingError: there is no such file.
        DataError: it is empty, or a line holds another number of columns or no numbers.
    """
    lines = read_lines(path, needed)
    if not lines:
        raise DataError(f"{path} is empty: every line holds {meaning}; write it anew")
    rows: list[list[float]] = []
    for number, line in lines:
        try:
            row = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            row = []
        if len(row) not in (columns if not rows else (len(rows[0]),)):
            raise DataError(
                f"{path} line {number} is {line[:60]!r}: every line holds {meaning}; correct it"
            )
        rows.append(row)
    return np.array(rows, dtype=np.float64)


def read_json(path: Path, needed: str) -> dict[str, Any]:
    """A JSON file that holds an object. Raises MissingError or DataError otherwise."""
    try:
        content = json.loads(read_text(path, needed))
    # Nesting thousands deep ends the parser's recursion.
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no JSON ({error}): correct it or write it anew") from None
    if not isinstance(content, dict):
        raise DataError(
            f"{path} holds a {type(content).__name__}: it must be an object, as in "
            '{"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5}'
        )
    return content


def read_toml(path: Path, needed: str) -> dict[str, Any]:
    """A TOML file. Raises MissingError or DataError otherwise."""
    try:
        return tomllib.loads(read_text(path, needed))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is no TOML ({error}): correct it or write it anew") from None
