"""Typed settings and the three presets."""

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any


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
    lambda_sdf: float = 10.0  # NeuS+ only, per metre
    n_surface_points: int = 1024  # NeuS+ only: measured points an iteration, besides the rays
    lambda_rendering: float = 1.0  # NeuS+ only: factor of rendered depth and colour; 0: none
    behind_band: float = 0.1  # NeuS+ only: distances are taught so far behind surfaces, m
    voxel: float = 0.02  # points only: edge of the cells whose measured points are averaged, m
    eikonal_share: float = 0.25  # share of the samples that the eikonal term looks at
    holdout_every: int = 10  # every n-th frame is kept from mapping and scored afterwards


@dataclass(frozen=True)
class TrackingConfig:
    """One tracker; what a tracker does not use it ignores."""

    engine: str = "fast"  # how the network is asked: fast, or plain torch; the answers are equal
    n_pixels: int = 4096  # new random pixels each iteration (paper: VR 512, SDF 4096)
    position_rate: float = 5e-4  # Adam's learning rate of the position, m (paper)
    orientation_rate: float = 1e-3  # Adam's learning rate of the unit quaternion (paper)
    lambda_sdf: float = 1.0  # per metre; the paper gives no value
    lambda_color: float = 0.3  # SDF, the paper gives no value; VR has iMAP's 5
    n_stratified: int = 32  # VR: samples of the first pass (iMAP)
    n_importance: int = 12  # VR: samples added for the second pass (iMAP)
    # Where a frame's search starts: previous_pose, constant_velocity, or the better of both.
    motion_model: str = "previous_pose"
    lambda_intensity: float = 1.0  # LM: weight of the intensity residual, both over their scale
    n_restarts: int = 8  # LM: further starts, where the first ends lost
    anneal: bool = True  # LM: robust scales fall with the residuals; else the narrowest throughout
    divide_by_slope: bool = True  # LM: residuals are f / |grad f|, else f
    bake_voxel: float = 0.0  # m; the field is asked on a grid of such cells, 0: itself


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
        default_factory=lambda: {
            "imap": MappingConfig(),
            "neus": MappingConfig(lambda_color=2.0),
            "neus_plus": MappingConfig(
                10_000, n_rays=512, n_surface_points=4096, lambda_color=6.0, eikonal_share=0.125
            ),
        }
    )
    tracking: dict[str, TrackingConfig] = field(
        default_factory=lambda: {
            "vr": TrackingConfig(n_pixels=512, lambda_color=5.0),
            "vr_neus": TrackingConfig(n_pixels=512, lambda_color=5.0),
            "sdf": TrackingConfig(),
            "lm": TrackingConfig(n_pixels=512, motion_model="better_of_both"),
            "icp": TrackingConfig(motion_model="constant_velocity"),
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
        "neus_plus": MappingConfig(
            1400,
            n_rays=96,
            n_stratified=8,
            n_surface=8,
            n_surface_points=1024,
            learning_rate=3e-3,
            lambda_color=6.0,
            eikonal_share=0.125,
        ),
    },
    tracking={
        "vr": TrackingConfig(n_pixels=64, lambda_color=5.0),
        "vr_neus": TrackingConfig(n_pixels=64, lambda_color=5.0),
        "sdf": TrackingConfig(n_pixels=512),
        "lm": TrackingConfig(n_pixels=512, motion_model="better_of_both"),
        "icp": TrackingConfig(motion_model="constant_velocity"),
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


def as_dict(config: Any) -> dict[str, Any]:
    """A config as nested dictionaries of plain values, ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))
