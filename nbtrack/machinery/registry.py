"""Registries of fields, trackers, methods and formats by name, and the plug-ins that add to them.

A plug-in is a package that adds entries when it is imported: `nbtrack.beyond`, and every installed
package with an entry point of the group `nbtrack`. A user's own file adds entries too: `import_own`
imports it, for the option `--import` of every command.
"""

import importlib
import pkgutil
import shlex
import sys
import traceback
from collections import UserDict
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from nbtrack.machinery.errors import ConfigError, MissingError
from nbtrack.machinery.files import resolved
from nbtrack.machinery.progress import tell

Entry = TypeVar("Entry")
# Plug-ins that are still to be imported. The package's own one is loaded in the same way.
_waiting = [EntryPoint("beyond", "nbtrack.beyond", "nbtrack"), *entry_points(group="nbtrack")]
IMPORTED: list[str] = []
"""Files and modules that `import_own` has imported; a run's command for its repetition names them.
"""


class Registry(UserDict[str, Entry]):
    """A dictionary of entries by name, with the entries of plug-ins.

    The first use of any registry imports all plug-ins. An entry may be given as a text
    "module:Name", as entry points have it; it is then loaded when it is first asked for.
    """

    def __init__(self, entries: dict[str, Entry | str]) -> None:
        self.data = entries

    @property
    def data(self) -> dict[str, Entry | str]:
        """The dictionary that all methods of `UserDict` use, after all plug-ins added to it.

        It is kept under the same name in `__dict__`, where `UserDict` looks for it in a copy.
        """
        while _waiting:
            # Taken from the list before it is loaded: it uses registries, which come here again.
            plugin = _waiting.pop(0)
            try:
                plugin.load()
            # A fault of another package must not stop the program.
            except (Exception, SystemExit) as error:
                why = f"({type(error).__name__}: {error}): mend or remove it"
                tell(f"nbtrack: warning: plug-in {plugin.value} is left out {why}")
        return self.__dict__["data"]

    @data.setter
    def data(self, entries: dict[str, Entry | str]) -> None:
        self.__dict__["data"] = entries

    def __getitem__(self, name: str) -> Entry:
        """The entry of a name.

        Raises ConfigError if the entry is a text "module:Name" that cannot be loaded, and KeyError,
        as every mapping, for an unknown name.
        """
        entry = self.data[name]
        if isinstance(entry, str):
            try:
                entry = pkgutil.resolve_name(entry)
            except (ImportError, AttributeError, ValueError) as error:
                found = f"{name!r} cannot be loaded from {entry} ({error})"
                raise ConfigError(f"{found}: install it, or remove this entry") from error
            self[name] = entry
        return entry


def command_line(*words: str) -> str:
    """A command to copy, which imports the same files of the user's as this one."""
    return shlex.join(["python", "-m", "nbtrack", *words, *(f"--import={s}" for s in IMPORTED)])


def from_extra(package: str, extra: str = "") -> ModuleType:
    """An optional package, of an extra of nbtrack. Raises MissingError if it cannot be imported."""
    try:
        return importlib.import_module(package)
    except Exception as error:  # a package that is broken may raise any
        wanted = f"'nbtrack[{extra}]'" if extra else package
        raise MissingError(f"{error}: pip install {wanted}") from error


def import_own(source: str) -> None:
    """Import a user's Python file, or a module by its name, that adds fields, trackers or methods.

    `source` is a file if it ends in `.py`. The folder of a file is added to the search path for
    modules. Raises MissingError if there is no such file, and ConfigError if the import fails, or
    if another module of the file's name was imported instead.
    """
    file = resolved(source)
    is_file = file.suffix == ".py"
    name = file.stem if is_file else source
    if is_file and not file.is_file():
        raise MissingError(f"no file {source} to import: give a Python file, or a module's name")
    if is_file:
        sys.path.insert(0, str(file.parent))
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a script for the shell ends itself
        place = traceback.extract_tb(error.__traceback__)[-1]
        # An error in Python's import system, as for a missing module, has no line to mend.
        is_in_python = place.filename.startswith("<frozen")
        where = "" if is_in_python else f" at {place.filename}, line {place.lineno}"
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"importing {source} failed{where} ({reason}): mend it") from error
    if is_file and Path(module.__file__ or "") != file:
        raise ConfigError(f"module {name} is {module}, not {source}: mend the path, or rename it")
    IMPORTED.append(str(file) if is_file else source)
