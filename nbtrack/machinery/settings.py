"""Settings: trees of frozen dataclasses and dictionaries, changed by checked `key=value` texts.

A key is a dotted path such as `mapping.neus.iterations`; an unknown key is an error. Whole numbers
must lie between 1 and a million, other numbers between 0 and a million, unless the dataclass field
has limits of its own: useless sizes would overflow, fill the memory or never end. No list can be
set to an empty one.
"""

import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from nbtrack.machinery.errors import ConfigError, check_argument, look_up

Config = TypeVar("Config")
MANY = 1_000_000
_DEEPEST = 10  # dots in a key, more than any key has; `flat` takes nothing apart below this depth
_USUAL_LIMITS = {int: (1, MANY), float: (0.0, MANY)}


def limited(default: float | tuple, minimum: float, maximum: float) -> Any:
    """A dataclass field for a number, or a tuple of numbers, from `minimum` to `maximum`."""
    return dataclasses.field(default=default, metadata={"limits": (minimum, maximum)})


def one_of(*choices: str) -> Any:
    """A dataclass field for one of the words in `choices`, by default the first."""
    return dataclasses.field(default=choices[0], metadata={"choices": choices})


def as_dict(config: Any) -> dict[str, Any]:
    """A config as nested dictionaries of plain values, ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def with_settings(preset: Any, *settings: str) -> Any:
    """The preset, changed by `key=value` texts, of which a later one wins over an earlier one.

    The preset may be any object with a method `with_values`. Raises ConfigError for a text that is
    no `key=value`, an unknown key, or a value of the wrong type or range.
    """
    values = {}
    for setting in settings:
        values |= read_setting(setting)
    return preset.with_values(values)


def read_setting(setting: str) -> dict[str, Any]:
    """The values that a text `key=value` sets, by dotted keys.

    The value is TOML. A table in it sets several keys, and a bare word is a string. Raises
    ConfigError for a text without `=`, for a list, table or quoted string that is not TOML, and for
    more than one setting in the text, or none.
    """
    key, equals, text = [part.strip() for part in setting.partition("=")]
    if not equals:
        raise ConfigError(f"setting {setting!r:.80} has no value: write key=value")
    try:
        parsed = tomllib.loads(f"value = {text}")
    # RecursionError: lists that are nested thousands deep.
    except (ValueError, RecursionError):
        if text.startswith(("[", "{", '"', "'")):
            raise ConfigError(f"{text!r:.40} is no TOML: write \"{key}=['a', 'b']\"") from None
        parsed = {"value": text}  # a bare word is a string
    values = flat({key: parsed["value"]})
    # After line ends TOML may set other names, and an empty table sets none.
    if len(parsed) > 1 or not values:
        raise ConfigError(f"setting {setting!r:.80} holds more than one, or none: give each alone")
    return values


def checked(config: Config, kind: type) -> Config:
    """Settings that a program passes as an object, after a check of every value.

    Raises ConfigError if they are no object of the class `kind` or of a subclass, or if a value has
    another type than its default or lies beyond its limits. Numbers of numpy become Python's.
    """
    check_argument("settings", config, kind)
    return with_values(type(config)(), flat(config))


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """The config, a dataclass or a tree of them, with other values for some keys.

    `values` has dotted keys, or is a tree of dictionaries, as a TOML file gives it. Raises
    ConfigError for an unknown key, or a value of the wrong type or range.
    """
    valid = flat(config)
    for key, value in flat(dict(values)).items():
        look_up("config key", key, valid)
        config = _replaced(config, key.split("."), key, value, {})
    return config


def changed_settings(config: Config, original: Config) -> list[str]:
    """The `key=value` texts that turn the config `original` into `config`."""
    before = flat(original)
    return [f"{k}={json.dumps(v)}" for k, v in flat(config).items() if before.get(k) != v]


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a config, or of a tree of dictionaries, by dotted keys.

    A recursive call passes as `prefix` the dotted key of the part that it flattens.
    """
    if dataclasses.is_dataclass(config):
        config = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    if not isinstance(config, dict) or prefix.count(".") > _DEEPEST:
        return {prefix: config}
    parts = (flat(part, f"{prefix}.{name}".lstrip(".")) for name, part in config.items())
    return {key: value for part in parts for key, value in part.items()}


def _replaced(node: Any, path: list[str], key: str, value: Any, allowed: Mapping) -> Any:
    """A copy of a part of a config in which one value is replaced.

    Args:
        node: the part: a dataclass, a dictionary, or the old value itself.
        path: the names that lead from the part to the value; empty for the value itself.
        key: the whole dotted key, for messages.
        value: the new value, which is checked by `_converted`.
        allowed: metadata of the dataclass field that holds the part; empty without one.
    """
    if not path:
        return _converted(key, node, value, allowed)
    name, *rest = path
    if isinstance(node, dict):
        return {**node, name: _replaced(node[name], rest, key, value, {})}
    metadata = {field.name: field.metadata for field in dataclasses.fields(node)}[name]
    new = _replaced(getattr(node, name), rest, key, value, metadata)
    return dataclasses.replace(node, **{name: new})


def _converted(key: str, old: Any, value: Any, allowed: Mapping) -> Any:
    """The new value of a key, in the type of its old value.

    A list or a single value becomes a tuple if the old value is one, a whole number a float if the
    old value is one, and a number of numpy one of Python. Nothing else is converted. `allowed` is
    the metadata of the dataclass field, which may hold "limits" or "choices". Raises ConfigError
    for another type, and for a value that is not allowed.
    """
    wanted = type(old)
    value = value.item() if isinstance(value, np.generic) else value
    if wanted is tuple and isinstance(value, list | tuple | str | int | float):
        values = value if isinstance(value, list | tuple) else [value]
        if not values:
            raise ConfigError(f"{key} = []: give at least one, for example {list(old)}")
        # Entries have the type of the old first one. An empty tuple tells no type.
        return tuple(_converted(key, old[0], part, allowed) if old else part for part in values)
    # A whole number may be too large to become a float, or to be printed in a message. It becomes
    # infinity here, which the checks below refuse.
    if type(value) is int and (wanted is float or abs(value) > 1e300):
        value = float(value) if abs(value) < 1e300 else math.inf
    found = f"{key} = {value!r:.80}"
    if type(value) is not wanted or (wanted is str and "\0" in value):
        raise ConfigError(f"{found}: it must be {wanted.__name__}, for example {old!r}")
    limits = allowed.get("limits", _USUAL_LIMITS.get(wanted))
    if limits and not limits[0] <= value <= limits[1]:
        raise ConfigError(f"{found}: it must be {limits[0]:g} to {limits[1]:g}")
    if value not in allowed.get("choices", [value]):
        raise ConfigError(f"{found}: write {' or '.join(map(repr, allowed['choices']))}")
    return value
