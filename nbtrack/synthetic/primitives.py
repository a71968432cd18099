"""Solids with exact signed distance (m) and closed-form ray intersection, in the world frame.

World axes: y up, metres. Distances are positive outside a solid and negative inside it.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Float, Int

Vector3 = tuple[float, float, float]
Array3 = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, "n"]
Indices = Int[np.ndarray, "n"]
Rows = Float[np.ndarray, "n k"]
Vectors = Float[np.ndarray, "... k"]
Origins = Float[np.ndarray, "... 3"]  # one origin for all rays, (3,), or one each, (n, 3)
Interval = tuple[Values, Values]  # ray parameters between which a ray is inside; none: near > far
Sphere3 = tuple[Array3, float]  # center (world) and radius (m)


def row_dot(first: Vectors, second: Vectors) -> Float[np.ndarray, "..."]:
    """Scalar products along the last axis; several times as fast as multiply and sum."""
    return np.asarray(np.einsum("...i,...i->...", first, second))


def _row_max(rows: Rows) -> Values:
    """Largest entry of each row; for short rows several times as fast as `rows.max(axis=1)`."""
    return reduce(np.maximum, rows.T)


def _box_distance(excess: Rows) -> Values:
    """Signed distance to a k-dimensional box from `|local| - half_size`, exact on both sides."""
    beyond = np.maximum(excess, 0.0)
    return np.sqrt(row_dot(beyond, beyond)) + np.minimum(_row_max(excess), 0.0)


def _slab_interval(origins: Vectors, directions: Rows, half: Vectors) -> Interval:
    """Where a ray is inside the box |local| <= half."""
    # A direction parallel to a slab: a tiny slope sends both crossings far away, without 0/0.
    slope = np.where(directions == 0.0, 1e-30, directions)
    first, second = (-half - origins) / slope, (half - origins) / slope
    return _row_max(np.minimum(first, second)), -_row_max(-np.maximum(first, second))


def _round_interval(offsets: Origins, directions: Points, radius: float) -> Interval:
    """Where |offset + t direction| <= radius (none: near = inf, far = -inf)."""
    a, b = row_dot(directions, directions), row_dot(offsets, directions)
    c = row_dot(offsets, offsets) - radius**2
    moving = a > 1e-24
    a = np.where(moving, a, 1.0)
    discriminant = b * b - a * c
    # A ray along the axis of a cylinder never crosses its side: it is inside for ever or never.
    met = np.where(moving, discriminant > 0.0, c < 0.0)
    half_width = np.where(moving, np.sqrt(np.maximum(discriminant, 0.0)) / a, np.inf)
    return np.where(met, -b / a - half_width, np.inf), np.where(met, -b / a + half_width, -np.inf)


class Solid:
    """A closed convex body.

    Each has `sdf`, the exact signed distance (m) outside and inside; `_crossing`, where endless
    lines are inside; `normals`, unit and outward, at points on the surface; `bounding_sphere`,
    which holds it; `area` of its surface (m²); and `sample_surface`, uniform points there.
    """

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Ray parameter at which a ray from outside enters the solid; inf for a miss.

        In units of the direction's length: with camera directions of z = 1 it is the z-depth.
        Rays that start inside count as misses: cameras live in free space.
        """
        near, far = self._crossing(origins, directions)
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

    def _half(self) -> Array3:
        return np.asarray(self.size) / 2

    def _turned(self, vectors: Origins) -> Origins:
        return vectors @ self._rotation_world_box() if self.yaw else vectors

    def _to_box(self, points: Origins) -> Origins:
        return self._turned(points - np.asarray(self.center))

    def sdf(self, points: Points) -> Values:
        """Exact signed distance (m)."""
        return _box_distance(np.abs(self._to_box(points)) - self._half())

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        return _slab_interval(self._to_box(origins), self._turned(directions), self._half())

    def normals(self, points: Points) -> Points:
        """Unit normals of the face that lies nearest."""
        local = self._to_box(points)
        axis = (np.abs(local) - self._half()).argmax(axis=1)
        normals = np.eye(3)[axis] * np.where(local < 0, -1.0, 1.0)
        return normals @ self._rotation_world_box().T if self.yaw else normals

    def bounding_sphere(self) -> Sphere3:
        """Center and half the diagonal."""
        return np.asarray(self.center), float(np.linalg.norm(self._half()))

    def area(self) -> float:
        """Surface area (m²)."""
        x, y, z = self.size
        return 2 * (x * y + y * z + z * x)

    def sample_surface(self, n: int, rng: np.random.Generator) -> Points:
        """Uniform points on the six faces."""
        half = self._half()
        face_areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
        axes = rng.choice(3, size=n, p=face_areas / face_areas.sum())
        local = rng.uniform(-1.0, 1.0, (n, 3)) * half
        local[np.arange(n), axes] = rng.choice([-1.0, 1.0], n) * half[axes]
        return local @ self._rotation_world_box().T + np.asarray(self.center)


class RoomShell(Box):
    """Walls, floor and ceiling: the solid is everything outside a cuboid, normals point inwards."""

    def sdf(self, points: Points) -> Values:
        """Exact signed distance (m), positive inside the room."""
        return -super().sdf(points)

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Ray parameter at which a ray from inside reaches the wall; inf when it starts outside."""
        near, far = self._crossing(origins, directions)
        return np.where((near <= 0.0) & (far > 0.0), far, np.inf)

    def normals(self, points: Points) -> Points:
        """Unit normals, into the room, of the nearest wall, floor or ceiling."""
        return -super().normals(points)

    def bounding_sphere(self) -> Sphere3:
        """All of space."""
        return np.asarray(self.center), np.inf


@dataclass(frozen=True)
class Sphere(Solid):
    """A ball."""

    center: Vector3
    radius: float

    def sdf(self, points: Points) -> Values:
        """Exact signed distance (m)."""
        offset = points - np.asarray(self.center)
        return np.sqrt(row_dot(offset, offset)) - self.radius

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        return _round_interval(origins - np.asarray(self.center), directions, self.radius)

    def normals(self, points: Points) -> Points:
        """Unit radial directions."""
        return (points - np.asarray(self.center)) / self.radius

    def bounding_sphere(self) -> Sphere3:
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

    def _frame(self) -> tuple[Array3, Array3, float]:
        start, end = np.asarray(self.start), np.asarray(self.end)
        length = float(np.linalg.norm(end - start))
        return (start + end) / 2, (end - start) / length, length / 2

    def _excess(self, points: Points) -> tuple[Float[np.ndarray, "n 2"], Points, Values]:
        center, axis, half = self._frame()
        axial = (points - center) @ axis
        radial = points - center - axial[:, None] * axis
        sideways = np.sqrt(row_dot(radial, radial)) - self.radius
        return np.stack([sideways, np.abs(axial) - half], axis=1), radial, axial

    def sdf(self, points: Points) -> Values:
        """Exact signed distance (m): a rectangle's, in the plane of radius and axis."""
        return _box_distance(self._excess(points)[0])

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        center, axis, half = self._frame()
        offset_along, slope_along = (origins - center) @ axis, directions @ axis
        offset_side = origins - center - offset_along[..., None] * axis
        slope_side = directions - slope_along[:, None] * axis
        side = _round_interval(offset_side, slope_side, self.radius)
        caps = _slab_interval(offset_along[..., None], slope_along[:, None], np.array([half]))
        return np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])

    def normals(self, points: Points) -> Points:
        """Unit normals of the side or the cap, whichever lies nearer."""
        _, axis, _ = self._frame()
        excess, radial, axial = self._excess(points)
        lengths = np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-12)
        cap = np.where(axial < 0, -1.0, 1.0)[:, None] * axis
        return np.where((excess[:, 1] > excess[:, 0])[:, None], cap, radial / lengths)

    def bounding_sphere(self) -> Sphere3:
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
