"""What every field offers to mapping and tracking, and the registry of fields."""

import abc
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nbtrack.bounds import SceneBounds
from nbtrack.config import FieldConfig, MappingConfig
from nbtrack.errors import ConfigError, nearest_name
from nbtrack.rendering import Rendering


@dataclass(frozen=True)
class Rays:
    """Rays through pixels, with what the camera measured there."""

    origins_world: Float[Tensor, "rays 3"]
    directions_world: Float[Tensor, "rays 3"]  # z = 1 in the camera frame: steps are z-depths
    color: Float[Tensor, "rays 3"]  # measured, in [0, 1]
    depth: Float[Tensor, "rays"]  # measured z-depth (m), 0 = no measurement

    def points(self, depths: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples 3"]:
        """World points (m) at z-depths along the rays."""
        return self.origins_world[:, None] + depths[..., None] * self.directions_world[:, None]


class Field(nn.Module, abc.ABC):
    """A scene as a function of position: colour, and a value that says where surfaces are."""

    name: str  # on the command line and in file names
    label: str  # in tables and figures
    # Whether mapping may place its samples by the measured depth. A field that is tracked by
    # rendering must not: tracking has no such help, and the map would be thinner than its rays see.
    depth_guided: bool = True

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds

    @abc.abstractmethod
    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and the field's value at points (m, world frame)."""

    @abc.abstractmethod
    def render(self, rays: Rays, depths: Float[Tensor, "rays samples"]) -> Rendering:
        """Volume rendering with samples at ascending z-depths (m)."""

    @abc.abstractmethod
    def mapping_losses(
        self,
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
        config: MappingConfig,
        generator: torch.Generator,
    ) -> dict[str, Float[Tensor, ""]]:
        """Weighted loss terms of one batch by name; their sum is minimised."""

    @property
    @abc.abstractmethod
    def surface_level(self) -> float:
        """The value whose isosurface is drawn as the scene's surface."""

    def diagnostics(self) -> dict[str, float]:
        """Scalars worth a curve over training, beside the losses."""
        return {}


FIELDS: dict[str, type[Field]] = {}


def register_field(field_class: type[Field]) -> type[Field]:
    """Class decorator that makes a field known under its name."""
    FIELDS[field_class.name] = field_class
    return field_class


def field_class(name: str) -> type[Field]:
    """The registered field of a name. Raises ConfigError, naming the nearest, for any other."""
    if name not in FIELDS:
        raise ConfigError(f"unknown field {name!r}: {nearest_name(name, sorted(FIELDS))}")
    return FIELDS[name]


def make_field(name: str, config: FieldConfig, bounds: SceneBounds, seed: int) -> Field:
    """A fresh, seeded field inside `bounds`."""
    constructor: Callable[..., Field] = field_class(name)
    return constructor(config, bounds, torch.Generator().manual_seed(seed))


def measured_mean(
    error: Float[Tensor, "rays"], measured: Float[Tensor, "rays"]
) -> Float[Tensor, ""]:
    """Mean error over the rays with a depth measurement (mask of 0 and 1); 0 if there is none."""
    return (error * measured).sum() / measured.sum().clamp_min(1)
