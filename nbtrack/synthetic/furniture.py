"""What rooms are furnished with, as `rooms.toml` names it: single solids, and pictures on walls.

Places are (x, z) in metres on the floor. A sofa or a chair is a few of these.
"""

from functools import partial

from nbtrack.synthetic.materials import Colors3, Material, Pair, Part, framed
from nbtrack.synthetic.primitives import Box, Cylinder, Sphere, Vector3


def block(
    place: Pair, size: Vector3, material: Material, bottom: float = 0.0, yaw: float = 0.0
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


def rod(start: Vector3, end: Vector3, radius: float, material: Material) -> Part:
    """A cylinder in any direction."""
    return Part(Cylinder(start, end, radius), material)


def picture(axis: int, center: Vector3, size: Pair, colors: Colors3, seed: int) -> Part:
    """A picture of 3 cm thickness on a wall across an axis (0 for x, 2 for z).

    Its size is width and height; its colors those of the frame and of the two within.
    """
    width, height = size
    edges = (0.03, height, width) if axis == 0 else (width, height, 0.03)
    image = partial(framed, center=center, size=size, axis=axis, colors=colors, seed=seed)
    return Part(Box(center, edges), image)
