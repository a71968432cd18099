"""Typed settings, the three presets, and checked overrides.

Precedence: preset < TOML file (`NBTRACK_CONFIG` or `--config`) < `NBTRACK_SET` < `--set key=value`.
Keys are dotted paths such as `mapping.neus.iterations`; an unknown one is an error.
"""

import dataclasses
import json
import math
import os
import shlex
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nbtrack.errors import ConfigError, MissingError, nearest_name


@dataclass(frozen=True)
class FieldConfig:
    """The network that both fields share."""

    width: int = 256  # hidden units a layer (iMAP)
    n_frequencies: int = 93  # learnable sines of the embedding (iMAP)
    # Standard deviation of the sines' first frequencies, rad/m. 2.5 is iMAP's own: 25 on
    # coordinates scaled by 1/10.
    embedding_sigma: float = 2.5


@dataclass(frozen=True)
class MappingConfig:
    """Fitting a field to posed frames. The paper gives none of these figures."""

    iterations: int = 20_000
    n_rays: int = 1024  # a batch, drawn over all mapping frames
    n_stratified: int = 32  # samples a ray, spread evenly (iMAP)
    # Samples a ray at the surface: iMAP's second pass, or around the measured depth (NeuS).
    n_surface: int = 12
    surface_band: float = 0.15  # NeuS: half width of that region, m
    learning_rate: float = 1e-3  # Adam's, at the start; falls to a twentieth along a cosine (NeuS)
    lambda_color: float = 5.0  # iMAP's, whose depth errors are relative to their deviation
    lambda_depth: float = 1.0  # NeuS only, per metre
    lambda_eikonal: float = 0.5  # NeuS only; five times the method's own: rooms are mostly empty
    eikonal_share: float = 0.25  # share of the samples that the eikonal term looks at
    holdout_every: int = 10  # every n-th frame is kept from mapping and scored afterwards


@dataclass(frozen=True)
class TrackingConfig:
    """One tracker; what a tracker does not use it ignores."""

    n_pixels: int = 4096  # new random pixels each iteration (paper: VR 512, SDF 4096)
    position_rate: float = 5e-4  # Adam's learning rate of the position, m (paper)
    orientation_rate: float = 1e-3  # Adam's learning rate of the unit quaternion (paper)
    lambda_sdf: float = 1.0  # per metre; the paper gives no value
    lambda_color: float = 0.3  # SDF, the paper gives no value; VR has iMAP's 5
    n_stratified: int = 32  # VR: samples of the first pass (iMAP)
    n_importance: int = 12  # VR: samples added for the second pass (iMAP)
    motion_model: str = "previous_pose"  # where a frame's search starts; or constant_velocity


@dataclass(frozen=True)
class ScenesConfig:
    """Which sequences a preset maps and tracks, and how synthetic rooms are made."""

    names: tuple[str, ...] = ()  # synthetic rooms, or folders below the data folder
    synthetic: bool = True  # made by this package; otherwise read from the data folder
    n_frames: int = 300
    width: int = 640  # pixels; the height is three quarters of it
    track_frames: str = ":"  # the Python slice of frames that is tracked
    seed: int = 0


@dataclass(frozen=True)
class TablesConfig:
    """What the two tables ask of the cells."""

    rates_hz: tuple[float, ...] = (10.0, 5.0, 2.0)  # paper, Table I
    budgets_ms: tuple[float, ...] = (50.0, 100.0, 500.0)  # paper, Table II
    # Pixels n of each tracker in Table II (paper); others take those of the SDF tracker.
    pixels: dict[str, tuple[int, ...]] = field(
        default_factory=lambda: {"vr": (128, 512, 1024), "sdf": (2048, 4096, 16384)}
    )

    def pixels_of(self, tracker_name: str) -> tuple[int, ...]:
        """Pixel counts of a tracker's rows in Table II."""
        return self.pixels.get(tracker_name, self.pixels["sdf"])


@dataclass(frozen=True)
class Preset:
    """Everything that a run depends on, apart from the data and the seed."""

    name: str
    # A density gains from finer detail; a distance must start smooth, or ripples satisfy the
    # eikonal term: at 4 rad/m in place of 2.5 it was off by 19 cm in free space, not by 5.
    network: dict[str, FieldConfig] = field(
        default_factory=lambda: {"imap": FieldConfig(embedding_sigma=4.0), "neus": FieldConfig()}
    )
    mapping: dict[str, MappingConfig] = field(
        default_factory=lambda: {"imap": MappingConfig(), "neus": MappingConfig(lambda_color=2.0)}
    )
    tracking: dict[str, TrackingConfig] = field(
        default_factory=lambda: {
            "vr": TrackingConfig(n_pixels=512, lambda_color=5.0),
            "vr_neus": TrackingConfig(n_pixels=512, lambda_color=5.0),
            "sdf": TrackingConfig(),
        }
    )
    scenes: ScenesConfig = ScenesConfig()
    tables: TablesConfig = TablesConfig()

    def network_of(self, field_name: str) -> FieldConfig:
        """Network of a field; a field without its own takes that of NeuS."""
        return self.network.get(field_name, self.network["neus"])

    def mapping_of(self, field_name: str) -> MappingConfig:
        """Mapping settings of a field; a field without its own takes those of NeuS."""
        return self.mapping.get(field_name, self.mapping["neus"])

    def tracking_of(self, tracker_name: str) -> TrackingConfig:
        """Settings of a tracker; a tracker without its own takes those of the SDF tracker."""
        return self.tracking.get(tracker_name, self.tracking["sdf"])


# Pixel counts of `smoke` are the paper's divided by eight: the ratio of VR to SDF stays.
_SMOKE = Preset(
    "smoke",
    network={
        "imap": FieldConfig(width=96, embedding_sigma=4.0),
        "neus": FieldConfig(width=96),
    },
    mapping={
        "imap": MappingConfig(1200, n_rays=96, learning_rate=3e-3),
        "neus": MappingConfig(
            2000, n_rays=128, n_stratified=16, n_surface=8, learning_rate=3e-3, lambda_color=2.0
        ),
    },
    tracking={
        "vr": TrackingConfig(n_pixels=64, lambda_color=5.0),
        "vr_neus": TrackingConfig(n_pixels=64, lambda_color=5.0),
        "sdf": TrackingConfig(n_pixels=512),
    },
    scenes=ScenesConfig(("living_room", "office"), n_frames=240, width=96, track_frames=":120"),
    tables=TablesConfig(pixels={"vr": (16, 64, 128), "sdf": (256, 512, 2048)}),
)
_SYNTHETIC = Preset(
    "synthetic",
    scenes=ScenesConfig(
        (
            "living_room", "office", "trellis_room", "gallery", "stairwell", "patchwork_den",
            "grey_studio", "two_rooms", "long_hall",
        ),
    ),
)  # fmt: skip
_PAPER = Preset(
    "paper",
    scenes=ScenesConfig(
        (
            "breakfast_room", "complete_kitchen", "green_room", "grey_white_room", "kitchen",
            "morning_apartment", "staircase", "thin_geometry", "whiteroom",
        ),
        synthetic=False,
    ),
)  # fmt: skip
PRESETS = {preset.name: preset for preset in (_SMOKE, _SYNTHETIC, _PAPER)}


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


def as_dict(config: Any) -> dict[str, Any]:
    """A config as nested dictionaries of plain values, ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


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
_MAY_BE_ZERO = ("holdout_every", "n_surface", "n_importance", "seed")


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
