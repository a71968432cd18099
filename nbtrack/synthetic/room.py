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
# Rooms whose numbers are reported, each with one kind of difficulty. The other rooms served to
# choose settings, so that their numbers would be too good.
REPORTED_ROOMS: tuple[str, ...] = tuple(n for n in ROOMS if not _TABLES[n].get("tuning", False))


@dataclass(frozen=True)
class Walk:
    """Where cameras go in a room, for each motion of `make.MOTIONS`."""

    center: Pair  # of a hand-held camera's ellipse, x and z (m)
    # Key poses of an animated camera, for paths of 240 and of 300 frames: rows of x, y, z (m),
    # pitch, yaw, roll (rad) and the frame number.
    keys: tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, ...], ...]]
    stops: tuple[Pair, ...]  # places that a tour passes, x and z (m)
    start_yaw: float = 0.0  # rad; a hand-held camera starts along -z at 0, left of that if positive
    turn: int = 1  # the direction in which it turns: +1 is left, -1 right
    pitch: float = -0.3  # rad; mean tilt of hand-held cameras and tours, negative looks down


@dataclass(frozen=True)
class Room:
    """A room: a shell with furniture. World frame: metres, y up, floor at y = 0."""

    name: str
    parts: tuple[Part, ...]  # the first is the `RoomShell`
    light: Light
    walk: Walk

    @property
    def number(self) -> int:
        """A number made from the name, so that one seed gives another path in every room."""
        return zlib.crc32(self.name.encode())

    def sdf(self, points: Points, limit: float = np.inf) -> Values:
        """Signed distance (m) to the nearest surface: positive in free space, negative in solids.

        It is exact in free space, and in a solid that touches no other. Where solids touch or
        overlap, as a leg and its table top, the true depth below the surface may be larger.
        Distances above `limit` (m) are returned as `limit`. A small limit is fast, since solids
        whose bounding sphere is farther away are left out.
        """
        distance = np.full(len(points), limit)
        for part in self.parts:
            offsets = points - part.solid.center
            near = np.flatnonzero(row_dot(offsets, offsets) < (part.solid.reach + limit) ** 2)
            distance[near] = np.minimum(distance[near], part.solid.sdf(points[near]))
        return distance

    def first_hit(self, origins: Origins, directions: Points) -> tuple[Values, Indices]:
        """The first surface that each ray hits: its ray parameter and its index in `parts`.

        Rays start in free space. If a ray hits nothing, its parameter is infinity and its index 0.
        """
        t = np.full(len(directions), np.inf)
        index = np.zeros(len(directions), dtype=np.int64)
        lengths = np.sqrt(row_dot(directions, directions))
        for number, part in enumerate(self.parts):
            towards = part.solid.center - origins
            # The squared distance (m²) of each ray's line from the center. Only lines through the
            # bounding sphere may meet the solid. The sphere is slightly enlarged, so that rounding
            # drops no ray that grazes it.
            squared = row_dot(towards, towards) - (row_dot(directions, towards) / lengths) ** 2
            rays = np.flatnonzero(squared < (part.solid.reach * 1.001) ** 2)
            starts = origins if origins.ndim == 1 else origins[rays]
            candidate = part.solid.hit(starts, directions[rays])
            closer = candidate < t[rays]
            t[rays[closer]] = candidate[closer]
            index[rays[closer]] = number
        return t, index

    def cast(self, origin: Array3, directions: Points) -> tuple[Values, Points, Indices]:
        """What is seen along rays: ray parameter, shaded RGB in [0, 1], and index in `parts`.

        Directions may have any length; if they have z = 1 in the camera frame, the parameter is the
        z-depth (m).
        """
        t, index = self.first_hit(origin, directions)
        points = origin + t[:, None] * directions
        albedo, normals = np.empty_like(points), np.empty_like(points)
        for number in np.unique(index):
            part = self.parts[number]
            chosen = np.flatnonzero(index == number)
            normals[chosen] = part.solid.normals(points[chosen])
            albedo[chosen] = part.material(points[chosen])
        # A point lifted off by the radius is nearer than that to another surface only in corners.
        lifted = points + _OPENNESS_RADIUS * normals
        openness = np.maximum(self.sdf(lifted, _OPENNESS_RADIUS), 0.0) / _OPENNESS_RADIUS
        return t, self.light.shade(albedo, points, normals, openness), index


def description(name: str) -> dict[str, Any]:
    """What `rooms.toml` and `paths.toml` hold for a room, as one dictionary.

    Raises ConfigError, which suggests the most similar name, for an unknown room.
    """
    table = look_up("synthetic room", name, _TABLES)
    walk = table["walk"] | _PATHS[name]
    return {**table, "walk": walk, "materials": _PALETTE | table["materials"]}


@cache
def build_room(name: str) -> Room:
    """The synthetic room of a name. Raises ConfigError for an unknown one."""
    table = description(name)
    named: dict[str, Material] = {}  # a material may refer to the names of earlier ones
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
    """A value of `rooms.toml` with lists turned into tuples, and materials into functions.

    A text is the name of a material and is looked up in `named`. A table with a `kind` is a new
    material: its other entries become arguments of that function of `materials`.
    """
    if isinstance(value, str):
        return named[value]
    if isinstance(value, list):
        return tuple(_resolved(item, named) for item in value)
    if not isinstance(value, dict):
        return value
    options = {key: _resolved(item, named) for key, item in value.items() if key != "kind"}
    return partial(getattr(materials, value["kind"]), **options) if "kind" in value else options
