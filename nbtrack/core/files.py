"""The folder of results, atomic writes, and the provenance of results.

Two processes may use the same folder, and either may be killed. A reader must never see half a
file, so every result is written to a temporary file, which is then moved into place.
"""

import ast
import contextlib
import dataclasses
import dis
import errno
import hashlib
import importlib.metadata
import importlib.util
import inspect
import io
import json
import os
import platform
import re
import tempfile
import textwrap
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import torch
from filelock import FileLock

import nbtrack
from nbtrack.core.errors import DataError, NbtrackError
from nbtrack.core.progress import tell
from nbtrack.core.settings import as_dict

PACKAGE = Path(nbtrack.__file__).resolve().parent
_WITHOUT_EFFECT = {
    "core.device", "core.errors", "core.files", "core.progress", "core.settings",
    "mapping.files",
}  # fmt: skip
"""Modules that change no digit of a result."""
# Content of a file makes readers raise anything else: these are a program's mistakes, or speak of
# a device, or say already what is wrong.
_NOT_BY_CONTENT = (
    NbtrackError, MemoryError, torch.OutOfMemoryError, torch.AcceleratorError, NameError,
    AttributeError, AssertionError,
)  # fmt: skip
_NO_LOCKS = errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP  # what their lack is called
_PACKAGES = ("numpy", "scipy", "numba", "small_gicp")  # that compute results beside torch
_LIBRARIES = ("nbtrack", "torch", "abc", "typing", "builtins")  # what own classes are built on


def project_folder() -> Path:
    """The checkout that the package lies in; the current folder where it is installed elsewhere."""
    is_checkout = (PACKAGE.parent / "pyproject.toml").is_file()
    return PACKAGE.parent if is_checkout else Path.cwd()


def resolved(path: Path | str) -> Path:
    """An absolute path without links. Where these form a loop, whoever opens it is told."""
    return Path(os.path.realpath(path))


def runs_folder() -> Path:
    """Cache of rooms, maps and trajectories: `NBTRACK_RUNS`, else `runs/` of the project."""
    return resolved(os.environ.get("NBTRACK_RUNS") or project_folder() / "runs")


def data_folder() -> Path:
    """Folder with downloaded scenes: `NBTRACK_DATA`, else `data/` of the project."""
    return resolved(os.environ.get("NBTRACK_DATA") or project_folder() / "data")


def tables_folder() -> Path:
    """The committed evidence: `paper_tables/` of the project. No command writes there by itself."""
    return project_folder() / "paper_tables"


def fingerprint(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the parts (plain values or configs).

    Numbers count by their value: 30 is 30.0.
    """
    plain = json.dumps([as_dict(p) if dataclasses.is_dataclass(p) else p for p in parts])
    plain = json.dumps(json.loads(plain, parse_int=float), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:12]


@cache
def sources_fingerprint(*modules: str) -> str:
    """Twelve hexadecimal digits that change with the code of modules and of all they import.

    Modules are named within the package, as "mapping.fit". A cached result must not outlive the
    code that made it, and must not be lost to code that it does not go through. So the lists in an
    `__init__` do not count, nor do modules that read settings, write files or word messages, nor
    comments, docstrings and layout.
    """
    modules_read = {}
    waiting = [*modules]
    while waiting:
        name = waiting.pop()
        path = PACKAGE / f"{name.replace('.', '/')}.py"
        if name in modules_read or name in _WITHOUT_EFFECT or not path.is_file():
            continue
        tree = ast.parse(path.read_text("utf-8"))
        modules_read[name] = _code(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nbtrack."):
                module = node.module.removeprefix("nbtrack.")
                waiting += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    return fingerprint(modules_read)


def code_fingerprint(*parts: type | str | Callable) -> str:
    """Twelve hexadecimal digits that change with the code of classes, modules and functions.

    Classes count with their base classes, whether they stand in this package or outside; modules of
    the package with all that they import; functions alone, which serves those that choose among
    classes: a cached result does not depend on those that were not chosen.
    """
    functions = [part for part in parts if isinstance(part, FunctionType)]
    texts = [_code(ast.parse(textwrap.dedent(inspect.getsource(f)))) for f in functions]
    kinds = [part for part in parts if isinstance(part, type)]
    names = [part for part in parts if isinstance(part, str)]
    names += [base.__module__ for kind in kinds for base in kind.__mro__]
    own = (name.removeprefix("nbtrack.") for name in names if name.startswith("nbtrack."))
    return fingerprint(sources_fingerprint(*own), *map(foreign_source, kinds), *texts)


def foreign_source(kind: type) -> str:
    """What makes up a class that somebody wrote outside this package, in a file or a notebook.

    Taken is what Python compiled, since worker processes have it as well, without comments and
    docstrings: the methods, those of its own base classes too, and the constants, functions and
    classes of the same module or notebook that they name.
    """
    own = [c for c in kind.__mro__ if c.__module__.partition(".")[0] not in _LIBRARIES]
    return "\n".join(str(_compiled(c, c.__module__, {}, [])) for c in own)


def _compiled(thing: Any, home: str, names: dict[str, Any], seen: list[int]) -> Any:
    """What a thing of a home module is made of, as plain text; the same in every process."""
    if not isinstance(thing, FunctionType):  # of a property, or of what was cached or compiled
        thing = getattr(thing, "fget", None) or getattr(thing, "__wrapped__", thing)
    if isinstance(thing, CodeType):
        steps = [(step.opname, step.argval) for step in dis.get_instructions(thing)]
        thing = [*steps, [names.get(name) for kind, name in steps if kind == "LOAD_GLOBAL"]]
    elif getattr(thing, "__module__", None) == home and id(thing) not in seen:
        seen.append(id(thing))
        if isinstance(thing, type):
            thing = {n: v for n, v in vars(thing).items() if callable(v) or n[:2] != "__"}
        elif isinstance(thing, FunctionType):
            names = thing.__globals__
            cells = thing.__closure__ or ()
            thing = [thing.__code__, thing.__defaults__, thing.__kwdefaults__]
            thing += [cell.cell_contents for cell in cells]
    if isinstance(thing, dict | set | frozenset):  # whose order changes from process to process
        thing = sorted(thing.items() if isinstance(thing, dict) else thing, key=repr)
    if isinstance(thing, list | tuple):
        return [_compiled(part, home, names, seen) for part in thing]
    return re.sub(r" at 0x\w+| from '.*'", "", repr(thing))  # without addresses


def _code(tree: ast.Module) -> str:
    """Python source without comments, docstrings and layout."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)


def versions() -> dict[str, str]:
    """Versions that a result depends on, to be kept beside it and in its key."""
    there = [name for name in _PACKAGES if importlib.util.find_spec(name)]
    of_packages = {name: importlib.metadata.version(name) for name in there}
    own = {"nbtrack": nbtrack.__version__, "python": platform.python_version()}
    return {**own, "torch": str(torch.__version__), **of_packages}


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes tensors and plain values as one file, an archive with checksums."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomic(path, buffer.getvalue())


@contextlib.contextmanager
def loaded_checkpoint(path: Path) -> Iterator[dict[str, Any]]:
    """What `save_checkpoint` wrote, on the CPU. Raises DataError, also for what is made of it
    within the block, if the file is damaged or of another kind."""
    with naming_damaged(path):
        with zipfile.ZipFile(path) as archive:  # torch checks no checksums
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is not what was written")
        yield torch.load(path, map_location="cpu", weights_only=True)


def write_atomic(path: Path, content: str | bytes) -> None:
    """Replaces the file at `path` by `content` in one move, as `write_together` does.

    Text is UTF-8 with the given line ends on every system.
    """
    write_together(path.parent, {path.name: content})


def write_together(folder: Path, contents: Mapping[str, str | bytes]) -> None:
    """Replaces several files of a folder, the last one as the sign that all of them are there.

    All are written aside before the first is moved, so that a disk that fills up leaves the
    earlier ones as they were. Whoever is killed between two moves leaves a folder without the last.
    Missing folders are made. Raises OSError, which names the last file, where that is not possible.
    """
    *_, last = contents
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A new folder of a random name: nobody else writes there, or has put a link in its place.
        with tempfile.TemporaryDirectory(".tmp", ".", folder) as aside:
            for name, content in contents.items():
                # Paths whose letters the system's encoding lacks come as surrogates.
                is_text = isinstance(content, str)
                encoded = content.encode(errors="surrogateescape") if is_text else content
                Path(aside, name).write_bytes(encoded)
            if len(contents) > 1:
                (folder / last).unlink(missing_ok=True)
            for name in contents:
                os.replace(Path(aside, name), folder / name)
    except OSError as error:  # a write that finds the disk full has no name of its own
        raise OSError(error.errno, error.strerror or str(error), str(folder / last)) from None


@contextlib.contextmanager
def locked(path: Path, timeout: float = -1) -> Iterator[bool]:
    """Keep other processes out of a block by a lock file, and tell whether that was possible.

    The system frees the lock when this process ends, however it ends. Where the file system knows
    none, that is said once. Raises filelock's Timeout where others keep it for `timeout` s; less
    than 0 waits as long as they do.
    """
    lock = FileLock(path, timeout=timeout)
    try:
        # It warns before it takes another kind, which would wait for files that locks have left.
        with warnings.catch_warnings(action="error"):
            lock.acquire()
    except (OSError, UserWarning) as error:
        if getattr(error, "errno", errno.ENOSYS) not in _NO_LOCKS:
            raise
        _tell_of_no_locks()
    try:
        yield lock.is_locked
    finally:
        lock.release()


@cache
def _tell_of_no_locks() -> None:
    tell("nbtrack: warning: no locks on this file system: run one command at a time in a folder")


def json_text(content: Any) -> str:
    """JSON, indented. Raises ValueError for NaN and infinity, which it cannot say: pass None."""
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def read_json(path: Path) -> dict[str, Any]:
    """An object from a JSON file of a finished result. Raises DataError if it is none."""
    with naming_damaged(path, "JSON object"):
        return {**json.loads(path.read_text(encoding="utf-8", errors="surrogateescape"))}


@contextlib.contextmanager
def naming_damaged(
    path: Path, kind: str = "checkpoint", advice: str = "remove it and run the same command again"
) -> Iterator[None]:
    """Turn what goes wrong in reading a file and taking up its content into a DataError in a line.

    Mistakes of a program, as a name that is not there, pass, and so does a device that fails, which
    says nothing about the file.
    """
    try:
        yield
    except _NOT_BY_CONTENT:
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise DataError(f"{path} is not a readable {kind} ({reason}): {advice}") from error
