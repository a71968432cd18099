"""Presets: all settings of a run by one name, and how a user changes them.

A run depends on these settings, the data and the seed. In every command a later one of these wins
over those before it: the defaults of the settings classes, the preset, the method, a TOML file
(`NBTRACK_CONFIG` or `--config`), `NBTRACK_SET`, `--set key=value`.
"""

import os
import shlex
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.fields import FIELDS, LearnedField, NetworkSettings, field_class
from nbtrack.machinery.errors import ConfigError, MissingError, look_up, typed
from nbtrack.machinery.files import absolute
from nbtrack.machinery.inputs import read_object
from nbtrack.machinery.settings import flat, limited, one_of, with_settings, with_values
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.synthetic.make import MOTIONS
from nbtrack.tables import PAPER_PIXELS
from nbtrack.tracking import TRACKERS, TrackerSettings


@dataclass(frozen=True)
class ScenesConfig:
    """Which sequences a preset maps and tracks, and how synthetic rooms are made."""

    names: tuple[str, ...] = ()  # synthetic rooms, or folders below the data folder
    motion: str = one_of(*MOTIONS)  # of the camera in a synthetic room
    n_frames: int = limited(300, 2, 10_000)  # of a synthetic room
    width: int = limited(640, 11, 4096)  # of its images, in pixels; the height: 3/4, rounded down
    track_frames: str = ":"  # the Python slice of frames that are tracked
    seed: int = limited(0, 0, 2**31 - 1)  # of the noise and the motion in a synthetic room
    labels: tuple[str, ...] = ()  # NAME=LABEL: the names of scenes in LaTeX tables


SIZES = ("motion", "n_frames", "width", "seed")
"""The settings of a synthetic room on which its recording depends."""


@dataclass(frozen=True)
class TablesConfig:
    """The rates, budgets and numbers of pixels in the cells of Tables I and II."""

    rates_hz: tuple[float, ...] = limited((10.0, 5.0, 2.0), 0.01, 100.0)  # paper, Table I
    budgets_ms: tuple[float, ...] = limited((50.0, 100.0, 500.0), 0.1, 1e5)  # paper, Table II
    # The n (pixels) of Table II by tracker (paper). Trackers that are not named use those of "sdf".
    pixels: dict[str, tuple[int, ...]] = field(
        default_factory=lambda: {"vr": (128, 512, 1024), "sdf": (2048, 4096, 16384)}
    )


# Network settings of fields by name. A density gains from finer detail; a distance must start
# smooth, or ripples satisfy the eikonal term. A field that is not named here and has no `Network`
# class of its own, as NeuS+, uses the settings of NeuS.
_NETWORKS = {
    "imap": NetworkSettings(embedding_sigma=4.0),
    "neus": NetworkSettings(),
    "occupancy": NetworkSettings(embedding_sigma=4.0),
}
# For each part of the settings the field or tracker whose changes in a preset also hold for the
# fields or trackers that the preset does not name.
_MODELS = {"network": "neus", "mapping": "neus", "tracking": "sdf"}


@dataclass(frozen=True)
class Preset:
    """All settings of a run: those of a named preset with the changes of a method and of the user.

    Both kinds of changes are values by dotted keys, which were checked.
    """

    name: str
    of_method: dict[str, Any] = field(default_factory=dict)  # changes by the method that is run
    chosen: dict[str, Any] = field(default_factory=dict)  # by the user; they win over the method's

    @property
    def settings(self) -> dict[str, Any]:
        """All settings as a tree, for the fields and trackers that are registered now."""
        tree, changes = default_settings(), _CHANGES[self.name]
        of_unnamed = _changes_of_unnamed(changes, tree)
        # `with_values` is the function of `machinery.settings` here, not the method below.
        return with_values(tree, of_unnamed | changes | self.of_method | self.chosen)

    def with_values(self, values: Mapping[str, Any]) -> "Preset":
        """The preset with values that a user chose, by dotted keys.

        Raises ConfigError for an unknown key, or a value of the wrong type or range.
        """
        checked = flat(with_values(PRESETS[self.name].settings, values))
        return replace(self, chosen=self.chosen | {key: checked[key] for key in values})

    def with_method(self, settings: Sequence[str]) -> "Preset":
        """The preset with the `key=value` texts of a method; values that a user chose stay."""
        # The plain preset checks the texts; its chosen values are then those of the method.
        method = with_settings(PRESETS[self.name], *settings)
        return replace(self, of_method=self.of_method | method.chosen)

    @property
    def scenes(self) -> ScenesConfig:
        """Which sequences are mapped and tracked."""
        return self.settings["scenes"]

    @property
    def tables(self) -> TablesConfig:
        """The rates, budgets and numbers of pixels in the tables."""
        return self.settings["tables"]

    @property
    def correction(self) -> dict[str, float]:
        """The size (m) of the cells in which maps are corrected, by field; 0: no correction."""
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
        """A text for captions: the sizes for which the paper counted its steps, and those here."""
        paper = " and ".join(f"{n} ({tracker})" for tracker, n in PAPER_PIXELS.items())
        ours = " and ".join(f"{self.tracking_of(t.lower()).n_pixels} ({t})" for t in PAPER_PIXELS)
        width, our_width = NetworkSettings().width, self.network_of("neus").width
        in_paper = f"measured there with n = {paper} and {width} units a layer"
        counts = "the paper's step counts at 10 and 2 Hz, linear in time at other rates"
        return f"{counts}, {in_paper}; here n = {ours} and {our_width} units"


_SMALL = flat(read_object(Path(__file__).with_name("smoke.toml")))
# The committed results of nine_rooms were made with this number of iterations of NeuS.
_NINE = {"scenes.track_frames": ":", "mapping.neus.iterations": 1200}
# What each preset changes in the defaults of the settings classes, by dotted keys.
_CHANGES: dict[str, dict[str, Any]] = {
    "smoke": _SMALL,
    "nine_rooms": _SMALL | {"scenes.names": REPORTED_ROOMS} | _NINE,
    "synthetic": {"scenes.names": REPORTED_ROOMS},
    "paper": {"scenes.names": tuple(DATASET_SCENES)},
}
PRESETS = {name: Preset(name) for name in _CHANGES}


def default_settings() -> dict[str, Any]:
    """The tree of the defaults of all settings classes, for the fields and trackers known now."""
    learned = {name: kind for name, kind in FIELDS.items() if issubclass(kind, LearnedField)}
    # Fields with a class of network settings of their own.
    networks = {n: k.Network() for n, k in learned.items() if k.Network is not NetworkSettings}
    return {
        "network": _NETWORKS | networks,
        "mapping": {name: kind.Settings() for name, kind in FIELDS.items()},
        # Only maps of a distance can be corrected. The size of the cells (m); 0: no correction.
        "correction": {name: 0.0 for name, kind in learned.items() if kind.is_distance},
        "tracking": {name: kind.Settings() for name, kind in TRACKERS.items()},
        "scenes": ScenesConfig(),
        "tables": TablesConfig(),
    }


def _changes_of_unnamed(changes: dict[str, Any], tree: dict[str, Any]) -> dict[str, Any]:
    """What a preset changes in fields and trackers that it does not name, by dotted keys.

    Such a field gets the changes that the preset makes in NeuS, and such a tracker the changes in
    SDF tracking, for all settings that it has.
    """
    named = {tuple(key.split(".")[:2]) for key in changes}  # as ("mapping", "neus")
    values = {}
    for key, value in changes.items():
        part, name, *setting = key.split(".")  # keys such as scenes.names have no third part
        if name != _MODELS.get(part):
            continue
        for other, settings in tree[part].items():
            if (part, other) not in named and hasattr(settings, setting[0]):
                values[f"{part}.{other}.{setting[0]}"] = value
    return values


@typed
def load_preset(
    name: str | None = None,
    config_file: Path | None = None,
    settings: Sequence[str] = (),
    of_method: Sequence[str] = (),
) -> Preset:
    """A preset with all changes by a method and by the user.

    Its name is by default the one in `NBTRACK_PRESET`, else `smoke`. Of the changes, later ones win
    over earlier ones: the `key=value` texts in `of_method`; a TOML file, by default the one that
    `NBTRACK_CONFIG` names; the texts in `NBTRACK_SET`; the texts in `settings`. Raises ConfigError
    for an unknown preset or key, or a value of the wrong type or range; MissingError if the file
    does not exist; DataError if it is no TOML.
    """
    preset = look_up("preset", name or os.environ.get("NBTRACK_PRESET") or "smoke", PRESETS)
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
    # What the user has chosen wins over the method, although the method is added last.
    return with_settings(preset, *before, *settings).with_method(of_method)


@typed
def claim(preset: Preset, holds: bool, text: str, usual: Sequence[str] = ()) -> None:
    """Print a claim of a notebook about its results if it `holds`; else warn that it does not.

    The claim was found with the preset `smoke` and the notebook's `usual` texts `key=value`. With
    exactly these settings, a claim that does not hold raises AssertionError.
    """
    if holds:
        print(text)
    elif flat(preset.settings) != flat(with_settings(PRESETS["smoke"], *usual).settings):
        warnings.warn(f"with these settings it does not hold that {text}", stacklevel=2)
    else:
        raise AssertionError(f"it does not hold that {text}")
