"""What every field offers to mapping and tracking, and the registry of fields."""

import abc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.config import FieldConfig, MappingConfig
from nbtrack.core.errors import ConfigError, nearest_name
from nbtrack.data.pixels import Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.rendering import Rendering

LUMA = torch.tensor([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the intensity that trackers compare (ITU-R BT.601)."""


@dataclass(frozen=True)
class Batch:
    """What one iteration of mapping looks at."""

    rays: Rays
    depths: Float[Tensor, "rays samples"]  # ascending z-depths (m) of the samples on them
    surface: Rays | None = None  # through further pixels, of whose points only the last counts


@dataclass(frozen=True)
class Linearization:
    """A field's value and intensity at points, with their spatial gradients; all without graph."""

    value: Float[Tensor, "n"]  # signed distance, m
    value_gradient: Float[Tensor, "n 3"]  # no unit, length 1 for a true distance
    intensity: Float[Tensor, "n"]  # luma of the colour, in [0, 1]
    intensity_gradient: Float[Tensor, "n 3"]  # 1/m


class Field(nn.Module, abc.ABC):
    """A scene as a function of position: colour, and a value that says where surfaces are."""

    name: str  # on the command line and in file names
    label: str  # in tables and figures
    supervision: str = "rendering"  # what teaches it: tells variants of one field apart

    def __init__(self, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds

    @abc.abstractmethod
    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour in [0, 1] and the field's value at points (m, world frame)."""

    def linearize(self, points_world: Float[Tensor, "n 3"]) -> Linearization:
        """Value and intensity with their gradients at points (m), by automatic differentiation.

        Fields that second-order trackers use override it: writing the derivatives out saves the
        bookkeeping, which costs more than the arithmetic of a small network.
        """
        points = points_world.detach().requires_grad_()
        with torch.enable_grad():
            color, value = self(points)
            intensity = color @ LUMA.to(color)
            (value_gradient,) = torch.autograd.grad(value.sum(), points, retain_graph=True)
            (intensity_gradient,) = torch.autograd.grad(intensity.sum(), points)
        return Linearization(value.detach(), value_gradient, intensity.detach(), intensity_gradient)

    @property
    @abc.abstractmethod
    def surface_level(self) -> float:
        """The value whose isosurface is drawn as the scene's surface."""


class LearnedField(Field):
    """A field that is fitted to posed frames by gradient descent, and can be rendered."""

    # Whether mapping may place its samples by the measured depth. A field that is tracked by
    # rendering must not: tracking has no such help, and the map would be thinner than its rays see.
    depth_guided: bool = True
    # Whether mapping's batches hold tangent planes and surface points: four more depths a ray, and
    # more pixels.
    is_taught_distances: bool = False

    @abc.abstractmethod
    def composite(
        self,
        colors: Float[Tensor, "rays samples 3"],
        values: Float[Tensor, "rays samples"],
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
    ) -> Rendering:
        """Volume rendering from what the field answered at ascending z-depths (m)."""

    def along(
        self, rays: Rays, depths: Float[Tensor, "rays samples"]
    ) -> tuple[Float[Tensor, "rays samples 3"], Float[Tensor, "rays samples"]]:
        """Colour and value at z-depths (m) along rays."""
        colors, values = self(rays.points(depths).flatten(0, 1))
        return colors.view(*depths.shape, 3), values.view_as(depths)

    def render(self, rays: Rays, depths: Float[Tensor, "rays samples"]) -> Rendering:
        """Volume rendering with samples at ascending z-depths (m)."""
        return self.composite(*self.along(rays, depths), rays, depths)

    @abc.abstractmethod
    def mapping_losses(
        self, batch: Batch, config: MappingConfig, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Weighted loss terms of one batch by name; their sum is minimised."""

    def prepare(self, sequence: RgbdSequence, frames: Int[np.ndarray, "frames"]) -> None:
        """Take from the frames to be mapped what the losses need besides the rays of a batch."""

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


def supervised_field(name: str, supervision: str) -> str:
    """The name of the field that is `name` under a supervision ("rendering", "rendering+sdf").

    Raises:
        ConfigError: the field or the supervision is unknown, or they do not go together.
    """
    if field_class(name).supervision == supervision:
        return name
    variants = {
        variant.supervision: other
        for other, variant in FIELDS.items()
        if issubclass(variant, field_class(name))
    }
    if supervision not in variants:
        raise ConfigError(
            f"field {name!r} knows no supervision {supervision!r}: "
            f"{nearest_name(supervision, sorted(variants))}"
        )
    return variants[supervision]


def make_field(name: str, config: FieldConfig, bounds: SceneBounds, seed: int) -> Field:
    """A fresh, seeded field inside `bounds`."""
    constructor: Callable[..., Field] = field_class(name)
    return constructor(config, bounds, torch.Generator().manual_seed(seed))


def measured_mean(
    error: Float[Tensor, "rays"], measured: Float[Tensor, "rays"]
) -> Float[Tensor, ""]:
    """Mean error over the rays with a depth measurement (mask of 0 and 1); 0 if there is none."""
    return (error * measured).sum() / measured.sum().clamp_min(1)
