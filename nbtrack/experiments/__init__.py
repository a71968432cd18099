"""Experiments: methods, presets, jobs, and the commands that run them.

Here what goes beyond the paper is registered, and so are installed packages that have an entry
point of the group `nbtrack`: a module that adds to FIELDS, TRACKERS, METHODS or FORMATS when
imported. A user's own file joins in the same way by `import_own`, which `--import` of every command
calls.
"""

import importlib
import sys
import traceback
from importlib.metadata import entry_points
from pathlib import Path

import nbtrack.beyond  # registers its fields and trackers
from nbtrack.machinery.errors import ConfigError, MissingError
from nbtrack.machinery.files import resolved
from nbtrack.machinery.progress import tell

for plugin in entry_points(group="nbtrack"):
    try:
        plugin.load()
    except Exception as error:  # in somebody else's package: without it all others still work
        reason = f"{type(error).__name__}: {error}"
        tell(f"nbtrack: warning: plug-in {plugin.value} is left out ({reason}): mend or remove it")

IMPORTED: list[str] = []
"""What `import_own` has imported, for workers, and for the command that makes a run again."""


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
