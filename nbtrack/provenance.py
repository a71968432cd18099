"""The provenance of results: code and versions, on which keys of the cache depend."""

import importlib.metadata
import importlib.util
import platform
import secrets
import site
import sys
import sysconfig
from functools import cache

import torch

import nbtrack
from nbtrack.machinery.files import PACKAGE, fingerprint
from nbtrack.machinery.progress import tell

# Folders whose code computes results.
_FOLDERS = (
    "beyond", "core", "data", "experiments", "fields", "machinery", "mapping", "recordings",
    "tracking",
)  # fmt: skip
_PACKAGES = ("numpy", "scipy", "numba", "small_gicp")  # that compute results beside torch
# Folders into which packages are installed.
_SITE = (*site.getsitepackages(), site.getusersitepackages(), sysconfig.get_path("platlib"))


@cache
def package_code(*folders: str) -> str:
    """Twelve hexadecimal digits that change with the Python files in folders of this package."""
    files = sorted(file for folder in folders for file in (PACKAGE / folder).rglob("*.py"))
    return fingerprint({str(file.relative_to(PACKAGE)): file.read_text("utf-8") for file in files})


def code_fingerprint(kind: type) -> str:
    """Twelve hexadecimal digits for the code of a field or tracker class and of this package.

    They change with the files in `_FOLDERS`, and with the version of the installed package that
    the class is from. For a class from elsewhere, as a user's file, a notebook or an editable
    installation, they change with its qualified name and its attribute `version`, but not with its
    code. Without a `version` the digits differ from process to process, so that no process uses
    results of another one, and a printed line says so.
    """
    return fingerprint(package_code(*_FOLDERS), _code_of(kind))


@cache
def _code_of(kind: type) -> list[str]:
    """Texts that stand for the code of a class outside of this package.

    They are the installed distributions of the class and of its bases, as names with versions. A
    class that is from no distribution, and not from this package, adds its name and version.
    """
    distributions = sorted({name for base in kind.__mro__ for name in _installed(base.__module__)})
    if kind.__module__.startswith("nbtrack.") or _installed(kind.__module__):
        return distributions
    name, version = f"{kind.__module__}.{kind.__qualname__}", vars(kind).get("version")
    if version is None:
        version = secrets.token_hex(6)  # stays for this class in this process, by `cache`
        advice = f'give {kind.__name__} version = "1", and another text whenever its code changes'
        tell(f"nbtrack: maps and runs with {name} are not kept for another process: {advice}")
    return [*distributions, name, str(version)]


@cache
def _installed(module: str) -> list[str]:
    """Names with versions of the distributions that installed a module.

    The list is empty for a module that was not installed, and for those of nbtrack and torch, whose
    versions `versions` tells.
    """
    top = module.partition(".")[0]
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    if top in ("nbtrack", "torch") or not file.startswith(_SITE):
        return []
    names = importlib.metadata.packages_distributions().get(top, [])
    return [f"{name} {importlib.metadata.version(name)}" for name in names]


def versions() -> dict[str, str]:
    """Versions by name of nbtrack, Python and the packages that compute results."""
    found = {"nbtrack": nbtrack.__version__, "python": platform.python_version()}
    found["torch"] = str(torch.__version__)
    installed = [name for name in _PACKAGES if importlib.util.find_spec(name)]
    return found | {name: importlib.metadata.version(name) for name in installed}
