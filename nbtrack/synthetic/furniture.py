"""Pieces of furniture made of a few solids each. Every function returns parts to put in a room.

Places are given as (x, z) in metres on the floor; sizes as (x, y, z) or (width, height, depth).
"""

import numpy as np

from nbtrack.synthetic.materials import Color, Material, Picture
from nbtrack.synthetic.primitives import Box, Cylinder, Sphere
from nbtrack.synthetic.room import Part

Place = tuple[float, float]
Size = tuple[float, float, float]


def block(
    place: Place, size: Size, material: Material, bottom: float = 0.0, yaw: float = 0.0
) -> Part:
    """A box whose lower face is centered at `place`, `bottom` metres above the floor."""
    return Part(Box((place[0], bottom + size[1] / 2, place[1]), size, yaw), material)


def column(
    place: Place, radius: float, height: float, material: Material, bottom: float = 0.0
) -> Part:
    """An upright cylinder that stands `bottom` metres above the floor."""
    x, z = place
    return Part(Cylinder((x, bottom, z), (x, bottom + height, z), radius), material)


def ball(place: Place, height: float, radius: float, material: Material) -> Part:
    """A sphere with its center `height` metres above the floor."""
    return Part(Sphere((place[0], height, place[1]), radius), material)


def _turned(place: Place, across: float, along: float, yaw: float) -> Place:
    """Place at an offset in a piece's own axes (x, z), turned as `Box.yaw` turns."""
    cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
    return (
        place[0] + cosine * across + sine * along,
        place[1] - sine * across + cosine * along,
    )


def table(
    place: Place,
    size: Size,
    top: Material,
    legs: Material,
    leg_radius: float = 0.03,
    yaw: float = 0.0,
) -> list[Part]:
    """A slab of 4 cm on four round legs; five solids."""
    width, height, depth = size
    inset = leg_radius + 0.03
    parts = [block(place, (width, 0.04, depth), top, height - 0.04, yaw)]
    for across in (-width / 2 + inset, width / 2 - inset):
        for along in (-depth / 2 + inset, depth / 2 - inset):
            foot = _turned(place, across, along, yaw)
            parts.append(column(foot, leg_radius, height - 0.04, legs))
    return parts


def chair(place: Place, yaw: float, cloth: Material, metal: Material) -> list[Part]:
    """Seat, back and four thin, slightly splayed legs; six solids. It faces its own -z."""
    parts = [block(place, (0.44, 0.06, 0.42), cloth, 0.43, yaw)]
    behind = _turned(place, 0.0, 0.21, yaw)
    parts.append(block(behind, (0.42, 0.42, 0.04), cloth, 0.52, yaw))
    for across in (-1.0, 1.0):
        for along in (-1.0, 1.0):
            foot = _turned(place, 0.23 * across, 0.22 * along, yaw)
            head = _turned(place, 0.17 * across, 0.16 * along, yaw)
            rod = Cylinder((foot[0], 0.0, foot[1]), (head[0], 0.44, head[1]), 0.016)
            parts.append(Part(rod, metal))
    return parts


def wire_stool(place: Place, height: float, seat: Material, metal: Material) -> list[Part]:
    """A round seat on four splayed legs of thick wire; five solids."""
    x, z = place
    parts = [column(place, 0.17, 0.035, seat, height - 0.035)]
    for across, along in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        foot = (x + 0.2 * across, 0.0, z + 0.2 * along)
        head = (x + 0.11 * across, height - 0.02, z + 0.11 * along)
        parts.append(Part(Cylinder(foot, head, 0.01), metal))
    return parts


def sofa(place: Place, width: float, cloth: Material, pillow: Material) -> list[Part]:
    """Base, back, two arms and two tilted pillows; it stands at a wall behind it (-z)."""
    x, z = place
    parts = [
        block((x, z), (width, 0.42, 0.8), cloth),
        block((x, z - 0.33), (width, 0.38, 0.2), cloth, 0.42),
        block((x - width / 2 + 0.09, z), (0.18, 0.2, 0.8), cloth, 0.42),
        block((x + width / 2 - 0.09, z), (0.18, 0.2, 0.8), cloth, 0.42),
    ]
    for side, yaw in ((-1.0, 0.35), (1.0, -0.25)):
        spot = (x + side * (width / 2 - 0.42), z - 0.12)
        parts.append(block(spot, (0.4, 0.34, 0.13), pillow, 0.42, yaw))
    return parts


def armchair(
    place: Place, yaw: float, seat: Material, frame: Material, width: float = 0.8
) -> list[Part]:
    """Seat, back and two arms; four solids. It faces its own +z."""
    parts = [block(place, (width - 0.32, 0.42, 0.7), seat, 0.0, yaw)]
    parts.append(block(_turned(place, 0.0, -0.38, yaw), (width, 0.82, 0.16), frame, 0.0, yaw))
    for side in (-1.0, 1.0):
        spot = _turned(place, side * (width / 2 - 0.08), 0.03, yaw)
        parts.append(block(spot, (0.16, 0.58, 0.66), frame, 0.0, yaw))
    return parts


def floor_lamp(place: Place, height: float, metal: Material, shade: Material) -> list[Part]:
    """Foot, pole and shade; three solids."""
    return [
        column(place, 0.14, 0.03, metal),
        column(place, 0.015, height - 0.2, metal),
        column(place, 0.19, 0.28, shade, height - 0.28),
    ]


def bookcase(place: Place, size: Size, wood: Material, books: list[Material]) -> list[Part]:
    """A closed body with one row of books per material standing out of its front (+z or +x).

    The front is the side of the longer horizontal edge that looks to the room's middle.
    """
    x, z = place
    width, height, depth = size
    parts = [block(place, size, wood)]
    pitch = height / len(books)
    wide = width >= depth
    for level, material in enumerate(books):
        if wide:
            spot = (x, z - np.sign(z) * 0.03)
            row = (width - 0.12, pitch * 0.68, depth)
        else:
            spot = (x - np.sign(x) * 0.03, z)
            row = (width, pitch * 0.68, depth - 0.12)
        spot = (float(spot[0]), float(spot[1]))
        parts.append(block(spot, row, material, level * pitch + 0.06))
    return parts


def picture(
    center: tuple[float, float, float],
    size: tuple[float, float],
    along_x: bool,
    colors: tuple[Color, Color, Color],
    seed: int = 0,
) -> Part:
    """A framed picture of 3 cm thickness on a wall.

    Args:
        along_x: the wall runs along x (else along z).
        colors: of the frame and of the two in the picture.
    """
    right = (1.0, 0.0, 0.0) if along_x else (0.0, 0.0, 1.0)
    frame, first, second = colors
    thickness = 0.03
    edges = (size[0], size[1], thickness) if along_x else (thickness, size[1], size[0])
    return Part(Box(center, edges), Picture(center, size, right, frame, first, second, seed=seed))
