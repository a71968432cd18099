"""The furnished rooms of `rooms.toml` and `paths.toml`: exact distance, ray casting, colors."""

import tomllib
import zlib
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nbtrack.machinery.errors import look_up
from nbtrack.synthetic import materials, primitives
from nbtrack.synthetic.materials import Light, Material, Pair, Part
from nbtrack.synthetic.primitives import Array3, Indices, Origins, Points, Values, row_dot

_FOLDER = Path(__file__).parent
_TABLES = tomllib.loads((_FOLDER / "rooms.toml").read_text(encoding="utf-8"))
_PATHS = tomllib.loads((_FOLDER / "paths.toml").read_text(encoding="utf-8"))
_PALETTE = _TABLES.pop("palette")  # all other tables are rooms
_OPENNESS_RADIUS = 0.2  # m; how far contact shadows reach (our choice)

ROOMS: tuple[str, ...] = tuple(_TABLES)
# Rooms whose numbers are reported, each with one kind of difficulty. On the others the settings
# were chosen, so that numbers from there would be too good.
REPORTED_ROOMS: tuple[str, ...] = tuple(n for n in ROOMS if not _TABLES[n].get("tuning", False))


@dataclass(frozen=True)
class Walk:
    """Where cameras go: across the room near a point, turning; and by the paths of `paths.toml`."""

    center: Pair  # m; x and z
    # Key poses of an animated camera, on its short and on its long path; see `paths.toml`.
    keys: tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, ...], ...]]
    stops: tuple[Pair, ...]  # m; x and z; of a tour
    start_yaw: float = 0.0  # rad; 0 walks and looks along -z, positive turns left
    turn: int = 1  # +1 turns left, -1 right
    pitch: float = -0.3  # rad; mean tilt, negative looks down


@dataclass(frozen=True)
class Room:
    """A shell with furniture. World frame: metres, y up, floor at y = 0."""

    name: str
    parts: tuple[Part, ...]  # the first is the `RoomShell`
    light: Light
    walk: Walk

    @property
    def number(self) -> int:
        """A number made of the name, so that one seed means another path in every room."""
        return zlib.crc32(self.name.encode())

    def sdf(self, points: Points, limit: float = np.inf) -> Values:
        """Signed distance (m) to the nearest surface, positive in free space and exact there.

        Within matter it is exact for a body that stands alone; where bodies touch or overlap (a
        leg let into its table top) the true depth below the surface is at least as large. Larger
        distances than the limit are given as the limit. A small one is fast: solids whose bounding
        sphere is farther away are left out.
        """
        distance = np.full(len(points), limit)
        for part in self.parts:
            offsets = points - part.solid.center
            near = np.flatnonzero(row_dot(offsets, offsets) < (part.solid.reach + limit) ** 2)
            distance[near] = np.minimum(distance[near], part.solid.sdf(points[near]))
        return distance

    def first_hit(self, origins: Origins, directions: Points) -> tuple[Values, Indices]:
        """Ray parameter and index in `parts` of the first surface from points in free space.

        Where nothing is hit, they are infinity and 0.
        """
        t = np.full(len(directions), np.inf)
        index = np.zeros(len(directions), dtype=np.int64)
        lengths = np.sqrt(row_dot(directions, directions))
        for number, part in enumerate(self.parts):
            towards = part.solid.center - origins
            # The squared distance (m²) of each line from the center. Only lines through the
            # bounding sphere may meet the solid; the sphere is slightly enlarged, so that rounding
            # never drops a ray that grazes.
            passing = row_dot(towards, towards) - (row_dot(directions, towards) / lengths) ** 2
            rays = np.flatnonzero(passing < (part.solid.reach * 1.001) ** 2)
            starts = origins if origins.ndim == 1 else origins[rays]
            candidate = part.solid.hit(starts, directions[rays])
            closer = candidate < t[rays]
            t[rays[closer]] = candidate[closer]
            index[rays[closer]] = number
        return t, index

    def cast(self, origin: Array3, directions: Points) -> tuple[Values, Points, Indices]:
        """Ray parameter, shaded RGB in [0, 1] and index in `parts` of what is seen along rays.

        Directions may have any length; with z = 1 in the camera the parameter is z-depth.
        """
        t, index = self.first_hit(origin, directions)
        points = origin + t[:, None] * directions
        albedo, normals = np.empty_like(points), np.empty_like(points)
        for number in np.unique(index):
            part = self.parts[number]
            chosen = np.flatnonzero(index == number)
            normals[chosen] = part.solid.normals(points[chosen])
            albedo[chosen] = part.material(points[chosen])
        lifted = points + _OPENNESS_RADIUS * normals
        openness = np.maximum(self.sdf(lifted, _OPENNESS_RADIUS), 0.0) / _OPENNESS_RADIUS
        return t, self.light.shade(albedo, points, normals, openness), index


def description(name: str) -> dict[str, Any]:
    """What `rooms.toml` and `paths.toml` say of a room.

    Raises ConfigError, which names the nearest room, if there is none of that name.
    """
    table = look_up("synthetic room", name, _TABLES)
    walk = table["walk"] | _PATHS[name]
    return {**table, "walk": walk, "materials": _PALETTE | table["materials"]}


@cache
def build_room(name: str) -> Room:
    """The synthetic room of that name. Raises ConfigError as `description` does."""
    table = description(name)
    named: dict[str, Material] = {}  # a material may name one before it
    for label, material in table["materials"].items():
        named[label] = _resolved(material, named)
    width, height, depth = table["size"]
    shell = primitives.RoomShell((0.0, height / 2, 0.0), (width, height, depth))
    lining = partial(materials.lining, shell=shell, **_resolved(table["surfaces"], named))
    parts = [Part(shell, lining)]
    for kind, *arguments in table["parts"]:
        material, *shape = _resolved(arguments, named)
        parts.append(Part(getattr(primitives, kind.capitalize())(*shape), material))
    light = Light(**_resolved(table["light"], named))
    return Room(name, tuple(parts), light, Walk(**_resolved(table["walk"], named)))


def _resolved(value: Any, named: dict[str, Material]) -> Any:
    """A value of the file with its materials made or looked up in `named`, its lists as tuples.

    A table with a `kind` is a material to be made, and a text is the name of one.
    """
    if isinstance(value, list):
        return tuple(_resolved(item, named) for item in value)
    if not isinstance(value, dict):
        return named[value] if isinstance(value, str) else value
    options = {key: _resolved(item, named) for key, item in value.items() if key != "kind"}
    return partial(getattr(materials, value["kind"]), **options) if "kind" in value else options
