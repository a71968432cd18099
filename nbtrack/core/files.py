"""Files that are either complete or absent: every result is written aside, then moved into place.

Two processes may work on the same results folder and either may be killed; a reader must never
meet half a file.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from nbtrack.core.errors import DataError, NbtrackError


def write_bytes_atomic(path: Path, content: bytes) -> None:
    """Replaces the file at `path` by `content` in one move; missing parent folders are made.

    Raises:
        OSError: the folder cannot be made or written; an existing file is then left as it was.
    """
    path = Path(path)
    aside = _aside(path)
    with _naming_file(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            aside.write_bytes(content)
            os.replace(aside, path)
        finally:
            _remove(aside)


def write_together(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Replaces several files of a folder, the last one as the sign that all of them are there.

    All are written aside before the first is moved, so that a disk that fills up leaves the
    earlier ones as they were. Whoever is killed between two moves leaves a folder without the last.

    Raises:
        OSError: the folder cannot be made or written.
    """
    folder = Path(folder)
    asides = {name: _aside(folder / name) for name in contents}
    with _naming_file(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            for name, content in contents.items():
                asides[name].write_bytes(content)
            (folder / list(contents)[-1]).unlink(missing_ok=True)
            for name, aside in asides.items():
                os.replace(aside, folder / name)
        finally:
            for aside in asides.values():
                _remove(aside)


def _aside(path: Path) -> Path:
    # The process id keeps two writers of one path from moving each other's half-written file.
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):  # what went wrong before is what the user must hear
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def _naming_file(path: Path) -> Iterator[None]:
    """Give errors the name of the result: a write that finds the disk full has none of its own."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


_AGAIN = "remove it and run the same command again"


def read_checkpoint(path: Path, kind: str = "checkpoint", advice: str = _AGAIN) -> dict[str, Any]:
    """What `torch.save` wrote: tensors and plain values only, on the CPU; no code is run.

    Args:
        kind, advice: what the file should be and what to do if it is not, for the message.

    Raises:
        DataError: the file is damaged or something else.
    """
    # Bytes of any other kind make the reader stumble in many ways; an interruption is none of them.
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise _damaged(path, kind, type(error).__name__, advice) from None
    if not isinstance(content, dict):
        raise _damaged(path, kind, f"holds a {type(content).__name__}", advice)
    return content


@contextlib.contextmanager
def naming_damaged(path: Path, kind: str = "checkpoint", advice: str = _AGAIN) -> Iterator[None]:
    """Turn what goes wrong in taking up a checkpoint's content into one line that names the file.

    Raises:
        DataError: the block met a part that is missing, or of another kind or shape.
    """
    try:
        yield
    except (LookupError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        if isinstance(error, NbtrackError):
            raise
        raise _damaged(path, kind, f"{type(error).__name__}: {error}", advice) from None


def _damaged(path: Path, kind: str, reason: str, advice: str) -> DataError:
    reason = " ".join(reason.split())[:120]
    return DataError(f"{path} is not a readable {kind} ({reason}): {advice}")


def read_json(path: Path) -> dict[str, Any]:
    """An object from a JSON file of a finished result.

    Raises:
        DataError: the file is not one.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{path} is not readable JSON ({error}): {_AGAIN}") from None
    if not isinstance(content, dict):
        raise DataError(f"{path} holds no object: {_AGAIN}")
    return content


def write_text_atomic(path: Path, text: str) -> None:
    """As `write_bytes_atomic`, for text: UTF-8 with the given line ends on every system."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_json_atomic(path: Path, content: Any) -> None:
    """As `write_bytes_atomic`, for JSON: indented, keys in the given order, newline at the end.

    Raises:
        ValueError: a number is NaN or infinite, for which JSON has no word; pass None instead.
    """
    write_bytes_atomic(path, json_bytes(content))


def json_bytes(content: Any) -> bytes:
    """JSON as `write_json_atomic` writes it."""
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    return (text + "\n").encode("utf-8")
