"""Presets: everything that a run depends on, apart from the data and the seed.

Precedence, in every command: class defaults < preset < method < TOML file (`NBTRACK_CONFIG` or
`--config`) < `NBTRACK_SET` < `--set key=value`.
"""

import os
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.fields import FIELDS, LearnedField, NetworkSettings, field_class
from nbtrack.machinery.errors import ConfigError, MissingError, check_lists, look_up
from nbtrack.machinery.files import absolute
from nbtrack.machinery.inputs import read_object
from nbtrack.machinery.settings import flat, limited, one_of, with_settings, with_values
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.synthetic.make import MOTIONS
from nbtrack.tables import PAPER_PIXELS
from nbtrack.tracking import TRACKERS, TrackerSettings

Values = tuple[tuple[str, Any], ...]  # dotted keys and values
Classes = tuple[tuple[str, type], ...]  # names and what is registered by them


@dataclass(frozen=True)
class ScenesConfig:
    """Which sequences a preset maps and tracks, and how synthetic rooms are made."""

    names: tuple[str, ...] = ()  # synthetic rooms, or folders below the data folder
    motion: str = one_of(*MOTIONS)  # in a synthetic room: by default as the dataset's
    n_frames: int = limited(300, 2, 10_000)
    width: int = limited(640, 11, 4096)  # pixels; the height is three quarters of it
    track_frames: str = ":"  # the Python slice of frames that is tracked
    seed: int = limited(0, 0, 2**31 - 1)
    labels: tuple[str, ...] = ()  # NAME=LABEL, as LaTeX tables name a scene


SIZES = ("motion", "n_frames", "width", "seed")
"""What tells a synthetic room's recording from others of it."""


@dataclass(frozen=True)
class TablesConfig:
    """What the two tables ask of the cells."""

    rates_hz: tuple[float, ...] = limited((10.0, 5.0, 2.0), 0.01, 100.0)  # paper, Table I
    budgets_ms: tuple[float, ...] = limited((50.0, 100.0, 500.0), 0.1, 1e5)  # paper, Table II
    # By tracker the n (pixels) of Table II (paper); trackers not named here take those of "sdf".
    pixels: dict[str, tuple[int, ...]] = field(
        default_factory=lambda: {"vr": (128, 512, 1024), "sdf": (2048, 4096, 16384)}
    )


# A density gains from finer detail; a distance must start smooth, or ripples satisfy the
# eikonal term.
# Fields without a `Network` class of their own, as NeuS+, have the network of NeuS.
_NETWORKS = {
    "imap": NetworkSettings(embedding_sigma=4.0),
    "neus": NetworkSettings(),
    "occupancy": NetworkSettings(embedding_sigma=4.0),
}
# What a preset changes in these holds for all fields or trackers that it does not name.
_MODELS = {"network": "neus", "mapping": "neus", "tracking": "sdf"}


@dataclass(frozen=True)
class Preset:
    """Everything that a run depends on, apart from the data and the seed.

    It holds what a method and the user change in the preset of this name, as sorted pairs of a
    dotted key and a value. All of that is checked.
    """

    name: str
    of_method: Values = ()  # by the method that is run
    chosen: Values = ()  # by the user, over the preset and the method

    @property
    def settings(self) -> dict[str, Any]:
        """The whole tree, made once; and once more where a field or tracker is registered later."""
        return _merged(self, tuple(FIELDS.items()), tuple(TRACKERS.items()))

    def with_values(self, values: Mapping[str, Any]) -> "Preset":
        """The preset with a user's values, by dotted keys. Raises ConfigError for wrong ones."""
        tree = PRESETS[self.name].settings
        for key in values:
            part, *names = key.split(".")
            known = tree.get(part)
            if names and isinstance(known, dict):
                # First the field or tracker: of whole keys the nearest may belong to another one.
                look_up(f"config key, {part} of", names[0], known)
        checked = flat(with_values(tree, values))
        chosen = dict(self.chosen) | {key: checked[key] for key in values}
        return replace(self, chosen=tuple(sorted(chosen.items())))

    def with_method(self, settings: Sequence[str]) -> "Preset":
        """The preset with the `key=value` texts of a method, over which a user's values win."""
        of_method = dict(self.of_method) | dict(with_settings(PRESETS[self.name], *settings).chosen)
        return replace(self, of_method=tuple(sorted(of_method.items())))

    @property
    def scenes(self) -> ScenesConfig:
        """Which sequences are mapped and tracked."""
        return self.settings["scenes"]

    @property
    def tables(self) -> TablesConfig:
        """What the tables ask."""
        return self.settings["tables"]

    @property
    def correction(self) -> dict[str, float]:
        """Cells (m) in which maps are corrected, by field; 0: they are not."""
        return self.settings["correction"]

    def network_of(self, field_name: str) -> Any:
        """Settings of a field's network, by default those of NeuS; None if it learns nothing."""
        networks = self.settings["network"]
        is_learned = issubclass(field_class(field_name), LearnedField)
        return networks.get(field_name, networks["neus"]) if is_learned else None

    def mapping_of(self, field_name: str) -> Any:
        """Mapping settings of a field."""
        return look_up("field", field_name, self.settings["mapping"])

    def tracking_of(self, tracker_name: str) -> TrackerSettings:
        """Settings of a tracker."""
        return look_up("tracker", tracker_name, self.settings["tracking"])

    @property
    def step_counts(self) -> str:
        """For captions: with which sizes the paper measured its step counts, and what ours are."""
        paper = " and ".join(f"{n} ({tracker})" for tracker, n in PAPER_PIXELS.items())
        ours = " and ".join(f"{self.tracking_of(t.lower()).n_pixels} ({t})" for t in PAPER_PIXELS)
        width, our_width = NetworkSettings().width, self.network_of("neus").width
        in_paper = f"measured there with n = {paper} and {width} units a layer"
        return f"the paper's step counts, {in_paper}; here n = {ours} and {our_width} units"


_SMALL = flat(read_object(Path(__file__).with_name("smoke.toml")))
# With the iterations of NeuS that the committed results of nine_rooms were made with.
_NINE = {"scenes.track_frames": ":", "mapping.neus.iterations": 1200}
# What presets change in the defaults of the settings classes.
_CHANGES: dict[str, dict[str, Any]] = {
    "smoke": _SMALL,
    "nine_rooms": _SMALL | {"scenes.names": REPORTED_ROOMS} | _NINE,
    "synthetic": {"scenes.names": REPORTED_ROOMS},
    "paper": {"scenes.names": tuple(DATASET_SCENES)},
}
PRESETS = {name: Preset(name) for name in _CHANGES}


def default_settings() -> dict[str, Any]:
    """The tree of the settings classes' own defaults, for all fields and trackers known now."""
    return _defaults(tuple(FIELDS.items()), tuple(TRACKERS.items()))


@lru_cache(maxsize=1)
def _defaults(fields: Classes, trackers: Classes) -> dict[str, Any]:
    """The tree of defaults for some fields and trackers."""
    learned = {name: kind for name, kind in fields if issubclass(kind, LearnedField)}
    networks = {n: k.Network() for n, k in learned.items() if k.Network is not NetworkSettings}
    return {
        "network": _NETWORKS | networks,
        "mapping": {name: kind.Settings() for name, kind in fields},
        # Cells (m) in which the finished map of a distance is corrected; 0: it is not.
        "correction": {name: 0.0 for name, kind in learned.items() if kind.is_distance},
        "tracking": {name: kind.Settings() for name, kind in trackers},
        "scenes": ScenesConfig(),
        "tables": TablesConfig(),
    }


@lru_cache(maxsize=64)
def _merged(preset: Preset, fields: Classes, trackers: Classes) -> dict[str, Any]:
    """The tree of a preset, for some fields and trackers.

    What the preset does not name has the defaults of its class, with what the preset changes in
    NeuS or in SDF tracking. A user's values change only what they name.
    """
    tree, changes = _defaults(fields, trackers), _CHANGES[preset.name]
    of_unnamed = _changes_of_unnamed(changes, tree)
    return with_values(tree, of_unnamed | changes | dict(preset.of_method) | dict(preset.chosen))


def _changes_of_unnamed(changes: dict[str, Any], tree: dict[str, Any]) -> dict[str, Any]:
    """By dotted keys, what a preset changes in fields and trackers that it does not name.

    That is what it changes in NeuS, or for trackers in SDF, where they have such a setting.
    """
    named = {tuple(key.split(".")[:2]) for key in changes}
    values = {}
    for key, value in changes.items():
        part, name, *setting = key.split(".")
        others = tree[part] if name == _MODELS.get(part) else {}
        for other in others:
            if (part, other) not in named and hasattr(others[other], setting[0]):
                values[f"{part}.{other}.{setting[0]}"] = value
    return values


def load_preset(
    name: str | None = None,
    config_file: Path | None = None,
    settings: Sequence[str] = (),
    of_method: Sequence[str] = (),
) -> Preset:
    """A preset, by default that of `NBTRACK_PRESET`, else `smoke`, with all overrides applied.

    Each overrides those before it: the `key=value` texts `of_method`; a TOML file, by default the
    one that `NBTRACK_CONFIG` names; the texts in `NBTRACK_SET`; `settings`. Raises ConfigError for
    an unknown preset or key, or a value of the wrong type; MissingError if the file does not exist,
    DataError if it is no TOML.
    """
    check_lists(settings=settings, of_method=of_method)
    preset = look_up("preset", name or os.environ.get("NBTRACK_PRESET", "smoke"), PRESETS)
    config_file = config_file or os.environ.get("NBTRACK_CONFIG")
    if config_file:
        config_file = absolute(config_file)
        if not config_file.is_file():
            raise MissingError(f"no config file {config_file}: give a TOML file of settings")
        preset = preset.with_values(flat(read_object(config_file)))
    try:
        before = shlex.split(os.environ.get("NBTRACK_SET", ""))
    except ValueError as error:
        raise ConfigError(f"NBTRACK_SET cannot be split ({error}): quote as in a shell") from None
    # The method comes last here, but what the user has chosen wins over it.
    return with_settings(preset, *before, *settings).with_method(of_method)


def claim(preset: Preset, holds: bool, text: str, usual: Sequence[str] = ()) -> None:
    """Print what a notebook claims of its results, or warn that it does not hold.

    The claim was found with `smoke` and the notebook's `usual` texts, `key=value`: with just these
    settings it must hold, and raises AssertionError if not.
    """
    if holds:
        print(text)
    elif flat(preset.settings) != flat(with_settings(PRESETS["smoke"], *usual).settings):
        warnings.warn(f"with these settings it does not hold that {text}", stacklevel=2)
    else:
        raise AssertionError(f"it does not hold that {text}")
