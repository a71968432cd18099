"""Settings: trees of frozen dataclasses and dictionaries of them, changed by checked `key=value`.

Keys are dotted paths such as `mapping.neus.iterations`; an unknown one is an error. Counts are 1 to
a million, other numbers 0 to a million, unless their field says otherwise: what is beyond any use
would overflow, fill the memory or never end. No list is empty.
"""

import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from nbtrack.machinery.errors import ConfigError, look_up

Config = TypeVar("Config")
MANY = 1_000_000
_DEEPEST = 10  # dots of a key, more than any has: what lies deeper is not taken apart
_USUAL_LIMITS = {int: (1, MANY), float: (0.0, MANY)}


def limited(default: float | tuple, minimum: float, maximum: float) -> Any:
    """A dataclass field with a number, or some, that a user may set within limits."""
    return dataclasses.field(default=default, metadata={"limits": (minimum, maximum)})


def one_of(*choices: str) -> Any:
    """A dataclass field with one of some words, by default the first."""
    return dataclasses.field(default=choices[0], metadata={"choices": choices})


def as_dict(config: Any) -> dict[str, Any]:
    """A config as nested dictionaries of plain values, ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def with_settings(preset: Any, *settings: str) -> Any:
    """A preset, or anything with its method `with_values`, after some `key=value` texts in order.

    Raises ConfigError as `with_values` and `read_setting` do.
    """
    for setting in settings:
        preset = preset.with_values(read_setting(setting))
    return preset


def read_setting(setting: str) -> dict[str, Any]:
    """The value of a `key=value` text, or the values where it is a table, by dotted keys.

    Raises ConfigError for a text that is none.
    """
    key, equals, text = [part.strip() for part in setting.partition("=")]
    if not equals:
        raise ConfigError(f"setting {setting!r} has no value: write key=value")
    try:
        parsed = tomllib.loads(f"value = {text}")
    # Nesting thousands deep ends the parser's recursion, as do thousands of digits.
    except (ValueError, RecursionError):
        if text.startswith(("[", "{", '"', "'")):
            raise ConfigError(f"{text!r:.40} is no TOML: write \"{key}=['a', 'b']\"") from None
        parsed = {"value": text}  # a bare word is a string
    if len(parsed) > 1:
        raise ConfigError(f"setting {setting!r} holds more than one: give each by itself")
    return flat({key: parsed["value"]})


def checked(config: Config, kind: type) -> Config:
    """Settings of a kind whose values all are of their defaults' types and within their limits.

    Raises ConfigError for any other. Numbers of numpy become Python's.
    """
    if not isinstance(config, kind):
        raise ConfigError(f"settings are {config!r:.60}: give {kind.__name__}(...), or a child's")
    return with_values(type(config)(), flat(config))


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The dataclass, or tree of them, with some values of dotted keys, or trees as TOML has them.

    Raises ConfigError for an unknown key, or a value of the wrong type or range.
    """
    valid = flat(config)
    for key, value in flat(dict(values)).items():
        look_up("config key", key, valid)
        config = _replaced(config, key.split("."), key, value, {})
    return config


def changed_settings(config: Config, original: Config) -> list[str]:
    """The `key=value` texts that turn the original into this config."""
    before = flat(original)
    return [f"{k}={json.dumps(v)}" for k, v in flat(config).items() if before.get(k) != v]


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a config, or of a tree as TOML gives it, by their dotted keys.

    `prefix` is the dotted key of the config itself, where it is a part of another.
    """
    if dataclasses.is_dataclass(config):
        config = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    if not isinstance(config, dict) or prefix.count(".") > _DEEPEST:
        return {prefix: config}
    parts = (flat(part, f"{prefix}.{name}".lstrip(".")) for name, part in config.items())
    return {key: value for part in parts for key, value in part.items()}


def _replaced(node: Any, path: list[str], key: str, value: Any, allowed: Mapping) -> Any:
    """A part of a tree with the value of one key, which lies at a path of names below that part.

    Nested parts are rebuilt, never changed in place. `allowed` is the metadata of the part's field.
    """
    if not path:
        return _converted(key, node, value, allowed)
    name, *rest = path
    if isinstance(node, dict):
        return {**node, name: _replaced(node[name], rest, key, value, {})}
    of_field = next(f.metadata for f in dataclasses.fields(node) if f.name == name)
    new = _replaced(getattr(node, name), rest, key, value, of_field)
    return dataclasses.replace(node, **{name: new})


def _converted(key: str, old: Any, value: Any, allowed: Mapping) -> Any:
    """A value in the type of the old one; ConfigError for another type, or one not allowed.

    `allowed` is the metadata of its field: limits or choices, if any. A single value becomes a
    tuple of one, and a whole number a float, where the old value is one. Nothing else is converted.
    """
    wanted = type(old)
    value = value.item() if isinstance(value, np.generic) else value
    if wanted is tuple and isinstance(value, list | tuple | str | int | float):
        values = value if isinstance(value, list | tuple) else [value]
        if not values:
            raise ConfigError(f"{key} = []: give at least one, for example {list(old)}")
        # An empty tuple does not say of which type its entries are.
        return tuple(_converted(key, old[0], part, allowed) if old else part for part in values)
    # An integer of TOML that is too large for a float, or to be printed, becomes infinity, which
    # the checks below refuse.
    if type(value) is int and (wanted is float or abs(value) > 1e300):
        value = float(value) if abs(value) < 1e300 else math.inf
    if type(value) is not wanted or (wanted is str and "\0" in value):
        raise ConfigError(f"{key} = {value!r}: it must be {wanted.__name__}, for example {old!r}")
    limits = allowed.get("limits", _USUAL_LIMITS.get(wanted))
    if limits and not limits[0] <= value <= limits[1]:
        raise ConfigError(f"{key} = {value!r}: it must be {limits[0]:g} to {limits[1]:g}")
    if value not in allowed.get("choices", [value]):
        raise ConfigError(f"{key} = {value!r}: write {' or '.join(map(repr, allowed['choices']))}")
    return value
