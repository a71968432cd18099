"""Solids with exact signed distance (m) and closed-form ray intersection, in the world frame.

World axes: y up, metres. Distances are positive outside a solid and negative inside it.
"""

from abc import ABC, abstractmethod
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
    quadratic_interval,
    row_dot,
    slab_interval,
)


class Solid(ABC):
    """A closed convex body. Subclasses say how far, where hit, which normal and how large."""

    @abstractmethod
    def sdf(self, points_world: Points) -> Values:
        """Exact signed distance (m), outside and inside."""

    @abstractmethod
    def hit(self, origins: Origins, directions: Points) -> Values:
        """Ray parameter at which a ray from outside enters the solid; inf for a miss.

        In units of the direction's length: with camera directions of z = 1 it is the z-depth.
        Rays that start inside count as misses: cameras live in free space.
        """

    @abstractmethod
    def normals(self, points_world: Points) -> Points:
        """Unit outward normals at points on the surface."""

    @abstractmethod
    def bounding_sphere(self) -> tuple[Float[np.ndarray, "3"], float]:
        """Center (world) and radius (m) of a sphere that holds the solid."""

    @abstractmethod
    def area(self) -> float:
        """Surface area (m²)."""

    @abstractmethod
    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """`n` world points, uniform over the surface."""

    def intersect(self, origins: Origins, directions: Points) -> tuple[Values, Points]:
        """First hit: ray parameter (n,), inf for a miss, and outward normals, zero for a miss."""
        t = self.hit(origins, directions)
        found = np.isfinite(t)
        points = origins + np.where(found, t, 0.0)[:, None] * directions
        return t, np.where(found[:, None], self.normals(points), 0.0)


def _entry(near: Values, far: Values) -> Values:
    return np.where((near <= far) & (near > 0.0), near, np.inf)


@dataclass(frozen=True)
class Box(Solid):
    """A cuboid that may be turned about the vertical axis."""

    center: Vector3
    size: Vector3  # full edge lengths (m) along its own x, y, z
    yaw: float = 0.0  # rad, counter-clockwise seen from above

    def _rotation_world_box(self) -> Float[np.ndarray, "3 3"]:
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])

    def _half(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.size) / 2

    def _to_box(self, points_world: Origins) -> Origins:
        return (points_world - np.asarray(self.center)) @ self._rotation_world_box()

    def sdf(self, points_world: Points) -> Values:
        """Exact signed distance (m)."""
        return box_distance(np.abs(self._to_box(points_world)) - self._half())

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Entry parameter by the slab method; inf for a miss."""
        turned = directions @ self._rotation_world_box()
        return _entry(*slab_interval(self._to_box(origins), turned, self._half()))

    def normals(self, points_world: Points) -> Points:
        """Unit normals of the face that lies nearest."""
        local = self._to_box(points_world)
        axis = (np.abs(local) - self._half()).argmax(axis=1)
        rows = np.arange(len(local))
        normals = np.zeros_like(local)
        normals[rows, axis] = np.where(local[rows, axis] < 0, -1.0, 1.0)
        return normals @ self._rotation_world_box().T

    def bounding_sphere(self) -> tuple[Float[np.ndarray, "3"], float]:
        """Center and half the diagonal."""
        return np.asarray(self.center), float(np.linalg.norm(self._half()))

    def area(self) -> float:
        """Surface area (m²)."""
        x, y, z = self.size
        return 2 * (x * y + y * z + z * x)

    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """Uniform points on the six faces."""
        local = box_surface(self._half(), n, rng)
        return local @ self._rotation_world_box().T + np.asarray(self.center)


@dataclass(frozen=True)
class Sphere(Solid):
    """A ball."""

    center: Vector3
    radius: float

    def sdf(self, points_world: Points) -> Values:
        """Exact signed distance (m)."""
        offset = points_world - np.asarray(self.center)
        return np.sqrt(row_dot(offset, offset)) - self.radius

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Smaller root of the quadratic; inf for a miss."""
        offset = origins - np.asarray(self.center)
        return _entry(*quadratic_interval(offset, directions, self.radius))

    def normals(self, points_world: Points) -> Points:
        """Unit radial directions."""
        return (points_world - np.asarray(self.center)) / self.radius

    def bounding_sphere(self) -> tuple[Float[np.ndarray, "3"], float]:
        """The sphere itself."""
        return np.asarray(self.center), self.radius

    def area(self) -> float:
        """Surface area (m²)."""
        return 4 * np.pi * self.radius**2

    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """Uniform points, as normalised Gaussian vectors."""
        vectors = rng.normal(size=(n, 3))
        scale = self.radius / np.linalg.norm(vectors, axis=1, keepdims=True)
        return vectors * scale + np.asarray(self.center)


@dataclass(frozen=True)
class Cylinder(Solid):
    """A cylinder or rod with flat caps, in any direction."""

    start: Vector3  # center of one cap
    end: Vector3  # center of the other cap
    radius: float

    def _frame(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
        start, end = np.asarray(self.start), np.asarray(self.end)
        length = float(np.linalg.norm(end - start))
        return (start + end) / 2, (end - start) / length, length / 2

    def _excess(self, points_world: Points) -> tuple[Float[np.ndarray, "n 2"], Points, Values]:
        center, axis, half = self._frame()
        axial = (points_world - center) @ axis
        radial = points_world - center - axial[:, None] * axis
        sideways = np.sqrt(row_dot(radial, radial)) - self.radius
        return np.stack([sideways, np.abs(axial) - half], axis=1), radial, axial

    def sdf(self, points_world: Points) -> Values:
        """Exact signed distance (m): a rectangle's, in the plane of radius and axis."""
        return box_distance(self._excess(points_world)[0])

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Entry parameter: the later of entering the endless cylinder and the slab of its caps."""
        center, axis, half = self._frame()
        offset_along, slope_along = (origins - center) @ axis, directions @ axis
        offset_side = origins - center - offset_along[..., None] * axis
        slope_side = directions - slope_along[:, None] * axis
        side = quadratic_interval(offset_side, slope_side, self.radius)
        caps = slab_interval(offset_along[..., None], slope_along[:, None], np.array([half]))
        return _entry(np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1]))

    def normals(self, points_world: Points) -> Points:
        """Unit normals of the side or the cap, whichever lies nearer."""
        _, axis, _ = self._frame()
        excess, radial, axial = self._excess(points_world)
        lengths = np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-12)
        cap = np.where(axial < 0, -1.0, 1.0)[:, None] * axis
        return np.where((excess[:, 1] > excess[:, 0])[:, None], cap, radial / lengths)

    def bounding_sphere(self) -> tuple[Float[np.ndarray, "3"], float]:
        """Middle of the axis and the distance to a cap's rim."""
        center, _, half = self._frame()
        return center, float(np.hypot(half, self.radius))

    def area(self) -> float:
        """Surface area (m²), caps included."""
        return 2 * np.pi * self.radius * (2 * self._frame()[2] + self.radius)

    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """Uniform points on side and caps."""
        center, axis, half = self._frame()
        # The coordinate axis least aligned with the cylinder spans the plane of its caps.
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
        angles = rng.uniform(0.0, 2 * np.pi, n)
        on_side = rng.uniform(size=n) < 2 * half / (2 * half + self.radius)
        radii = self.radius * np.where(on_side, 1.0, np.sqrt(rng.uniform(size=n)))
        heights = half * np.where(on_side, rng.uniform(-1.0, 1.0, n), rng.choice([-1.0, 1.0], n))
        rings = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
        return center + radii[:, None] * rings + heights[:, None] * axis
