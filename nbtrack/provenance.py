"""The provenance of results: what keys of the cache are made of besides settings and data."""

import ast
import contextlib
import importlib.metadata
import importlib.util
import platform
import site
import sys
import sysconfig
from functools import cache
from pathlib import Path

import torch

import nbtrack
from nbtrack.machinery.files import PACKAGE, fingerprint

# Folders whose code computes results.
_FOLDERS = (
    "beyond", "core", "data", "experiments", "fields", "machinery", "mapping", "recordings",
    "tracking",
)  # fmt: skip
_PACKAGES = ("numpy", "scipy", "numba", "small_gicp")  # that compute results beside torch
_LIBRARIES = ("nbtrack", "torch", "abc", "typing", "builtins")  # what own classes are built on
_LIBRARY_FOLDERS = map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib"))
_INSTALLED = (*_LIBRARY_FOLDERS, *site.getsitepackages(), site.getusersitepackages())


@cache
def package_code(*folders: str) -> str:
    """Twelve hexadecimal digits that change with the files of some folders of this package."""
    files = sorted(file for folder in folders for file in (PACKAGE / folder).rglob("*.py"))
    return fingerprint({str(file.relative_to(PACKAGE)): file.read_text("utf-8") for file in files})


def code_fingerprint(*kinds: type) -> str:
    """Twelve hexadecimal digits that change with the code that maps and tracks with some classes.

    That is this package's. Where a class or a base class was written elsewhere, it is also what
    `own_code` finds: the code that this process has loaded from there, and a user's own files.
    """
    packages = {base.__module__.partition(".")[0] for kind in kinds for base in kind.__mro__}
    own = packages.difference(_LIBRARIES)
    return fingerprint(package_code(*_FOLDERS), own_code(own) if own else {})


def own_code(packages: set[str]) -> dict[str, str]:
    """By name, the text of each loaded module that belongs to one of `packages` or is a user's own.

    A user's own are those that are not installed, and not nbtrack's, which `package_code` covers:
    helpers that a user's file imports count as the file does. Of a notebook, which has no file,
    those statements of the executed cells count that define a class, a function or a constant.
    """
    texts = {}
    for name, module in [*sys.modules.items()]:
        file = getattr(module, "__file__", None) or ""
        top = name.partition(".")[0]
        is_library = top == "nbtrack" or file.startswith(_INSTALLED)
        if (top in packages or not is_library) and file.endswith(".py") and Path(file).is_file():
            texts[name] = Path(file).read_text("utf-8")
    for cell in getattr(sys.modules["__main__"], "In", []):  # IPython's list of executed cells
        with contextlib.suppress(SyntaxError):  # of a cell that ended with an error
            for statement in ast.parse(cell).body:
                texts |= _definition(statement)
    return texts


def _definition(statement: ast.stmt) -> dict[str, str]:
    """The text of a statement that defines a class, a function or a constant, by its name.

    A constant is what is assigned a value in which no other name occurs. Other statements give
    nothing.
    """
    if isinstance(statement, ast.ClassDef | ast.FunctionDef):
        return {statement.name: ast.unparse(statement)}
    is_constant = isinstance(statement, ast.Assign) and not any(
        isinstance(node, ast.Name) for node in ast.walk(statement.value)
    )
    return {ast.unparse(statement.targets[0]): ast.unparse(statement)} if is_constant else {}


def versions() -> dict[str, str]:
    """Versions that a result depends on, to be kept beside it and in its key."""
    there = [name for name in _PACKAGES if importlib.util.find_spec(name)]
    of_packages = {name: importlib.metadata.version(name) for name in there}
    own = {"nbtrack": nbtrack.__version__, "python": platform.python_version()}
    return {**own, "torch": str(torch.__version__), **of_packages}
