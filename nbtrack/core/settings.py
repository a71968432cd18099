"""Checked overrides of a preset: from the command line, the environment and TOML files.

Precedence: preset < TOML file (`NBTRACK_CONFIG` or `--config`) < `NBTRACK_SET` < `--set key=value`.
Keys are dotted paths such as `mapping.neus.iterations`; an unknown one is an error.
"""

import dataclasses
import json
import math
import os
import shlex
import tomllib
from pathlib import Path
from typing import Any

from nbtrack.core.config import PRESETS, Preset, as_dict
from nbtrack.core.errors import ConfigError, MissingError, nearest_name


def resolve_preset(
    name: str | None = None, config_file: Path | None = None, settings: tuple[str, ...] = ()
) -> Preset:
    """The preset with all overrides applied.

    Args:
        name: a preset's name; by default `NBTRACK_PRESET`, else `smoke`.
        config_file: TOML file of overrides; by default the one `NBTRACK_CONFIG` names, if any.
        settings: `key=value` texts, applied last, after those in `NBTRACK_SET`.

    Raises:
        ConfigError: an unknown preset or key, or a value of the wrong type.
        MissingError: the file does not exist.
    """
    name = name or os.environ.get("NBTRACK_PRESET", "smoke")
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}: {nearest_name(name, list(PRESETS))}")
    preset = PRESETS[name]
    file_name = config_file or os.environ.get("NBTRACK_CONFIG")
    if file_name:
        for key, value in _flatten(_read_toml(Path(file_name))).items():
            preset = _replace(preset, key, value)
    return with_settings(preset, *_environment_settings(), *settings)


def with_settings(preset: Preset, *settings: str) -> Preset:
    """The preset with some `key=value` texts applied.

    Raises:
        ConfigError: an unknown key, or a value of the wrong type.
    """
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"setting {setting!r} has no value: write key=value")
        preset = _replace(preset, key.strip(), _parse_value(text.strip()))
    return preset


def changed_settings(preset: Preset) -> list[str]:
    """The `key=value` texts that turn the preset of this name into this one."""
    original = _flatten(as_dict(PRESETS[preset.name]))
    return [
        f"{key}={json.dumps(value)}"
        for key, value in _flatten(as_dict(preset)).items()
        if original.get(key) != value
    ]


def _environment_settings() -> list[str]:
    text = os.environ.get("NBTRACK_SET", "")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(
            f"NBTRACK_SET={text!r} cannot be split ({error}): quote each setting as in a shell"
        ) from None


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise MissingError(f"no config file {path}: give a TOML file of settings")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is no TOML: {error}; write lines like 'width = 128'") from None


def _parse_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        pass
    if text.startswith(("[", "{", '"', "'")):
        raise ConfigError(
            f"value {text!r} is no TOML: write ['a', 'b'] or [1, 2], and quote the whole "
            "setting, so that the shell leaves the inner quotes"
        )
    return text  # a bare word is a string


def _flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        path = f"{prefix}{key}"
        flat |= _flatten(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat


def _replace(preset: Preset, key: str, value: Any) -> Preset:
    """The preset with one dotted key set. Nested parts are rebuilt, never changed in place."""
    valid = [k for k in _flatten(as_dict(preset)) if k != "name"]
    if key not in valid:
        raise ConfigError(f"unknown config key {key!r}: {nearest_name(key, valid)}")
    return _replaced(preset, key.split("."), key, value)


def _replaced(node: Any, path: list[str], key: str, value: Any) -> Any:
    head, *rest = path
    old = node[head] if isinstance(node, dict) else getattr(node, head)
    new = _replaced(old, rest, key, value) if rest else _converted(key, old, value)
    if isinstance(node, dict):
        return {**node, head: new}
    return dataclasses.replace(node, **{head: new})


# Counts are at least one, but for these: no frame is held out, no second pass, the first seed.
_MAY_BE_ZERO = ("holdout_every", "n_surface", "n_importance", "n_restarts", "seed")


def _converted(key: str, old: Any, value: Any) -> Any:
    wanted = type(old)
    if wanted is tuple and isinstance(value, list | str | int | float):
        values = value if isinstance(value, list) else [value]
        return tuple(_converted(key, old[0], v) if old else v for v in values)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not wanted:
        raise ConfigError(
            f"{key} = {value!r} is of type {type(value).__name__}: it must be {wanted.__name__}, "
            f"for example {old!r}"
        )
    least = 1 if wanted is int and key.rpartition(".")[2] not in _MAY_BE_ZERO else 0
    if wanted in (int, float) and not least <= value < math.inf:
        raise ConfigError(f"{key} = {value!r}: it must be {least} or more; the preset has {old!r}")
    return value
