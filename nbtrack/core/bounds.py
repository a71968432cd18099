"""The axis-aligned box of a scene: where fields are defined and where rays end."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.core.arrays import Points, Values
from nbtrack.machinery.device import constant
from nbtrack.machinery.errors import ConfigError


@dataclass(frozen=True)
class SceneBounds:
    """Axis-aligned box in the world frame, metres."""

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    declared_unit: float | None = None  # m, where the authors of a recording give it

    def __post_init__(self) -> None:
        """Raises ConfigError for corners that are not finite, or no box, or no positive unit."""
        low, high = (tuple(map(float, corner)) for corner in (self.minimum, self.maximum))
        unit = 1.0 if self.declared_unit is None else self.declared_unit
        if len(low) != 3 or not all(0 < x < np.inf for x in (*np.subtract(high, low), unit)):
            raise ConfigError(f"{self} are no bounds: give a minimum and a larger maximum, in m")
        object.__setattr__(self, "minimum", low)
        object.__setattr__(self, "maximum", high)

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Middle of the box, world frame."""
        return (np.array(self.minimum) + np.array(self.maximum)) / 2

    @property
    def metres_per_unit(self) -> float:
        """The unit of the map (m): that of networks' inputs, and of Adam's rate of the position.

        It is the declared one, else half of the longest side, as NeuS and the Neural RGB-D dataset
        normalise their scenes to about [-1, 1]^3.
        """
        return self.declared_unit or float(np.subtract(self.maximum, self.minimum).max() / 2)

    def far_bound(self, origins_world: Points, directions_world: Points) -> Values:
        """The t at which points origin + t * direction, which start inside, leave the box.

        It is a z-depth (m) where directions have z = 1 in the camera frame. Rays that start
        outside, as a lost camera's do, may give small or negative values.
        """
        # Along an axis in which a ray does not move its t becomes huge; 0 could give 0/0.
        safe = torch.where(directions_world.abs() < 1e-9, 1e-9, directions_world)
        device, dtype = origins_world.device, origins_world.dtype
        to_minimum = (constant(self.minimum, device, dtype) - origins_world) / safe
        to_maximum = (constant(self.maximum, device, dtype) - origins_world) / safe
        return torch.maximum(to_minimum, to_maximum).amin(dim=-1)
