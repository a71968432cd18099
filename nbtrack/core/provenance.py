"""What a result was made by: the versions to record, and the code that its key depends on.

A cached result must not outlive the code that made it: a researcher who changes a tracker expects
the row to change. So keys hold a fingerprint of the syntax of every module that takes part, found
by following imports. Comments, docstrings and layout do not count.
"""

import ast
import dataclasses
import hashlib
import importlib.util
import inspect
import json
import platform
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch

import nbtrack
from nbtrack.core.config import as_dict

# Modules that store, tell or choose. The settings stand in a key with their values, and rooms have
# a version of their own: what was rendered is part of the key as data.
_NO_PART = (
    "nbtrack.core.config", "nbtrack.core.settings", "nbtrack.core.errors", "nbtrack.core.files",
    "nbtrack.core.device",
    "nbtrack.synthetic",
)  # fmt: skip


def fingerprint(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the parts (plain values or configs)."""
    plain = [as_dict(p) if dataclasses.is_dataclass(p) else p for p in parts]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:12]


def code_fingerprint(*entry_points: Callable[..., Any]) -> str:
    """Twelve hexadecimal digits that change with the code behind functions or classes.

    A class that was written in a notebook has no file; its own source stands for it.
    """
    modules, sources = set(), []
    for entry in entry_points:
        if getattr(sys.modules.get(entry.__module__), "__file__", None):
            modules.add(entry.__module__)
        else:
            sources.append(_plain_source(inspect.getsource(entry)))
    return fingerprint(_modules_fingerprint(tuple(sorted(modules))), sorted(sources))


def versions() -> dict[str, str]:
    """Versions that a result depends on, to be kept beside it."""
    return {
        "nbtrack": nbtrack.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


@cache
def _modules_fingerprint(names: tuple[str, ...]) -> str:
    found: dict[str, str] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found or name.startswith(_NO_PART):
            continue
        tree = ast.parse(_file_of(name).read_text(encoding="utf-8"))
        waiting += _imported(tree)
        found[name] = _without_docstrings(tree)
    return fingerprint(sorted(found.items()))


def _file_of(module: str) -> Path:
    spec = importlib.util.find_spec(module)
    return Path(spec.origin)


def _imported(tree: ast.Module) -> list[str]:
    """Modules of this package that a module imports by name."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
    return [name for name in names if name.startswith("nbtrack.")]


def _plain_source(source: str) -> str:
    return _without_docstrings(ast.parse(inspect.cleandoc(source)))


def _without_docstrings(tree: ast.Module) -> str:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        is_documented = isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        )
        if is_documented and ast.get_docstring(node) is not None:
            node.body = body[1:] or [ast.Pass()]
    return ast.unparse(tree)
