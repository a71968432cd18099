"""The provenance of results: what keys of the cache are made of besides settings and data."""

import ast
import dis
import importlib.metadata
import importlib.util
import inspect
import platform
import re
import textwrap
from collections.abc import Callable
from functools import cache
from types import CodeType, FunctionType
from typing import Any

import torch

import nbtrack
from nbtrack.core.files import PACKAGE, fingerprint

_WITHOUT_EFFECT = {
    "core.device", "core.errors", "core.files", "core.progress", "core.settings",
    "mapping.files", "provenance",
}  # fmt: skip
"""Modules that change no digit of a result."""
_PACKAGES = ("numpy", "scipy", "numba", "small_gicp")  # that compute results beside torch
_LIBRARIES = ("nbtrack", "torch", "abc", "typing", "builtins")  # what own classes are built on


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
