"""Furniture and fittings made of a few solids each, as `rooms.toml` names them.

Places are (x, z) in metres on the floor; sizes are (x, y, z) or (width, height, depth). What is in
a wall is given by the wall's `axis`, 0 for one across x and 2 for one across z, and a `spot`: the
wall's coordinate on that axis and the place along it. Yaw turns as `Box.yaw` does.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np

from nbtrack.synthetic.materials import Colors3, Material, Pair, Part, framed
from nbtrack.synthetic.primitives import Array3, Box, Cylinder, Sphere, Vector3

Size = Vector3
Parts = Iterator[Part]
End = Vector3 | Array3
_CORNERS = ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))


def block(
    place: Pair, size: Size, material: Material, bottom: float = 0.0, yaw: float = 0.0
) -> Part:
    """A box whose lower face is centered at `place`, `bottom` metres above the floor."""
    return Part(Box((place[0], bottom + size[1] / 2, place[1]), size, yaw), material)


def column(
    place: Pair, radius: float, height: float, material: Material, bottom: float = 0.0
) -> Part:
    """An upright cylinder that stands `bottom` metres above the floor."""
    x, z = place
    return rod((x, bottom, z), (x, bottom + height, z), radius, material)


def ball(place: Pair, height: float, radius: float, material: Material) -> Part:
    """A sphere with its center `height` metres above the floor."""
    return Part(Sphere((place[0], height, place[1]), radius), material)


def rod(start: End, end: End, radius: float, material: Material) -> Part:
    """A cylinder in any direction."""
    return Part(Cylinder(tuple(map(float, start)), tuple(map(float, end)), radius), material)


def _turned(place: Pair, across: float, along: float, yaw: float) -> Pair:
    """Place at an offset in a piece's own axes (x, z)."""
    cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
    return place[0] + cosine * across + sine * along, place[1] - sine * across + cosine * along


def table(
    place: Pair, size: Size, top: Material, legs: Material, leg_radius: float = 0.03
) -> Parts:
    """A slab of 4 cm on four round legs."""
    (x, z), (width, height, depth), inset = place, size, leg_radius + 0.03
    yield block(place, (width, 0.04, depth), top, height - 0.04)
    for across, along in _CORNERS:
        foot = (x + across * (width / 2 - inset), z + along * (depth / 2 - inset))
        yield column(foot, leg_radius, height - 0.04, legs)


def chair(place: Pair, yaw: float, cloth: Material, metal: Material) -> Parts:
    """Seat, back and four thin, slightly splayed legs. It faces its own -z."""
    yield block(place, (0.44, 0.06, 0.42), cloth, 0.43, yaw)
    yield block(_turned(place, 0.0, 0.21, yaw), (0.42, 0.42, 0.04), cloth, 0.52, yaw)
    for across, along in _CORNERS:
        foot = _turned(place, 0.23 * across, 0.22 * along, yaw)
        head = _turned(place, 0.17 * across, 0.16 * along, yaw)
        yield rod((foot[0], 0.0, foot[1]), (head[0], 0.44, head[1]), 0.016, metal)


def wire_stool(place: Pair, height: float, seat: Material, metal: Material) -> Parts:
    """A round seat on four splayed legs of thick wire."""
    x, z = place
    yield column(place, 0.17, 0.035, seat, height - 0.035)
    for across, along in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        head = (x + 0.11 * across, height - 0.02, z + 0.11 * along)
        yield rod((x + 0.2 * across, 0.0, z + 0.2 * along), head, 0.01, metal)


def sofa(place: Pair, width: float, cloth: Material, pillow: Material) -> Parts:
    """Base, back, two arms and two tilted pillows; it stands at a wall behind it (-z)."""
    x, z = place
    yield block((x, z), (width, 0.42, 0.8), cloth)
    yield block((x, z - 0.33), (width, 0.38, 0.2), cloth, 0.42)
    yield block((x - width / 2 + 0.09, z), (0.18, 0.2, 0.8), cloth, 0.42)
    yield block((x + width / 2 - 0.09, z), (0.18, 0.2, 0.8), cloth, 0.42)
    yield block((x - (width / 2 - 0.42), z - 0.12), (0.4, 0.34, 0.13), pillow, 0.42, 0.35)
    yield block((x + (width / 2 - 0.42), z - 0.12), (0.4, 0.34, 0.13), pillow, 0.42, -0.25)


def armchair(place: Pair, yaw: float, seat: Material, frame: Material) -> Parts:
    """Seat, back and two arms. It faces its own +z."""
    yield block(place, (0.8 - 0.32, 0.42, 0.7), seat, 0.0, yaw)
    yield block(_turned(place, 0.0, -0.38, yaw), (0.8, 0.82, 0.16), frame, 0.0, yaw)
    for across in (-0.32, 0.32):
        yield block(_turned(place, across, 0.03, yaw), (0.16, 0.58, 0.66), frame, 0.0, yaw)


def floor_lamp(place: Pair, height: float, metal: Material, shade: Material) -> Parts:
    """Foot, pole and shade."""
    yield column(place, 0.14, 0.03, metal)
    yield column(place, 0.015, height - 0.2, metal)
    yield column(place, 0.19, 0.28, shade, height - 0.28)


def bookcase(place: Pair, size: Size, wood: Material, books: tuple[Material, ...]) -> Parts:
    """A closed body; a row of books per material stands out on its long side to the middle."""
    (x, z), (width, height, depth) = place, size
    pitch = height / len(books)
    if width >= depth:
        front, row = (x, float(z - np.sign(z) * 0.03)), (width - 0.12, pitch * 0.68, depth)
    else:
        front, row = (float(x - np.sign(x) * 0.03), z), (width, pitch * 0.68, depth - 0.12)
    yield block(place, size, wood)
    for level, kind in enumerate(books):
        yield block(front, row, kind, level * pitch + 0.06)


def _in_wall(axis: int, spot: Pair, size: Size, material: Material, bottom: float = 0.0) -> Part:
    """A block; its size is width, height and thickness."""
    if axis == 0:
        return block(spot, size[::-1], material, bottom)
    return block(spot[::-1], size, material, bottom)


def picture(axis: int, center: Vector3, size: Pair, colors: Colors3, seed: int) -> Part:
    """A picture of 3 cm thickness on a wall; colors of its frame and of the two within."""
    width, height = size
    edges = (0.03, height, width) if axis == 0 else (width, height, 0.03)
    image = partial(framed, center=center, size=size, axis=axis, colors=colors, seed=seed)
    return Part(Box(center, edges), image)


def window(
    axis: int, spot: Pair, size: Pair, frame: Material, pane: Material, sill: float = 1.0
) -> Parts:
    """Frame and pane, `sill` metres up; size is width and height."""
    width, height = size
    yield _in_wall(axis, spot, (width, height, 0.05), frame, sill)
    yield _in_wall(axis, spot, (width - 0.14, height - 0.14, 0.07), pane, sill + 0.07)


def door(axis: int, spot: Pair, frame: Material, leaf: Material, handle: Material) -> Parts:
    """Frame, leaf and handle of a closed door."""
    yield _in_wall(axis, spot, (0.98, 2.06, 0.05), frame)
    yield _in_wall(axis, spot, (0.82, 1.98, 0.08), leaf)
    yield _in_wall(axis, (spot[0], spot[1] + 0.33), (0.1, 0.03, 0.16), handle, 1.02)


def staircase(
    axis: int, spot: Pair, n_steps: int, step: Size, material: Material, bottom: float = 0.0
) -> Parts:
    """Steps that rise along `axis` from a spot and a height, one solid each.

    `step` is width, rise and run; a negative run leads towards smaller coordinates. Steps reach
    down to the floor; those of a flight that begins higher are 0.3 m thick.
    """
    width, rise, run = step
    for number in range(n_steps):
        top = bottom + (number + 1) * rise
        tall = 0.3 if bottom else top
        middle = (spot[0] + (number + 0.5) * run, spot[1])
        yield _in_wall(axis, middle, (width, tall, abs(run)), material, top - tall)


def banister(first: Vector3, last: Vector3, n_posts: int, posts: Material, rail: Material) -> Parts:
    """Thin posts that stand at even distances between two feet, and a rail over their heads."""
    feet = np.linspace(first, last, n_posts)
    heads = feet + np.array([0.0, 0.9, 0.0])
    for foot, head in zip(feet, heads, strict=True):
        yield rod(foot, head, 0.018, posts)
    overhang = 0.06 * (heads[-1] - heads[0]) / np.linalg.norm(heads[-1] - heads[0])
    yield rod(heads[0] - overhang, heads[-1] + overhang, 0.032, rail)


def lattice(
    axis: int, center: Vector3, size: Pair, rods: tuple[int, int], radius: float, material: Material
) -> Parts:
    """An upright grid around a center: width and height; numbers of upright and of level rods."""
    right, up = np.eye(3)[2 - axis], np.eye(3)[1]
    upright, level = (rods[0], up, right, *size[::-1]), (rods[1], right, up, *size)
    for n, along, across, length, spread in (upright, level):
        # The outermost rods stand a little inside, as the ends of the others stick out.
        for offset in np.linspace(-0.46, 0.46, n) * spread:
            middle, reach = np.asarray(center) + offset * across, along * length / 2
            yield rod(middle - reach, middle + reach, radius, material)
