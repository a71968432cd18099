"""Presets: everything that a run depends on, apart from the data and the seed.

Precedence, in every command: class defaults < preset < method < TOML file (`NBTRACK_CONFIG` or
`--config`) < `NBTRACK_SET` < `--set key=value`.
"""

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from nbtrack.core.errors import ConfigError, MissingError, look_up
from nbtrack.core.settings import limited, setting_texts, with_settings, with_values
from nbtrack.data.formats import DATASET_SCENES
from nbtrack.data.text_files import read_object
from nbtrack.fields import FIELDS, LearnedField, NetworkSettings, NeusMapping, field_class
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.tables import PAPER_PIXELS
from nbtrack.tracking import TRACKERS, SdfSettings, TrackerSettings, tracker_class


@dataclass(frozen=True)
class ScenesConfig:
    """Which sequences a preset maps and tracks, and how synthetic rooms are made."""

    names: tuple[str, ...] = ()  # synthetic rooms, or folders below the data folder
    motion: str = "keyframes"  # in a synthetic room: as the dataset's; or handheld, or a tour
    n_frames: int = limited(300, 2, 10_000)
    width: int = limited(640, 11, 4096)  # pixels; the height is three quarters of it
    track_frames: str = ":"  # the Python slice of frames that is tracked
    seed: int = limited(0, 0, 2**31 - 1)


@dataclass(frozen=True)
class TablesConfig:
    """What the two tables ask of the cells."""

    rates_hz: tuple[float, ...] = limited((10.0, 5.0, 2.0), 0.01, 100.0)  # paper, Table I
    budgets_ms: tuple[float, ...] = limited((50.0, 100.0, 500.0), 0.1, 1e5)  # paper, Table II
    # Pixels n of each tracker in Table II (paper); others take those of the SDF tracker.
    pixels: dict[str, tuple[int, ...]] = field(
        default_factory=lambda: {"vr": (128, 512, 1024), "sdf": (2048, 4096, 16384)}
    )


@dataclass(frozen=True)
class Preset:
    """Everything that a run depends on, apart from the data and the seed."""

    name: str = field(metadata={"is_setting": False})  # no `key=value` reaches it
    # A density gains from finer detail; a distance must start smooth, or ripples satisfy the
    # eikonal term: at 4 rad/m in place of 2.5 it was off by 19 cm in free space, not by 5.
    network: dict[str, Any] = field(
        default_factory=lambda: {
            "imap": NetworkSettings(embedding_sigma=4.0),
            "neus": NetworkSettings(),
            "occupancy": NetworkSettings(embedding_sigma=4.0),
        }
    )
    # Of every field and tracker; of those that are not given, the defaults of their classes.
    mapping: dict[str, Any] = field(default_factory=dict)
    tracking: dict[str, TrackerSettings] = field(default_factory=dict)
    scenes: ScenesConfig = ScenesConfig()
    tables: TablesConfig = TablesConfig()
    # The `key=value` texts of the user's own, which come after those of a method.
    chosen: tuple[str, ...] = field(default=(), metadata={"is_setting": False})

    def __post_init__(self) -> None:
        """Add settings of all registered fields and trackers, and of networks of other kinds."""
        others = {
            name: self.network_of(name)
            for name, kind in FIELDS.items()
            if issubclass(kind, LearnedField) and kind.Network is not NetworkSettings
        }
        object.__setattr__(self, "network", self.network | others)
        object.__setattr__(self, "mapping", {name: self.mapping_of(name) for name in FIELDS})
        object.__setattr__(self, "tracking", {name: self.tracking_of(name) for name in TRACKERS})

    @property
    def step_counts(self) -> str:
        """For captions of tables with the paper's step counts: the sizes of the paper and ours."""
        paper = " and ".join(f"{n} ({tracker})" for tracker, n in PAPER_PIXELS.items())
        own = " and ".join(f"{self.tracking_of(t.lower()).n_pixels} ({t})" for t in PAPER_PIXELS)
        width, own_width = NetworkSettings().width, self.network_of("neus").width
        there = f"measured there with n = {paper} and {width} units a layer"
        return f"the paper's step counts, {there}; here n = {own} and {own_width} units"

    def with_method(self, settings: Sequence[str]) -> "Preset":
        """The preset with the `key=value` texts of a method, and then those that a user chose."""
        return with_settings(self, *settings, *self.chosen)

    def network_of(self, field_name: str) -> Any:
        """Network of a field; one without its own takes what was changed of NeuS's."""
        kind = field_class(field_name)
        network = kind.Network if issubclass(kind, LearnedField) else NetworkSettings
        return _own_or_like("neus", self.network, field_name, network, NetworkSettings())

    def mapping_of(self, field_name: str) -> Any:
        """Mapping settings of a field; one that has none takes what was changed of NeuS's."""
        kind = field_class(field_name).Settings
        return _own_or_like("neus", self.mapping, field_name, kind, NeusMapping())

    def tracking_of(self, tracker_name: str) -> TrackerSettings:
        """Settings of a tracker; one that has none takes what was changed of SDF tracking's."""
        kind = tracker_class(tracker_name).Settings
        return _own_or_like("sdf", self.tracking, tracker_name, kind, SdfSettings())


def _own_or_like(usual: str, known: dict[str, Any], name: str, kind: type, plain: Any) -> Any:
    """Settings of a class: those of a name, else its defaults, but for what differs from `plain` in
    those of the usual one: so a preset's sizes are those of what is registered later, too."""
    if name in known:
        return _shared(kind, known[name])
    like = known.get(usual, plain)
    changed = {f.name for f in fields(plain) if getattr(like, f.name) != getattr(plain, f.name)}
    return _shared(kind, like, changed)


def _shared(kind: type, other: Any, names: set[str] | None = None) -> Any:
    """Settings of a class with those values of another's that both have, of these names."""
    both = {f.name for f in fields(kind)} & {f.name for f in fields(other)}
    both = both if names is None else both & names
    return kind(**{name: getattr(other, name) for name in both})


def _from_file(name: str) -> Preset:
    """A preset of this folder; what it does not name follows what it does, whenever registered."""
    said = read_object(Path(__file__).with_name(f"{name}.toml"))
    mapping = {f: with_values(field_class(f).Settings(), v) for f, v in said["mapping"].items()}
    tracking = {t: with_values(tracker_class(t).Settings(), v) for t, v in said["tracking"].items()}
    return with_values(Preset(name, mapping=mapping, tracking=tracking), said)


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
    in_file: list[str] = []
    if config_file := config_file or os.environ.get("NBTRACK_CONFIG"):
        if not Path(config_file).is_file():
            raise MissingError(f"no config file {config_file}: give a TOML file of settings")
        values = read_object(Path(config_file))
        preset, in_file = with_values(preset, values), setting_texts(values)
    try:
        before = shlex.split(os.environ.get("NBTRACK_SET", ""))
    except ValueError as error:
        advice = "quote each setting as in a shell"
        raise ConfigError(f"NBTRACK_SET cannot be split ({error}): {advice}") from None
    chosen = *in_file, *before, *settings
    return replace(with_settings(preset, *before, *settings), chosen=chosen)
