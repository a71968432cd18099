"""Solids with exact signed distance (m) and closed-form ray intersection, in the world frame.

World axes: y up, metres. Distances are positive outside a solid and negative inside it.
"""

from functools import reduce

import numpy as np
from jaxtyping import Float, Int

Vector3 = tuple[float, float, float]
Array3 = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, "n"]
Indices = Int[np.ndarray, "n"]
Vectors = Float[np.ndarray, "... k"]
Origins = Float[np.ndarray, "... 3"]  # one origin for all rays, (3,), or one each, (n, 3)
# Ray parameters (near, far) between which a ray is inside; near > far if it never is.
Interval = tuple[Values, Values]


def row_dot(first: Vectors, second: Vectors) -> Float[np.ndarray, "..."]:
    """Dot products along the last axis; several times as fast as multiply and sum."""
    return np.asarray(np.einsum("...i,...i->...", first, second))


def _slab_interval(origins: Vectors, directions: Vectors, half: Vectors) -> Interval:
    """The interval of ray parameters in which rays have |coordinates| <= half.

    Origins, directions and half the extents are in the box's own coordinates.
    """
    # For a ray parallel to a slab a tiny slope puts both crossings far away; 0 could give 0/0.
    direction = np.where(directions == 0.0, 1e-30, directions)
    first, second = (-half - origins) / direction, (half - origins) / direction
    # The largest or smallest entry of each short row; `max(axis=1)` takes several times as long.
    near = reduce(np.maximum, np.minimum(first, second).T)
    return near, reduce(np.minimum, np.maximum(first, second).T)


def _round_interval(offsets: Origins, directions: Points, radius: float) -> Interval:
    """The interval of t in which |offset + t direction| <= radius.

    It is empty (near = inf, far = -inf) for rays that miss.
    """
    # A ray parallel to a cylinder's axis has a direction of 0 here, where only components
    # perpendicular to the axis are given. It is always inside or never. With a tiny `a` both ends
    # of its interval are far away; 0 would give 0/0.
    a = np.maximum(row_dot(directions, directions), 1e-30)
    b = row_dot(offsets, directions)
    c = row_dot(offsets, offsets) - radius**2
    discriminant = b * b - a * c
    half_width = np.sqrt(np.maximum(discriminant, 0.0)) / a
    half_width[discriminant <= 0.0] = -np.inf  # for rays that miss
    return -b / a - half_width, -b / a + half_width


class Solid:
    """A closed convex body that is a box in its own coordinates.

    A subclass defines three methods. `_coordinates` maps points (m, world) to distances (m) from
    the center or from an axis, in directions perpendicular to each other; a point is inside if none
    of them exceeds its entry in `half`. `_crossing` gives the interval of ray parameters in which a
    line is inside. `normals` gives unit outward normals (world frame) at points on the surface.
    """

    def __init__(self, center: Array3, half: Vectors) -> None:
        """Take the center (m, world) and half the extents in the solid's own coordinates (m)."""
        self.center, self.half = center, half
        self.reach = float(np.linalg.norm(half))  # m; radius of the bounding sphere

    def sdf(self, points: Points) -> Values:
        """Exact signed distance (m) outside (positive) and inside (negative)."""
        excess = self._coordinates(points) - self.half
        beyond = np.maximum(excess, 0.0)  # 0 in all coordinates of a point inside
        largest = reduce(np.maximum, excess.T)  # of each point; faster than `max(axis=1)`
        return np.sqrt(row_dot(beyond, beyond)) + np.minimum(largest, 0.0)

    def hit(self, origins: Origins, directions: Points) -> Values:
        """Ray parameter at which a ray from outside enters the solid; inf for a miss.

        The point of entry is origin + parameter * direction; where directions have z = 1 in the
        camera frame, the parameter is the z-depth. Rays that start inside count as misses, since
        cameras are in free space.
        """
        near, far = self._crossing(origins, directions)
        return np.where((near <= far) & (near > 0.0), near, np.inf)


class Box(Solid):
    """A cuboid that may be turned about the vertical axis."""

    def __init__(self, center: Vector3, size: Vector3, yaw: float = 0.0) -> None:
        """Take full edge lengths (m) along the box's own axes, and a yaw (rad).

        A positive yaw turns it to the left, seen from above.
        """
        super().__init__(np.asarray(center), np.asarray(size) / 2)
        sine, cosine = np.sin(yaw), np.cos(yaw)
        self._axes = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])  # world from box

    def _coordinates(self, points: Points) -> Points:
        return np.abs((points - self.center) @ self._axes)

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        offsets = (origins - self.center) @ self._axes
        return _slab_interval(offsets, directions @ self._axes, self.half)

    def normals(self, points: Points) -> Points:
        """Unit normals of the face nearest to each point."""
        local = (points - self.center) @ self._axes
        axis = (np.abs(local) - self.half).argmax(axis=1)
        normals_local = np.eye(3)[axis] * np.where(local < 0, -1.0, 1.0)
        return normals_local @ self._axes.T


class RoomShell(Box):
    """Walls, floor and ceiling: a solid that is everything outside a cuboid.

    Its normals point into the room.
    """

    def __init__(self, center: Vector3, size: Vector3) -> None:
        """Take the center and the full edge lengths (m) of the cuboid."""
        super().__init__(center, size)
        self.reach = np.inf  # no bounding sphere holds all of space but the room

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


class Sphere(Solid):
    """A ball."""

    def __init__(self, center: Vector3, radius: float) -> None:
        """Take the center (m, world) and the radius (m)."""
        super().__init__(np.asarray(center), np.array([radius]))

    def _coordinates(self, points: Points) -> Float[np.ndarray, "n 1"]:
        offset = points - self.center
        return np.sqrt(row_dot(offset, offset))[:, None]

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        return _round_interval(origins - self.center, directions, self.half[0])

    def normals(self, points: Points) -> Points:
        """Unit radial directions."""
        return (points - self.center) / self.half


class Cylinder(Solid):
    """A cylinder or rod with flat caps, in any direction."""

    def __init__(self, start: Vector3, end: Vector3, radius: float) -> None:
        """Take the centers of both caps (m, world) and the radius (m)."""
        along = np.asarray(end) - start
        length = float(np.linalg.norm(along))
        super().__init__((np.asarray(start) + end) / 2, np.array([radius, length / 2]))
        self._axis = along / length

    def _split(self, vectors: Origins) -> tuple[Float[np.ndarray, "..."], Origins]:
        """Signed lengths of vectors along the axis, and their parts perpendicular to it."""
        along = np.asarray(vectors @ self._axis)
        return along, vectors - along[..., None] * self._axis

    def _coordinates(self, points: Points) -> Float[np.ndarray, "n 2"]:
        """Distances (m) from the axis, and from the center along it."""
        along, across = self._split(points - self.center)
        return np.stack([np.sqrt(row_dot(across, across)), np.abs(along)], axis=1)

    def _crossing(self, origins: Origins, directions: Points) -> Interval:
        offset_along, offset_across = self._split(origins - self.center)
        direction_along, direction_across = self._split(directions)
        near, far = _round_interval(offset_across, direction_across, self.half[0])
        caps = _slab_interval(offset_along[..., None], direction_along[:, None], self.half[1:])
        return np.maximum(near, caps[0]), np.minimum(far, caps[1])

    def normals(self, points: Points) -> Points:
        """Unit normals of the side or of a cap, whichever is nearer to each point."""
        along, across = self._split(points - self.center)
        beyond_side, beyond_cap = (self._coordinates(points) - self.half).T
        # On the axis the length is 0, which would give 0/0.
        lengths = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        of_cap = np.where(along < 0, -1.0, 1.0)[:, None] * self._axis
        return np.where((beyond_cap > beyond_side)[:, None], of_cap, across / lengths)
