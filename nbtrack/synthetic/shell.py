"""The room's own walls, floor and ceiling: a cuboid seen from inside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbtrack.synthetic.closed_forms import (
    Origins,
    Points,
    Values,
    Vector3,
    box_distance,
    box_surface,
    slab_interval,
)
from nbtrack.synthetic.primitives import Solid


@dataclass(frozen=True)
class RoomShell(Solid):
    """An axis-aligned cuboid whose free space is its inside; normals point into the room.

    Signed distance is positive inside and negative within the walls, as for every solid: the
    solid here is everything outside the cuboid.
    """

    lower: Vector3  # corner with the smallest coordinates (m)
    upper: Vector3  # corner with the largest coordinates (m)

    def _frame(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        return (lower + upper) / 2, (upper - lower) / 2

    def sdf(self, points_world: Points) -> Values:
        """Exact signed distance (m), positive inside the room."""
        center, half = self._frame()
        return -box_distance(np.abs(points_world - center) - half)

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Ray parameter at which a ray from inside reaches the wall; inf when it starts outside."""
        center, half = self._frame()
        near, far = slab_interval(origins - center, directions, half)
        return np.where((near <= 0.0) & (far > 0.0), far, np.inf)

    def normals(self, points_world: Points) -> Points:
        """Unit normals, into the room, of the nearest wall, floor or ceiling."""
        center, half = self._frame()
        local = points_world - center
        axis = (np.abs(local) - half).argmax(axis=1)
        rows = np.arange(len(local))
        normals = np.zeros_like(local)
        normals[rows, axis] = np.where(local[rows, axis] < 0, 1.0, -1.0)
        return normals

    def bounding_sphere(self) -> tuple[Float[np.ndarray, "3"], float]:
        """Sphere around the cuboid: it holds the surface, the solid itself being unbounded."""
        center, half = self._frame()
        return center, float(np.linalg.norm(half))

    def area(self) -> float:
        """Area (m²) of walls, floor and ceiling."""
        x, y, z = 2 * self._frame()[1]
        return float(2 * (x * y + y * z + z * x))

    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """Uniform points on walls, floor and ceiling."""
        center, half = self._frame()
        return center + box_surface(half, n, rng)


def centered_shell(width: float, height: float, depth: float) -> RoomShell:
    """Shell of that size along (x, y, z), centered on x = z = 0, with its floor at y = 0."""
    return RoomShell((-width / 2, 0.0, -depth / 2), (width / 2, height, depth / 2))
