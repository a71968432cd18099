"""The axis-aligned box of a scene: where fields are defined and where rays end."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.arrays import Points, Values
from nbtrack.core.device import constant


@dataclass(frozen=True)
class SceneBounds:
    """Axis-aligned box in the world frame, metres."""

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Middle of the box, world frame."""
        return (np.array(self.minimum) + np.array(self.maximum)) / 2

    @property
    def metres_per_unit(self) -> float:
        """Half of the longest side: it maps the box into [-1, 1]^3 without changing its shape."""
        return float((np.array(self.maximum) - np.array(self.minimum)).max() / 2)

    def far_bound(self, origins_world: Points, directions_world: Points) -> Values:
        """Where rays from inside leave the box, in units of the direction (z-depth, m, for z = 1).

        Rays that start outside, as a lost camera's do, may give small or negative values.
        """
        # An axis that a ray runs along is left at infinity, never at 0/0.
        safe = torch.where(directions_world.abs() < 1e-9, 1e-9, directions_world)
        low, high = self._corners(origins_world)
        to_minimum, to_maximum = (low - origins_world) / safe, (high - origins_world) / safe
        return torch.maximum(to_minimum, to_maximum).amin(dim=-1)

    def _corners(self, like: Tensor) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        corners = self.minimum, self.maximum
        return tuple(constant(corner, like.device, like.dtype) for corner in corners)
