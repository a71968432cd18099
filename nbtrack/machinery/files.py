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
from nbtrack.machinery.errors import ConfigError, DataError, MissingError, NbtrackError
from nbtrack.machinery.settings import as_dict

CHECKPOINT_SECONDS = 10.0  # between two checkpoints: about what a killed run loses
PACKAGE = Path(nbtrack.__file__).resolve().parent
# An error of one of these types, raised while a file is read, does not mean that the file is
# damaged: it is a mistake in the program, a failure of memory or device, or an NbtrackError, whose
# message says already what is wrong. Errors of all other types mean that the file is damaged.
_NOT_BY_CONTENT = (
    NbtrackError, MemoryError, torch.OutOfMemoryError, torch.AcceleratorError, NameError,
    AttributeError, AssertionError,
)  # fmt: skip
_NO_LOCKS = errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP  # of file systems without locks


def project_folder() -> Path:
    """The checkout of nbtrack; the current folder if the package is installed without one."""
    return PACKAGE.parent if (PACKAGE.parent / "pyproject.toml").is_file() else Path.cwd()


def absolute(path: Path | str) -> Path:
    """An absolute path without `~` and `..`.

    Links are not followed, so that a recording that is given by a link has the name of the link.
    Raises MissingError for `~` with a name that no user has. Raises ConfigError for an argument of
    another type, and for an empty text, which would mean the working folder.
    """
    if not isinstance(path, Path | str) or path == "":
        raise ConfigError(f"{path!r:.80} is no path: give one, or . for the working folder")
    expanded = os.path.expanduser(path)
    if expanded.startswith("~"):  # Python leaves the `~` of an unknown user as it is
        raise MissingError(f"{path}: there is no such user; a folder of this name is ./{path}")
    return Path(os.path.abspath(expanded))


def resolved(path: Path | str) -> Path:
    """An absolute path without links or `~`.

    Links that lead in a circle raise no error here, but when the path is opened.
    """
    return Path(os.path.realpath(absolute(path)))


def runs_folder() -> Path:
    """The cache of rooms, maps and trajectories: `NBTRACK_RUNS`, else `runs/` of the project."""
    return resolved(os.environ.get("NBTRACK_RUNS") or project_folder() / "runs")


def data_folder() -> Path:
    """The folder with downloaded scenes: `NBTRACK_DATA`, else `data/` of the project."""
    return resolved(os.environ.get("NBTRACK_DATA") or project_folder() / "data")


def tables_folder() -> Path:
    """The folder of the committed results, `paper_tables/`; commands write there only if told."""
    return project_folder() / "paper_tables"


def _as_float(digits: str) -> float | int:
    """A whole number of a JSON text as a float, so that 30 and 30.0 get one fingerprint.

    If a float would round the number, it stays an int: two numbers must not become the same one.
    """
    return float(digits) if float(digits) == int(digits) else int(digits)


def fingerprint(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the parts (plain values or configs).

    Equal numbers of different types, as 30 and 30.0, give the same digits.
    """
    as_given = json.dumps([as_dict(p) if dataclasses.is_dataclass(p) else p for p in parts])
    plain = json.dumps(json.loads(as_given, parse_int=_as_float), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:12]


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes tensors and plain values as one file, an archive with checksums."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomic(path, buffer.getvalue())


def digest_of(plain: Any, tensors: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 (hexadecimal) over plain values and named tensors, whatever the order of names."""
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        content = tensor.detach().cpu().contiguous().numpy().tobytes()
        digest.update(f"{name} {tuple(tensor.shape)}".encode() + content)
    return digest.hexdigest()


class Checkpoint:
    """The file from which a killed run goes on; it is written about every `CHECKPOINT_SECONDS`.

    With the path None nothing is written, and every run begins anew.
    """

    def __init__(self, path: Path | str | None, recipe: dict[str, Any]) -> None:
        """Take the path of the file, and a `recipe`, which holds by name what the run depends on.

        The recipe is stored in the file. `resume` compares the file's recipe with this one, and
        names in its error what differs.
        """
        self.path = None if path is None else absolute(path)
        self.recipe = recipe
        self.last_saved = time.perf_counter()

    def save(self, state_of: Callable[[], dict[str, Any]], is_last: bool = False) -> None:
        """Write the state that `state_of` returns if a write is due, or if it is the last state."""
        is_due = is_last or time.perf_counter() - self.last_saved > CHECKPOINT_SECONDS
        if self.path and is_due:
            save_checkpoint(self.path, {"recipe": self.recipe, **state_of()})
            self.last_saved = time.perf_counter()

    def resume(self, take_up: Callable[[dict[str, Any]], None]) -> None:
        """Call `take_up` with the written state, if there is one; its tensors are on the CPU.

        Raises DataError if the file is damaged, or if a run with another recipe wrote it. An error
        in `take_up` becomes a DataError too: the file does not hold what is restored from it.
        """
        if not (self.path and self.path.exists()):
            return
        with naming_damaged(self.path):
            with zipfile.ZipFile(self.path) as archive:
                damaged = archive.testzip()  # compares the checksums, which `torch.load` does not
            if damaged:
                raise ValueError(f"{damaged} is not what was written")
            state = torch.load(self.path, map_location="cpu", weights_only=True)
            written = state["recipe"]
            others = [name for name in self.recipe if written.get(name) != self.recipe[name]]
            if others:
                words = ", ".join(others).replace("_", " ")
                raise DataError(f"{self.path} was made with another {words}: remove it")
            take_up(state)


def write_atomic(path: Path, content: str | bytes) -> None:
    """Replaces the file at `path` by `content` in one move, so that no reader sees half of it.

    Text is written as UTF-8, and its line ends stay as they are on every system. Folders are made,
    and errors are raised, as by `write_together`.
    """
    write_together(path.parent, {path.name: content})


def write_together(folder: Path, contents: Mapping[str, str | bytes | None]) -> None:
    """Replaces several files of a folder; the last file is the sign that all of them are there.

    `contents` maps each file's name to its new content; with None the file is removed. Missing
    folders are made.

    All new files are first written to a temporary folder, so that a full disk leaves the old ones
    as they were, and are then moved. A process that is killed between two moves leaves the folder
    without the last file. Raises OSError, which names the last file, if a file cannot be written.
    """
    last = [*contents][-1]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The folder's name is random, so nobody else writes there or has put a link in its place.
        with tempfile.TemporaryDirectory(suffix=".tmp", prefix=".", dir=folder) as temporary:
            written = {name: content for name, content in contents.items() if content is not None}
            for name, content in written.items():
                # A text may hold a path; bytes of a path that are no UTF-8 come as surrogates.
                is_text = isinstance(content, str)
                encoded = content.encode(errors="surrogateescape") if is_text else content
                Path(temporary, name).write_bytes(encoded)
            if len(contents) > 1:  # the old last file must not stand beside new ones
                (folder / last).unlink(missing_ok=True)
            for name in contents.keys() - written.keys():
                (folder / name).unlink(missing_ok=True)
            for name in written:
                os.replace(Path(temporary, name), folder / name)
    except OSError as error:  # the error of a full disk names no file
        raise OSError(error.errno, error.strerror or str(error), str(folder / last)) from None


def json_text(content: Any) -> str:
    """Indented JSON. Raises ValueError for NaN and infinity, which JSON lacks: pass None instead.

    The text can be encoded as UTF-8 even if a path in it holds bytes that are no UTF-8: Python
    keeps such bytes as surrogates, and they are escaped here.
    """
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    return text.encode(errors="backslashreplace").decode() + "\n"


@contextlib.contextmanager
def naming_damaged(
    path: Path, kind: str = "checkpoint", advice: str = "remove it and run the same command again"
) -> Iterator[None]:
    """Turn an error in a block that reads a file and uses its content into a DataError.

    Its message is one line. It names the file and what `kind` of file that should be, and ends with
    the `advice`. Errors of the types in `_NOT_BY_CONTENT`, which say nothing about the file, are
    raised unchanged.
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
    """Run a block while this process holds the lock on a file; wait first until it is free.

    The system frees the lock when this process ends, however it ends. On a file system without
    locks the block runs without one. Two processes may then do the same work twice; their files
    stay whole, since each is written in one move.
    """
    # A soft lock would be the mere presence of the file, which a killed process leaves behind.
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
