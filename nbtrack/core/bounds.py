"""The axis-aligned box of a scene, in which fields are defined and at which rays end."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.core.arrays import Points, Values
from nbtrack.machinery.device import constant
from nbtrack.machinery.errors import ConfigError, typed


@typed
@dataclass(frozen=True)
class SceneBounds:
    """Axis-aligned box in the world frame, metres."""

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]
    declared_unit: float | None = None  # m, if the authors of a recording give it

    def __post_init__(self) -> None:
        """Makes the corners tuples of Python's floats.

        Raises ConfigError for corners that are not finite or span no box, or a unit that is not
        positive and finite.
        """
        low, high = tuple(map(float, self.minimum)), tuple(map(float, self.maximum))
        unit = 1.0 if self.declared_unit is None else float(self.declared_unit)
        # NaN fails, too: no comparison with it holds.
        if not all(0 < length < np.inf for length in (*np.subtract(high, low), unit)):
            raise ConfigError(f"{self} are no bounds: give a minimum and a larger maximum, in m")
        object.__setattr__(self, "minimum", low)
        object.__setattr__(self, "maximum", high)

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Middle of the box, world frame."""
        return (np.array(self.minimum) + np.array(self.maximum)) / 2

    @property
    def metres_per_unit(self) -> float:
        """Metres in a unit of the map, for positions in networks and for Adam's position rate.

        This is the declared unit or, without one, half of the longest side: NeuS and the Neural
        RGB-D dataset also normalise their scenes to about [-1, 1]^3.
        """
        return self.declared_unit or float(np.subtract(self.maximum, self.minimum).max() / 2)

    def far_bound(self, origins_world: Points, directions_world: Points) -> Values:
        """For each ray origin + t * direction that starts in the box, the t at which it leaves it.

        If directions have z = 1 in the camera frame, t is a z-depth (m). For rays that start
        outside, as those of a lost camera do, t may be small or negative.
        """
        # A ray parallel to two faces gets a huge t there; with a direction of 0 it could be 0/0.
        safe = torch.where(directions_world.abs() < 1e-9, 1e-9, directions_world)
        device, dtype = origins_world.device, origins_world.dtype
        to_minimum = (constant(self.minimum, device, dtype) - origins_world) / safe
        to_maximum = (constant(self.maximum, device, dtype) - origins_world) / safe
        # A ray leaves the box where it first passes the farther face of an axis.
        return torch.maximum(to_minimum, to_maximum).amin(dim=-1)
