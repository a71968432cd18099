"""One exception family. A message says what was found, what is allowed and what to do next."""

import difflib
from collections.abc import Mapping, Sequence
from typing import TypeVar

Entry = TypeVar("Entry")


class NbtrackError(Exception):
    """Root of every error that a user can cause; the command line turns it into exit status 2."""


class DataError(NbtrackError, ValueError):
    """A file or folder of a sequence is not as its layout demands."""


class MissingError(NbtrackError, FileNotFoundError):
    """Something that was asked for by name or path does not exist."""


class ConfigError(NbtrackError, ValueError):
    """A setting has an unknown name or a value that is not allowed."""


class NumericalError(NbtrackError, ArithmeticError):
    """A loss or a pose stopped being finite; the message names where that was found."""


class OutOfMemory(NbtrackError, MemoryError):
    """Host or device have too little memory; the message names the setting to lower."""


def look_up(what: str, name: str, known: Mapping[str, Entry]) -> Entry:
    """The entry of a name. Raises ConfigError, naming the nearest, for an unknown one."""
    if not isinstance(name, str) or name not in known:
        raise ConfigError(f"unknown {what} {str(name)[:40]!r}: {nearest_name(str(name), [*known])}")
    return known[name]


def check_lists(at_least: int = 0, **arguments: object) -> None:
    """Raises ConfigError for an argument that is no list of at least so many entries.

    A text, a single thing or a dictionary is none, nor what can be gone through only once.
    """
    for name, value in arguments.items():
        is_list = hasattr(value, "__getitem__") and hasattr(value, "__len__")
        if isinstance(value, str | bytes | Mapping) or not is_list:
            raise ConfigError(f"{name} = {value!r:.80} is no list: write {name}=[...] around it")
        if len(value) < at_least:
            raise ConfigError(f"{name} = {value!r:.80}: give at least {at_least}")


def look_up_kind(what: str, name: str, known: Mapping[str, type], needed: Sequence[str]) -> type:
    """The class that is known by a name, checked.

    Raises ConfigError for an unknown name, for a class whose own `name` is another, and for one
    that lacks a `needed` attribute or an abstract method.
    """
    kind = look_up(what, name, known)
    lacks = [word for word in needed if not hasattr(kind, word)]
    lacks += sorted(getattr(kind, "__abstractmethods__", ()))
    if lacks:
        raise ConfigError(f"{what} {name!r} lacks {', '.join(lacks)}: give them to {kind.__name__}")
    own = getattr(kind, "name", None)
    if own != name:
        raise ConfigError(f"{what} {name!r} calls itself {own!r}: give the class this name")
    return kind


def nearest_name(text: str, allowed: list[str]) -> str:
    """A hint for a misspelt name: the nearest one, then all that are allowed, or of many a few.

    >>> nearest_name("imapp", ["imap", "neus"])
    "did you mean 'imap'? Allowed: imap, neus"
    """
    small = {name.lower(): name for name in allowed}  # SDF is near sdf
    near = difflib.get_close_matches(text.lower(), small, n=5, cutoff=0.5)
    close = [small[name] for name in near]
    hint = f"did you mean '{close[0]}'? " if close else ""
    if len(allowed) > 40:  # a message lists no more
        return f"{hint}Allowed are {len(allowed)} names, such as {', '.join(close or allowed[:5])}"
    return f"{hint}Allowed: {', '.join(allowed)}"
