"""One exception family. A message says what was found, what is allowed and what to do next."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

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
    """The entry of `known` that has this name.

    Raises ConfigError, which suggests the nearest name, for an unknown one. `what` says in the
    message what kind of name it is.
    """
    if not isinstance(name, str) or name not in known:
        raise ConfigError(f"unknown {what} {str(name)[:40]!r}: {nearest_name(str(name), [*known])}")
    return known[name]


def check_lists(at_least: int = 0, **arguments: object) -> None:
    """Raises ConfigError for an argument that is no list of at least `at_least` entries.

    Tuples and arrays are lists here. Texts, dictionaries, single objects and iterators are not.
    The keyword of each argument is its name in the message.
    """
    for name, value in arguments.items():
        is_list = hasattr(value, "__getitem__") and hasattr(value, "__len__")
        if isinstance(value, str | bytes | Mapping) or not is_list:
            raise ConfigError(f"{name} = {value!r:.80} is no list: write {name}=[...] around it")
        if len(value) < at_least:
            raise ConfigError(f"{name} = {value!r:.80}: give at least {at_least}")


def check_kind(kind: Any, **arguments: object) -> None:
    """Raises ConfigError for an argument that is not of the class `kind`.

    `kind` may be a union of classes. The keyword of each argument is its name in the message.
    """
    for name, value in arguments.items():
        if not isinstance(value, kind):
            wanted = getattr(kind, "__name__", kind)
            raise ConfigError(f"{name} is {value!r:.60}: give what is of class {wanted}")


def look_up_kind(what: str, name: str, known: Mapping[str, type], needed: Sequence[str]) -> type:
    """The class that is registered in `known` by a name, after a check that it can be used.

    Raises ConfigError for an unknown name; for a class that lacks an attribute in `needed`, or
    leaves a method abstract; and for a class whose attribute `name` differs from the given name.
    """
    kind = look_up(what, name, known)
    lacks = [attribute for attribute in needed if not hasattr(kind, attribute)]
    lacks += sorted(getattr(kind, "__abstractmethods__", ()))
    if lacks:
        raise ConfigError(f"{what} {name!r} lacks {', '.join(lacks)}: give them to {kind.__name__}")
    class_name = getattr(kind, "name", None)
    if class_name != name:
        raise ConfigError(f"{what} {name!r} calls itself {class_name!r}: give the class this name")
    return kind


def nearest_name(text: str, allowed: list[str]) -> str:
    """A hint for a misspelt name: the nearest allowed name, then all allowed names.

    Of more than 40 allowed names it lists the nearest ones, or a few if none is near.

    >>> nearest_name("imapp", ["imap", "neus"])
    "did you mean 'imap'? Allowed: imap, neus"
    """
    # Compared in lower case, so that `SDF` is near `sdf`.
    allowed_of = {name.lower(): name for name in allowed}
    matches = difflib.get_close_matches(text.lower(), allowed_of, n=5, cutoff=0.5)
    close = [allowed_of[match] for match in matches]
    hint = f"did you mean '{close[0]}'? " if close else ""
    if len(allowed) > 40:
        return f"{hint}Allowed are {len(allowed)} names, such as {', '.join(close or allowed[:5])}"
    return f"{hint}Allowed: {', '.join(allowed)}"
