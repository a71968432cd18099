"""Presets: everything that a run depends on, apart from the data and the seed.

Precedence, in every command: class defaults < preset < method < TOML file (`NBTRACK_CONFIG` or
`--config`) < `NBTRACK_SET` < `--set key=value`.
"""

import os
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from nbtrack.core.errors import ConfigError, MissingError, look_up
from nbtrack.core.files import absolute
from nbtrack.core.settings import (
    changed_settings,
    flat,
    limited,
    read_setting,
    with_settings,
    with_values,
)
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.data.text_files import read_object
from nbtrack.fields import FIELDS, LearnedField, NetworkSettings, field_class
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.tables import PAPER_PIXELS
from nbtrack.tracking import TRACKERS, TrackerSettings, tracker_class


@dataclass(frozen=True)
class ScenesConfig:
    """Which sequences a preset maps and tracks, and how synthetic rooms are made."""

    names: tuple[str, ...] = ()  # synthetic rooms, or folders below the data folder
    motion: str = "keyframes"  # in a synthetic room: as the dataset's; or handheld, or a tour
    n_frames: int = limited(300, 2, 10_000)
    width: int = limited(640, 11, 4096)  # pixels; the height is three quarters of it
    track_frames: str = ":"  # the Python slice of frames that is tracked
    seed: int = limited(0, 0, 2**31 - 1)


SIZES = ("motion", "n_frames", "width", "seed")
"""What tells a synthetic room's recording from others of it."""


@dataclass(frozen=True)
class TablesConfig:
    """What the two tables ask of the cells."""

    rates_hz: tuple[float, ...] = limited((10.0, 5.0, 2.0), 0.01, 100.0)  # paper, Table I
    budgets_ms: tuple[float, ...] = limited((50.0, 100.0, 500.0), 0.1, 1e5)  # paper, Table II
    # Pixels n of each tracker in Table II (paper); others take those of the SDF tracker.
    pixels: dict[str, tuple[int, ...]] = field(
        default_factory=lambda: {"vr": (128, 512, 1024), "sdf": (2048, 4096, 16384)}
    )


# A density gains from finer detail; a distance must start smooth, or ripples satisfy the
# eikonal term: at 4 rad/m in place of 2.5 it was off by 19 cm in free space, not by 5.
_NETWORKS = {
    "imap": NetworkSettings(embedding_sigma=4.0),
    "neus": NetworkSettings(),
    "occupancy": NetworkSettings(embedding_sigma=4.0),
}


@dataclass(frozen=True)
class Preset:
    """Everything that a run depends on, apart from the data and the seed."""

    name: str = field(metadata={"is_setting": False})  # no `key=value` reaches it
    # Fields without a `Network` class of their own, as NeuS+, have the network of NeuS.
    network: dict[str, Any] = field(default_factory=_NETWORKS.copy)
    # Of every field and tracker; of those that are not given, the defaults of their classes.
    mapping: dict[str, Any] = field(default_factory=dict)
    # Cells (m) in which the finished map of a field with a distance is corrected; 0: it is not.
    correction: dict[str, float] = field(default_factory=dict)
    tracking: dict[str, TrackerSettings] = field(default_factory=dict)
    scenes: ScenesConfig = ScenesConfig()
    tables: TablesConfig = TablesConfig()
    # Dotted keys of the user's own values, which a method does not change.
    chosen: tuple[str, ...] = field(default=(), metadata={"is_setting": False})
    # Settings of NeuS and of SDF tracking, by part, as the preset has them.
    usual: dict[str, Any] = field(default_factory=dict, metadata={"is_setting": False})

    def __post_init__(self) -> None:
        """Add settings of what is registered and has none.

        They are the defaults of its class, with what the preset changes in those of NeuS or of SDF
        tracking, whenever it is registered. A user's values change only what they name.
        """
        learned = {n: kind for n, kind in FIELDS.items() if issubclass(kind, LearnedField)}
        networks = {n: k.Network for n, k in learned.items() if k.Network is not NetworkSettings}
        self._complete("network", networks, "neus")
        self._complete("mapping", {n: kind.Settings for n, kind in FIELDS.items()}, "neus")
        self._complete("tracking", {n: kind.Settings for n, kind in TRACKERS.items()}, "sdf")
        none = {name: 0.0 for name, kind in learned.items() if kind.is_distance}
        object.__setattr__(self, "correction", none | self.correction)

    def _complete(self, part: str, kinds: dict[str, type], usual: str) -> None:
        known = getattr(self, part)
        other = self.usual.setdefault(part, known.get(usual))
        found = {n: _like(known.get(n, other), kind) for n, kind in kinds.items()}
        object.__setattr__(self, part, known | found)

    @property
    def step_counts(self) -> str:
        """For captions of tables with the paper's step counts: the sizes of the paper and ours."""
        paper = " and ".join(f"{n} ({tracker})" for tracker, n in PAPER_PIXELS.items())
        own = " and ".join(f"{self.tracking_of(t.lower()).n_pixels} ({t})" for t in PAPER_PIXELS)
        width, own_width = NetworkSettings().width, self.network_of("neus").width
        there = f"measured there with n = {paper} and {width} units a layer"
        return f"the paper's step counts, {there}; here n = {own} and {own_width} units"

    def with_method(self, settings: Sequence[str]) -> "Preset":
        """The preset with the `key=value` texts of a method, but for what a user chose."""
        changed = self
        for values in map(read_setting, settings):
            own = {key: value for key, value in values.items() if key not in self.chosen}
            changed = with_values(changed, own)
        return changed

    def network_of(self, field_name: str) -> Any:
        """Network of a field, by default that of NeuS; None of a field that learns nothing."""
        known = replace(self).network  # with those of fields registered since
        is_learned = issubclass(field_class(field_name), LearnedField)
        return known.get(field_name, known["neus"]) if is_learned else None

    def mapping_of(self, field_name: str) -> Any:
        """Mapping settings of a field."""
        return look_up("field", field_name, replace(self).mapping)

    def tracking_of(self, tracker_name: str) -> TrackerSettings:
        """Settings of a tracker."""
        return look_up("tracker", tracker_name, replace(self).tracking)


def _like(other: Any, kind: type) -> Any:
    """Settings of a class, with what is changed in those of another where both have it."""
    if other is None or type(other) is kind:
        return other or kind()
    usual = vars(type(other)())
    changed = {name for name, value in vars(other).items() if value != usual[name]}
    return kind(**{name: getattr(other, name) for name in changed & vars(kind()).keys()})


def _from_file(name: str) -> Preset:
    """A preset of this folder; what it does not name follows what it does, whenever registered."""
    said = read_object(Path(__file__).with_name(f"{name}.toml"))
    network = {n: with_values(k, said["network"].get(n, {})) for n, k in _NETWORKS.items()}
    mapping = {f: with_values(field_class(f).Settings(), v) for f, v in said["mapping"].items()}
    tracking = {t: with_values(tracker_class(t).Settings(), v) for t, v in said["tracking"].items()}
    return with_values(Preset(name, network, mapping, tracking=tracking), said)


_SMALL = _from_file("smoke")
_NINE = replace(_SMALL.scenes, names=REPORTED_ROOMS, track_frames=":")
PRESETS = {
    "smoke": _SMALL,
    "nine_rooms": replace(_SMALL, name="nine_rooms", scenes=_NINE),
    "synthetic": Preset("synthetic", scenes=ScenesConfig(REPORTED_ROOMS)),
    "paper": Preset("paper", scenes=ScenesConfig(tuple(DATASET_SCENES))),
}


def load_preset(
    name: str | None = None, config_file: Path | None = None, settings: Sequence[str] = ()
) -> Preset:
    """A preset, by default that of `NBTRACK_PRESET`, else `smoke`, with all overrides applied.

    They are a TOML file, by default the one that `NBTRACK_CONFIG` names, and `key=value` texts,
    after those in `NBTRACK_SET`. Raises ConfigError for an unknown preset or key, or a value of the
    wrong type; MissingError if the file does not exist, DataError if it is no TOML.
    """
    preset = look_up("preset", name or os.environ.get("NBTRACK_PRESET", "smoke"), PRESETS)
    layers = []
    if config_file := config_file or os.environ.get("NBTRACK_CONFIG"):
        config_file = absolute(config_file)
        if not config_file.is_file():
            raise MissingError(f"no config file {config_file}: give a TOML file of settings")
        layers.append(flat(read_object(config_file)))
    try:
        before = shlex.split(os.environ.get("NBTRACK_SET", ""))
    except ValueError as error:
        advice = "quote each setting as in a shell"
        raise ConfigError(f"NBTRACK_SET cannot be split ({error}): {advice}") from None
    chosen: set[str] = set()
    for layer in [*layers, *map(read_setting, [*before, *settings])]:
        preset = with_values(preset, layer)  # a value that a later one replaces is checked too
        chosen |= layer.keys()
    return replace(preset, chosen=tuple(sorted(chosen)))


def claim(preset: Preset, holds: bool, text: str, usual: Sequence[str] = ()) -> None:
    """Print what a notebook claims of its results, or warn that it does not hold.

    What is claimed was found with `smoke` and the notebook's usual `key=value` texts: there it must
    hold, or it is an AssertionError.
    """
    if holds:
        print(text)
    elif changed_settings(preset, with_settings(replace(PRESETS["smoke"]), *usual)):
        warnings.warn(f"with these settings it does not hold that {text}", stacklevel=2)
    else:
        raise AssertionError(f"it does not hold that {text}")
