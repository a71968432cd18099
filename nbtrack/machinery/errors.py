"""One exception family. A message says what was found, what is allowed and what to do next."""

import difflib
import functools
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin

Entry = TypeVar("Entry")
_NUMBERS = {int: Integral, float: Real}  # numpy's numbers are of these kinds, too


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


def typed(checked: Callable) -> Callable:
    """Decorate a public function, method or dataclass: it then refuses arguments of another kind.

    Its annotations say which kind each argument is: see `check_argument`.
    """
    if isinstance(checked, type):
        checked.__init__ = typed(checked.__init__)
        return checked
    signature = inspect.signature(checked)

    @functools.wraps(checked)
    def call(*arguments: Any, **named: Any) -> Any:
        for name, value in signature.bind(*arguments, **named).arguments.items():
            check_argument(name, value, signature.parameters[name].annotation)
        return checked(*arguments, **named)

    return call


def check_argument(name: str, value: Any, kind: Any) -> None:
    """Raises ConfigError, which calls the argument `name`, unless a value is of the annotated kind.

    Checked are classes of this package, tables, texts, numbers, functions, and lists of these.
    Tuples and arrays are lists, but texts, dictionaries, sets and iterators are not. Paths, arrays
    and poses may have several forms, so they are checked where they are converted.
    """
    if not _is_of(value, kind):
        found = " ".join(f"{value!r:.80}".split())
        wanted = re.sub(r"[\w.]+\.", "", inspect.formatannotation(kind))  # without modules
        raise ConfigError(f"{name} is {found}: give {wanted}")


def _is_of(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated kind; True for kinds that `check_argument` leaves out."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return any(_is_of(value, part) for part in parts)
    if origin is Callable:
        return callable(value)
    if origin in (Sequence, tuple):
        entries = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(entries, Sequence) or isinstance(entries, str | bytes):
            return False
        # `tuple[int, int]` has two entries; `tuple[int, ...]` and `Sequence[int]` have any number.
        has_length = origin is tuple and ... not in parts
        fits = not has_length or len(entries) == len(parts)
        return fits and all(_is_of(entry, parts[0]) for entry in entries)  # parts are of one kind
    is_checked = kind in _NUMBERS or kind in (str, dict, NoneType)
    is_checked |= kind.__module__.partition(".")[0] in ("nbtrack", "pandas")
    return not is_checked or isinstance(value, _NUMBERS.get(kind, kind))


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
