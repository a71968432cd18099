"""Registries of what is known by name, and who adds to them.

Packages add when they are imported: `nbtrack.beyond`, and installed ones that have an entry point
of the group `nbtrack`. A user's own file does so by `import_own`, which `--import` of every command
calls.
"""

import importlib
import pkgutil
import sys
import traceback
from collections import UserDict
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar

from nbtrack.machinery.errors import ConfigError, MissingError
from nbtrack.machinery.files import resolved
from nbtrack.machinery.progress import tell

Entry = TypeVar("Entry")
# Plug-ins that are still to be imported; ours joins as any other does.
_waiting = [EntryPoint("beyond", "nbtrack.beyond", "nbtrack"), *entry_points(group="nbtrack")]
IMPORTED: list[str] = []
"""What `import_own` has imported, for the command that makes a run again."""


class Registry(UserDict[str, Entry]):
    """Entries by name, those of plug-ins included, which are imported when it is first used.

    An entry may be a text "module:Name", as of entry points: it is loaded when it is asked for.
    """

    def __init__(self, entries: dict[str, Entry | str]) -> None:
        self._entries = entries

    @property
    def data(self) -> dict[str, Entry | str]:
        """What `UserDict` works on: the entries as given, once all plug-ins have added theirs."""
        while _waiting:
            plugin = _waiting.pop(0)  # before it is loaded: it uses registries itself
            try:
                plugin.load()
            except Exception as error:  # of another package; the other plug-ins still work
                why = f"({type(error).__name__}: {error}): mend or remove it"
                tell(f"nbtrack: warning: plug-in {plugin.value} is left out {why}")
        return self._entries

    @data.setter
    def data(self, entries: dict[str, Entry | str]) -> None:
        self._entries = entries

    def __copy__(self) -> "Registry":
        return Registry({**self.data})

    def __getitem__(self, name: str) -> Entry:
        """The entry of a name. Raises ConfigError where its text names nothing that is there.

        That the name is not known is a KeyError, as in every mapping.
        """
        entry = self.data[name]
        if isinstance(entry, str):
            try:
                entry = pkgutil.resolve_name(entry)
            except (ImportError, AttributeError, ValueError) as error:
                raise ConfigError(f"{name!r} cannot be loaded from {entry} ({error})") from error
            self[name] = entry
        return entry


def import_own(source: str) -> None:
    """Import a user's file, or a module by its name, that adds fields, trackers or methods.

    The file's folder is searched for modules from then on. Raises MissingError where there is no
    such file, and ConfigError for whatever the import raises, and where another module has the
    file's name.
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
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        # Python's own import system, as for a module that is not there: no place to mend.
        is_in_python = place.filename.startswith("<frozen")
        where = "" if is_in_python else f" at {place.filename}, line {place.lineno}"
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"importing {source} failed{where} ({reason}): mend it") from error
    if is_file and Path(module.__file__ or "") != file:
        raise ConfigError(f"module {name} is {module}, not {source}: mend the path, or rename it")
    IMPORTED.append(str(file) if is_file else source)
