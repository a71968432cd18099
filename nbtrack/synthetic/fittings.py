"""What is built into a room: windows, doors, walls with an opening, stairs, banisters, lattices.

Places are given as (x, z) in metres on the floor; `along_x` says that a piece runs along the
world's x axis (else along z).
"""

import numpy as np

from nbtrack.synthetic.closed_forms import Vector3
from nbtrack.synthetic.furniture import Place, Size, block
from nbtrack.synthetic.materials import Material
from nbtrack.synthetic.primitives import Cylinder
from nbtrack.synthetic.room import Part


def window(
    wall: float,
    along: float,
    size: tuple[float, float],
    on_x: bool,
    frame: Material,
    pane: Material,
    sill: float = 1.0,
) -> list[Part]:
    """Frame and pane in a wall at coordinate `wall` of z (`on_x`: of x), `sill` m up."""
    width, height = size
    parts = []
    for edge, thickness, material in ((0.0, 0.05, frame), (0.14, 0.07, pane)):
        long, tall = width - edge, height - edge
        place = (wall, along) if on_x else (along, wall)
        edges = (thickness, tall, long) if on_x else (long, tall, thickness)
        parts.append(block(place, edges, material, sill + edge / 2))
    return parts


def door(
    wall: float, along: float, on_x: bool, frame: Material, leaf: Material, handle: Material
) -> list[Part]:
    """Frame, leaf and handle of a closed door in a wall, as `window` places one; three solids."""
    parts = []
    for width, height, thickness, material in ((0.98, 2.06, 0.05, frame), (0.82, 1.98, 0.08, leaf)):
        edges = (thickness, height, width) if on_x else (width, height, thickness)
        parts.append(block((wall, along) if on_x else (along, wall), edges, material))
    place = (wall, along + 0.33) if on_x else (along + 0.33, wall)
    parts.append(block(place, (0.16, 0.03, 0.1) if on_x else (0.1, 0.03, 0.16), handle, 1.02))
    return parts


def wall_with_doorway(
    z: float, span: float, height: float, doorway: Size, material: Material
) -> list[Part]:
    """A wall across a room (along x) at `z`, with an opening; two sides and a lintel.

    Args:
        span: width (m) of the room, which is centered on x = 0.
        doorway: middle of the opening on x, its width and its height (m).
    """
    middle, width, top = doorway
    thickness = 0.12
    parts = []
    for start, end in ((-span / 2, middle - width / 2), (middle + width / 2, span / 2)):
        parts.append(block(((start + end) / 2, z), (end - start, height, thickness), material))
    parts.append(block((middle, z), (width, height - top, thickness), material, top))
    return parts


def staircase(
    start: Place,
    towards: Place,
    n_steps: int,
    step: Size,
    material: Material,
    bottom: float = 0.0,
    thickness: float | None = None,
) -> list[Part]:
    """Steps that rise along an axis of the floor, one solid each.

    Args:
        start: middle of the lower edge of the first step.
        towards: (x, z) unit vector, along x or z.
        step: width across the way up, rise and run (m).
        bottom: height (m) at which the first step begins.
        thickness: of each step below its top (m); None makes them reach down to the floor.
    """
    width, rise, run = step
    parts = []
    for number in range(n_steps):
        ahead = (number + 0.5) * run
        place = (start[0] + towards[0] * ahead, start[1] + towards[1] * ahead)
        top = bottom + (number + 1) * rise
        tall = top if thickness is None else thickness
        edges = (run, tall, width) if towards[0] else (width, tall, run)
        parts.append(block(place, edges, material, top - tall))
    return parts


def banister(
    first: Vector3, last: Vector3, n_posts: int, posts: Material, rail: Material
) -> list[Part]:
    """Thin posts that stand at even distances between two feet, and a rail over their heads."""
    height, beyond = 0.9, 0.06
    feet = np.linspace(first, last, n_posts)
    heads = feet + np.array([0.0, height, 0.0])
    parts = [
        Part(Cylinder(tuple(foot.tolist()), tuple(head.tolist()), 0.018), posts)
        for foot, head in zip(feet, heads, strict=True)
    ]
    overhang = beyond * (heads[-1] - heads[0]) / np.linalg.norm(heads[-1] - heads[0])
    ends = (heads[0] - overhang, heads[-1] + overhang)
    low, high = (tuple(end.tolist()) for end in ends)
    return [*parts, Part(Cylinder(low, high, 0.032), rail)]


def lattice(
    center: Vector3,
    size: tuple[float, float],
    n_rods: tuple[int, int],
    radius: float,
    along_x: bool,
    material: Material,
) -> list[Part]:
    """An upright grid of rods around a center.

    Args:
        size: width and height (m).
        n_rods: upright and level ones.
    """
    right = np.array([1.0, 0.0, 0.0] if along_x else [0.0, 0.0, 1.0])
    up = np.array([0.0, 1.0, 0.0])
    parts = []
    for n, along, across, length, spread in (
        (n_rods[0], up, right, size[1], size[0]),
        (n_rods[1], right, up, size[0], size[1]),
    ):
        # The outermost rods stand a little inside, as the ends of the others stick out.
        for offset in np.linspace(-0.46, 0.46, n) * spread:
            middle = np.asarray(center) + offset * across
            start, end = middle - along * length / 2, middle + along * length / 2
            parts.append(
                Part(Cylinder(tuple(start.tolist()), tuple(end.tolist()), radius), material)
            )
    return parts
