"""The provenance of results: what keys of the cache are made of besides settings and data."""

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
_COVERED = {"nbtrack", "torch", *sys.stdlib_module_names}  # by `package_code` and `versions`
_SITE = (*site.getsitepackages(), site.getusersitepackages(), sysconfig.get_path("platlib"))


@cache
def package_code(*folders: str) -> str:
    """Twelve hexadecimal digits that change with the files of some folders of this package."""
    files = sorted(file for folder in folders for file in (PACKAGE / folder).rglob("*.py"))
    return fingerprint({str(file.relative_to(PACKAGE)): file.read_text("utf-8") for file in files})


def code_fingerprint(kind: type) -> str:
    """Twelve hexadecimal digits that change with the code of a field or tracker, and this package.

    Of an installed package the version counts. Of a class from elsewhere, as a user's file, a
    notebook or an editable installation, its qualified name and its own `version` count, and
    nothing else; without a `version` the class itself does: nothing of it is kept for another
    process, and a line says so.
    """
    return fingerprint(package_code(*_FOLDERS), _code_of(kind))


@cache
def _code_of(kind: type) -> list[str]:
    """What keys hold of a class besides the code of this package.

    These are the installed distributions of the class and its bases, as names with versions. A
    class of no distribution adds its own name and version.
    """
    installed = {base.__module__: _installed(base.__module__) for base in kind.__mro__}
    distributions = sorted({name for names in installed.values() for name in names})
    if installed[kind.__module__] or kind.__module__.startswith("nbtrack."):
        return distributions
    name, version = f"{kind.__module__}.{kind.__qualname__}", vars(kind).get("version")
    if version is None:
        version = secrets.token_hex(6)  # for this class object in this process
        advice = f'give {kind.__name__} version = "1", and another text whenever its code changes'
        tell(f"nbtrack: maps and runs with {name} are not kept for another process: {advice}")
    return [*distributions, name, str(version)]


@cache
def _installed(module: str) -> list[str]:
    """Name and version of the distributions that a module was installed by; none for others."""
    top = module.partition(".")[0]
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    if top in _COVERED or not file.startswith(_SITE):
        return []
    names = importlib.metadata.packages_distributions().get(top, [])
    return [f"{name} {importlib.metadata.version(name)}" for name in names]


def versions() -> dict[str, str]:
    """Versions that a result depends on, to be kept beside it and in its key."""
    installed = [name for name in _PACKAGES if importlib.util.find_spec(name)]
    of_packages = {name: importlib.metadata.version(name) for name in installed}
    own = {"nbtrack": nbtrack.__version__, "python": platform.python_version()}
    return {**own, "torch": str(torch.__version__), **of_packages}
