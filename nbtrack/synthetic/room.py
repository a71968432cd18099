"""A furnished room: exact signed distance, exact ray casting, colors, and points on its surface."""

import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nbtrack.core.errors import NumericalError
from nbtrack.synthetic.closed_forms import Origins, Points, Values, row_dot
from nbtrack.synthetic.materials import Light, Material
from nbtrack.synthetic.primitives import Solid
from nbtrack.synthetic.shell import RoomShell

_OPENNESS_RADIUS = 0.2  # m; how far contact shadows reach (our choice)


@dataclass(frozen=True)
class Part:
    """A solid and what it is made of."""

    solid: Solid
    material: Material


@dataclass(frozen=True)
class Walk:
    """Where a camera may wander: it orbits a point and looks across it (see `motion`).

    With an `end` the point itself wanders between `center` and `end`. Their distance should be
    1.0 to 1.3 m, so that wandering alone stays below the speed of a hand-held camera.
    """

    center: tuple[float, float]  # m; x and z of the orbit's middle
    start_yaw: float = 0.0  # rad; 0 looks along -z, positive turns left
    turn: int = 1  # +1 turns left, -1 right
    pitch: float = -0.3  # rad; mean tilt, negative looks down
    end: tuple[float, float] | None = None  # m; x and z of the orbit's middle half a period later


@dataclass(frozen=True)
class Room:
    """A shell with furniture. World frame: metres, y up, floor at y = 0."""

    name: str
    description: str
    shell: RoomShell
    shell_material: Material
    parts: tuple[Part, ...]
    light: Light
    walk: Walk

    @property
    def number(self) -> int:
        """A number made of the name, so that one seed means another path in every room."""
        return zlib.crc32(self.name.encode())

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner (m) of the room's inside."""
        return np.array([self.shell.lower, self.shell.upper])

    def sdf(self, points_world: Points) -> Values:
        """Signed distance (m) to the nearest surface, positive in free space.

        Exact in free space: the distance to a union of closed bodies is the least of the
        distances to each. Within matter it is negative and exact for a body that stands alone;
        where bodies touch or overlap (a leg let into its table top) the true depth below the
        surface is at least as large.
        """
        distance = self.shell.sdf(points_world)
        for part in self.parts:
            np.minimum(distance, part.solid.sdf(points_world), out=distance)
        return distance

    def sdf_up_to(self, points_world: Points, limit: float) -> Values:
        """`min(sdf, limit)`, fast for small limits: far solids are skipped by bounding spheres."""
        distance = np.minimum(self.shell.sdf(points_world), limit)
        spheres = [part.solid.bounding_sphere() for part in self.parts]
        centers = np.array([center for center, _ in spheres])
        reach = np.array([radius for _, radius in spheres]) + limit
        # |p - c|² < reach² for all pairs by one product; the slack covers its rounding.
        squared = row_dot(points_world, points_world)[:, None] - 2 * points_world @ centers.T
        near = squared < reach**2 - row_dot(centers, centers) + 1e-6
        for part, chosen in zip(self.parts, near.T, strict=True):
            rows = np.flatnonzero(chosen)
            if len(rows):
                distance[rows] = np.minimum(distance[rows], part.solid.sdf(points_world[rows]))
        return distance

    def first_hit(
        self, origins: Origins, directions: Points
    ) -> tuple[Values, Int[np.ndarray, "n"]]:
        """Ray parameter and index of the first surface: 0 the shell, i + 1 `parts[i]`.

        Args:
            origins: (3,) for all rays, or (n, 3); in free space.
            directions: (n, 3), of any length; with z = 1 in the camera the parameter is z-depth.
        """
        t = self.shell.hit(origins, directions)
        index = np.zeros(len(directions), dtype=np.int64)
        lengths = np.sqrt(row_dot(directions, directions))
        for number, part in enumerate(self.parts, start=1):
            rays = _rays_near(part.solid, origins, directions, lengths)
            if len(rays) == 0:
                continue
            from_where = origins if origins.ndim == 1 else origins[rays]
            candidate = part.solid.hit(from_where, directions[rays])
            closer = candidate < t[rays]
            t[rays[closer]] = candidate[closer]
            index[rays[closer]] = number
        return t, index

    def colors(self, points_world: Points, index: Int[np.ndarray, "n"]) -> Points:
        """Shaded RGB in [0, 1] of surface points, given the surface each lies on."""
        albedo, normals = np.empty_like(points_world), np.empty_like(points_world)
        surfaces = [(self.shell, self.shell_material)]
        surfaces += [(part.solid, part.material) for part in self.parts]
        for number in np.unique(index):
            solid, material = surfaces[number]
            chosen = np.flatnonzero(index == number)
            normals[chosen] = solid.normals(points_world[chosen])
            albedo[chosen] = material.albedo(points_world[chosen], normals[chosen])
        lifted = points_world + _OPENNESS_RADIUS * normals
        openness = np.maximum(self.sdf_up_to(lifted, _OPENNESS_RADIUS), 0.0) / _OPENNESS_RADIUS
        return self.light.shade(albedo, points_world, normals, openness)

    def cast(
        self, origins: Origins, directions: Points
    ) -> tuple[Values, Points, Int[np.ndarray, "n"]]:
        """Ray parameter, RGB in [0, 1] and surface index (`first_hit`) seen along rays."""
        t, index = self.first_hit(origins, directions)
        return t, self.colors(origins + t[:, None] * directions, index), index


def _rays_near(
    solid: Solid, origins: Origins, directions: Points, lengths: Values
) -> Int[np.ndarray, "m"]:
    """Rays that may meet the solid; for a shared origin those within its bounding cone."""
    everything = np.arange(len(directions))
    if origins.ndim > 1:
        return everything
    center, radius = solid.bounding_sphere()
    towards = center - origins
    # The tangent's length; slightly short, so that rounding never drops a ray that grazes.
    squared = float(towards @ towards) - (radius * 1.001) ** 2
    if squared <= 0.0:
        return everything
    return np.flatnonzero(directions @ towards >= lengths * np.sqrt(squared))


def true_surface_points(room: Room, n: int, seed: int) -> Points:
    """`n` world points (m), uniform over the surface that borders free space.

    Points are drawn on every solid in proportion to its area and kept where a step of a
    millimetre along the normal leads into free space. That leaves out what stands on the floor,
    hangs on the wall or is let into another body: surface that no camera could ever see.

    Raises:
        NumericalError: nearly no surface borders free space.
    """
    rng = np.random.default_rng(seed)
    kept = np.empty((0, 3))
    for _ in range(20):
        kept = np.concatenate([kept, _exposed_points(room, n, rng)])
        if len(kept) >= n:
            return kept[:n]
    raise NumericalError(
        f"room '{room.name}': only {len(kept)} of {n} surface points border free space; "
        "solids must not fill the shell; check their places"
    )


def _exposed_points(room: Room, n: int, rng: np.random.Generator) -> Points:
    """Draw `n` points over all solids and return, in random order, those that are exposed."""
    step = 1e-3
    solids: list[Solid] = [room.shell, *(part.solid for part in room.parts)]
    areas = np.array([solid.area() for solid in solids])
    counts = rng.multinomial(n, areas / areas.sum())
    drawn = [
        solid.sample_surface(int(count), rng) for solid, count in zip(solids, counts, strict=True)
    ]
    normals = [solid.normals(points) for solid, points in zip(solids, drawn, strict=True)]
    points = np.concatenate(drawn)
    lifted = points + step * np.concatenate(normals)
    # Where two surfaces meet at an angle the step may pass nearer to the other one.
    exposed = (room.sdf(lifted) > step / 4) & (np.abs(room.sdf(points)) < 1e-6)
    return rng.permutation(points[exposed])
