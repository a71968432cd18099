"""The folder of results, atomic writes, and locks.

Two processes may use the same folder, and either may be killed. A reader must never see half a
file, so every result is written to a temporary file, which is then moved into place.
"""

import contextlib
import dataclasses
import errno
import hashlib
import io
import json
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

import nbtrack
from nbtrack.machinery.errors import DataError, MissingError, NbtrackError
from nbtrack.machinery.settings import as_dict

CHECKPOINT_SECONDS = 10.0  # between two checkpoints: what a killed run loses at most
PACKAGE = Path(nbtrack.__file__).resolve().parent
# Errors in reading a file that do not come from its content: they are a program's mistakes, or a
# device's, or say already what is wrong. All others count as a damaged file.
_NOT_BY_CONTENT = (
    NbtrackError, MemoryError, torch.OutOfMemoryError, torch.AcceleratorError, NameError,
    AttributeError, AssertionError,
)  # fmt: skip
_NO_LOCKS = errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP  # of file systems without locks


def project_folder() -> Path:
    """The checkout that the package lies in; the current folder where it is installed elsewhere."""
    return PACKAGE.parent if (PACKAGE.parent / "pyproject.toml").is_file() else Path.cwd()


def absolute(path: Path | str) -> Path:
    """An absolute path without `~` and `..`. Raises MissingError for `~` and no user's name.

    Links are not followed: a recording has the name by which it is given, also that of a link.
    """
    expanded = os.path.expanduser(path)
    if expanded.startswith("~"):
        raise MissingError(f"{path}: there is no such user; a folder of this name is ./{path}")
    return Path(os.path.abspath(expanded))


def resolved(path: Path | str) -> Path:
    """An absolute path without links or `~`. A loop of links fails only where it is opened."""
    return Path(os.path.realpath(absolute(path)))


def runs_folder() -> Path:
    """Cache of rooms, maps and trajectories: `NBTRACK_RUNS`, else `runs/` of the project."""
    return resolved(os.environ.get("NBTRACK_RUNS") or project_folder() / "runs")


def data_folder() -> Path:
    """Folder with downloaded scenes: `NBTRACK_DATA`, else `data/` of the project."""
    return resolved(os.environ.get("NBTRACK_DATA") or project_folder() / "data")


def tables_folder() -> Path:
    """The committed evidence: `paper_tables/` of the project. No command writes there by itself."""
    return project_folder() / "paper_tables"


def _number(digits: str) -> float | int:
    """A float where that is exact, so that other whole numbers are not taken for one another."""
    return float(digits) if float(digits) == int(digits) else int(digits)


def fingerprint(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the parts (plain values or configs).

    Numbers count by their value: 30 is 30.0.
    """
    as_given = json.dumps([as_dict(p) if dataclasses.is_dataclass(p) else p for p in parts])
    plain = json.dumps(json.loads(as_given, parse_int=_number), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:12]


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes tensors and plain values as one file, an archive with checksums."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomic(path, buffer.getvalue())


@contextlib.contextmanager
def loaded_checkpoint(path: Path) -> Iterator[dict[str, Any]]:
    """What `save_checkpoint` wrote, on the CPU, for a `with` block that restores from it.

    Raises DataError if the file is damaged. An error of the block becomes a DataError too: then the
    content is not what the block needs.
    """
    with naming_damaged(path):
        with zipfile.ZipFile(path) as archive:  # torch checks no checksums
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is not what was written")
        yield torch.load(path, map_location="cpu", weights_only=True)


def digest_of(plain: Any, tensors: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 over plain values and tensors, whatever the order of names."""
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        content = tensor.detach().cpu().contiguous().numpy().tobytes()
        digest.update(f"{name} {tuple(tensor.shape)}".encode() + content)
    return digest.hexdigest()


class Checkpoint:
    """The file from which a killed run goes on; it is written every few seconds.

    Where there is no path, nothing is written or taken up.
    """

    def __init__(self, path: Path | None, recipe: dict[str, Any]) -> None:
        """`recipe` is what the run depends on; the error for another run's file has its names."""
        self.path = path
        self.recipe = recipe
        self.last_saved = time.perf_counter()

    def save(self, state_of: Callable[[], dict[str, Any]], is_last: bool = False) -> None:
        """Write the state if it is time to, or if it is the last one."""
        is_due = is_last or time.perf_counter() - self.last_saved > CHECKPOINT_SECONDS
        if self.path and is_due:
            save_checkpoint(self.path, {"recipe": self.recipe, **state_of()})
            self.last_saved = time.perf_counter()

    def resume(self, take_up: Callable[[dict[str, Any]], None]) -> None:
        """Hand over the written state, if there is one.

        Raises DataError if it is damaged, or of a run with another recipe.
        """
        if not (self.path and self.path.exists()):
            return
        with loaded_checkpoint(self.path) as state:
            written = state["recipe"]
            if changed := [name for name in self.recipe if written.get(name) != self.recipe[name]]:
                others = ", ".join(changed).replace("_", " ")
                raise DataError(f"{self.path} was made with another {others}: remove it")
            take_up(state)


def write_atomic(path: Path, content: str | bytes) -> None:
    """Replaces the file at `path` by `content` in one move, as `write_together` does.

    Text is UTF-8 with the given line ends on every system.
    """
    write_together(path.parent, {path.name: content})


def write_together(folder: Path, contents: Mapping[str, str | bytes | None]) -> None:
    """Replaces several files of a folder, the last one as the sign that all of them are there.

    A file whose content is None is removed.

    All new files are first written to another folder, so that a full disk leaves the old ones as
    they were. A process that is killed between two moves leaves the folder without the last file.
    Missing folders are made. Raises OSError, which names the last file, where that is not possible.
    """
    last = [*contents][-1]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A new folder of a random name: nobody else writes there, or has put a link in its place.
        with tempfile.TemporaryDirectory(suffix=".tmp", prefix=".", dir=folder) as aside:
            kept = {name: content for name, content in contents.items() if content is not None}
            for name, content in kept.items():
                # Paths whose letters the system's encoding lacks come as surrogates.
                is_text = isinstance(content, str)
                encoded = content.encode(errors="surrogateescape") if is_text else content
                Path(aside, name).write_bytes(encoded)
            if len(contents) > 1:  # the old last file must not stand beside new ones
                (folder / last).unlink(missing_ok=True)
            for name in contents.keys() - kept.keys():
                (folder / name).unlink(missing_ok=True)
            for name in kept:
                os.replace(Path(aside, name), folder / name)
    except OSError as error:  # a write that finds the disk full has no name of its own
        raise OSError(error.errno, error.strerror or str(error), str(folder / last)) from None


def json_text(content: Any) -> str:
    """JSON, indented. Raises ValueError for NaN and infinity, which it cannot say: pass None.

    It is UTF-8 whatever a path is called: bytes that are none are escaped.
    """
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    return text.encode(errors="backslashreplace").decode() + "\n"


@contextlib.contextmanager
def naming_damaged(
    path: Path, kind: str = "checkpoint", advice: str = "remove it and run the same command again"
) -> Iterator[None]:
    """Turn an error in a block that reads a file and uses its content into a DataError in a line.

    The line names the file and what `kind` of file it should be, and ends with the `advice`. Errors
    that say nothing about the file pass: see `_NOT_BY_CONTENT`.
    """
    try:
        yield
    except _NOT_BY_CONTENT:
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise DataError(f"{path} is not a readable {kind} ({reason}): {advice}") from error


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other processes out of a block by a lock file.

    The system frees the lock when this process ends, however it ends. Where the file system knows
    no locks, the block runs without one: two processes may then do the same work, and the files of
    either stay whole.
    """
    # The presence of a file is no lock: a killed process leaves that file behind.
    lock = FileLock(path, fallback_to_soft=False)
    try:
        lock.acquire()
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    try:
        yield
    finally:
        lock.release()
