"""Files that are either complete or absent: every result is written aside, then moved into place.

Two processes may work on the same results folder and either may be killed; a reader must never
meet half a file.
"""

import json
import os
import pickle
from pathlib import Path
from typing import Any

import torch

from nbtrack.errors import DataError


def write_bytes_atomic(path: Path, content: bytes) -> None:
    """Replaces the file at `path` by `content` in one move; missing parent folders are made.

    Raises:
        OSError: the folder cannot be made or written; an existing file is then left as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id keeps two writers of one path from moving each other's half-written file.
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        aside.write_bytes(content)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What `torch.save` wrote: tensors and plain values only, on the CPU; no code is run.

    Raises:
        DataError: the file is damaged or something else.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise DataError(
            f"{path} is not a readable checkpoint ({type(error).__name__}): remove it and run the "
            "same command again"
        ) from None


def write_text_atomic(path: Path, text: str) -> None:
    """As `write_bytes_atomic`, for text: UTF-8 with the given line ends on every system."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_json_atomic(path: Path, content: Any) -> None:
    """As `write_bytes_atomic`, for JSON: indented, keys in the given order, newline at the end.

    Raises:
        ValueError: a number is NaN or infinite, for which JSON has no word; pass None instead.
    """
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    write_text_atomic(path, text + "\n")
