"""What surfaces look like: albedo as a smooth function of world position, and the room's light.

A material is a function that takes points on a surface (m, world frame; (n, 3)) and returns the
reflectance there (RGB in [0, 1]; (n, 3)). `functools.partial` fixes its other arguments. Periods,
wavelengths and sizes are in metres.

Patterns have wavelengths of 0.2 m and more, so that small images do not alias and a small network
can learn them. No color depends on the viewing direction, since no field of this package does. All
numbers are our choice.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nbtrack.synthetic.primitives import Box, Points, Solid, Values, Vector3, row_dot

Pair = tuple[float, float]  # x and z of a place, or width and height (m)
Color = tuple[float, float, float]
Material = Callable[[Points], Points]


@dataclass(frozen=True)
class Part:
    """A solid and its material."""

    solid: Solid
    material: Material


def _smooth_noise(points: Points, wavelength: float, seed: int) -> Values:
    """A smooth random value at each point, in [-2, 2] with a standard deviation of about 0.6.

    It is the sum of five sines, divided by 2.5. They have random directions and phases, and
    wavelengths of 1 to 2.4 times `wavelength` (m).
    """
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    lengths = wavelength * np.array([1.0, 1.2, 1.5, 1.9, 2.4])
    waves = points @ (2 * np.pi * vectors / lengths[:, None]).T
    return np.sin(waves + rng.uniform(0, 2 * np.pi, 5)).sum(axis=1) / 2.5


def _squared(wave: Values, softness: float = 0.04) -> Values:
    """A square wave with values in [0, 1] and rounded edges, from a wave that oscillates about 0.

    The edges are rounded since a smooth field would ring at hard ones. The larger `softness`, which
    is added to the squared wave, the rounder they are.
    """
    return 0.5 + 0.5 * wave / np.sqrt(wave * wave + softness)


def _mix(first: Color, second: Color, amount: Values) -> Points:
    """Colors interpolated between two: the first at an amount of 0, the second at 1."""
    return np.asarray(first) + amount[:, None] * (np.asarray(second) - np.asarray(first))


def plain(
    points: Points, color: Color, variation: float = 0.08, wavelength: float = 0.45, seed: int = 0
) -> Points:
    """One color whose brightness varies a little, as that of paint, cloth or plaster.

    The color is changed by up to twice `variation`, relative to it; the standard deviation of the
    change is about 0.6 times `variation`.
    """
    return np.asarray(color) * (1.0 + variation * _smooth_noise(points, wavelength, seed))[:, None]


def checker(
    points: Points, first: Color, second: Color, period: float, axes: tuple[int, int] = (0, 2)
) -> Points:
    """A checkerboard of two colors with rounded squares along two world axes.

    A period holds two squares.
    """
    phases = 2 * np.pi / period * points[:, axes]
    product = np.sin(phases[:, 0] + 0.7) * np.sin(phases[:, 1] + 0.4)
    return _mix(first, second, _squared(product, softness=0.02))


def stripes(
    points: Points, first: Color, second: Color, period: float, direction: Vector3 = (1.0, 0.0, 0.0)
) -> Points:
    """Stripes of two colors with soft edges; a period holds two stripes.

    The stripes follow each other along `direction`, a unit vector (world frame).
    """
    phase = 2 * np.pi / period * (points @ np.asarray(direction))
    return _mix(first, second, _squared(np.sin(phase)))


def wood(
    points: Points, light: Color, dark: Color, period: float = 0.3, axis: int = 2, seed: int = 0
) -> Points:
    """Wood whose fibres run across a world axis: along that axis light and dark follow each other.

    Smooth noise bends the fibres.
    """
    bend = _smooth_noise(points, 0.6, seed)
    wave = 0.5 + 0.5 * np.sin(2 * np.pi / period * points[:, axis] + 1.6 * bend)
    return _mix(light, dark, 0.75 * wave + 0.25 * (0.5 + 0.5 * bend))


def colorful(
    points: Points, base: Color, seed: int, spread: float, period: float, axis: int
) -> Points:
    """Many colors side by side along a world axis, as of books or tins in a shelf.

    A channel differs from that of `base` by at most 1.2 times `spread`.
    """
    phase = 2 * np.pi / period * points[:, axis]
    shifts = np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)  # rad
    # Red, green and blue have different periods.
    of_channels = np.sin(phase[:, None] * np.array([1.0, 0.83, 0.64]) + shifts)
    # A part that all channels share: spines of books differ in brightness, too, not in hue alone.
    waves = 0.7 * of_channels + 0.5 * np.sin(1.13 * phase + shifts[0])[:, None]
    return np.clip(np.asarray(base) + spread * waves, 0.05, 1.0)


def patchwork(points: Points, base: Color, period: float, seed: int, spread: float = 0.2) -> Points:
    """Rounded patches in many colors around `base`, as of a quilt, on faces of any direction.

    A channel differs from that of `base` by at most 1.5 times `spread`.
    """
    rng = np.random.default_rng(seed)
    # Rows are world axes; columns are red, green, blue and brightness. All periods differ, so that
    # no two patches near each other look alike.
    angular = 2 * np.pi / (period * rng.uniform(0.8, 1.4, (3, 4)))
    total = np.sin(points[:, :, None] * angular + rng.uniform(0, 2 * np.pi, (3, 4))).sum(axis=1)
    waves = total / np.sqrt(total * total + 0.2)
    # Patches differ in brightness more than in hue.
    return np.clip(np.asarray(base) + spread * (0.6 * waves[:, :3] + 0.9 * waves[:, 3:]), 0.05, 1.0)


def split(points: Points, below: Material, above: Material, axis: int) -> Points:
    """One material where a world coordinate is negative and another where it is positive.

    With it a floor or a wall changes in the middle of a room.
    """
    return np.where(points[:, axis, None] > 0.0, above(points), below(points))


def framed(
    points: Points, center: Vector3, size: Pair, axis: int, colors: tuple[Color, ...], seed: int
) -> Points:
    """A picture on a wall whose normal is x (axis 0) or z (axis 2): soft shapes in a 5 cm frame.

    `size` is its width and height; `colors` are that of the frame and two for the shapes.
    """
    frame, first, second = colors
    offset = np.abs(points - np.asarray(center))
    sideways = 2 - axis  # the horizontal axis in the wall: z if the normal is x, and x if it is z
    # Distance (m) of each point from the picture's border, towards its center.
    inset = np.minimum(size[0] / 2 - offset[:, sideways], size[1] / 2 - offset[:, 1])
    shapes = _mix(first, second, _squared(np.sin(2.5 * _smooth_noise(points, 0.25, seed))))
    return np.where((inset < 0.05)[:, None], np.asarray(frame), shapes)


def lining(
    points: Points, shell: Box, floor: Material, ceiling: Material, sides: Material, ends: Material
) -> Points:
    """Colors of a room's shell. `sides` are the walls perpendicular to x, `ends` those to z."""
    colors = np.empty_like(points)
    x, y, z = shell.normals(points).T  # into the room: up from the floor
    linings = [(y > 0.5, floor), (y < -0.5, ceiling), (abs(x) > 0.5, sides), (abs(z) > 0.5, ends)]
    for is_there, material in linings:
        colors[is_there] = material(points[is_there])
    return colors


@dataclass(frozen=True)
class Light:
    """A room's light: soft lamps, and light from all sides with a little more from above."""

    lamps: tuple[Vector3, ...]  # positions (m, world)
    strength: float = 0.62  # of each lamp, at its own place

    def shade(self, albedo: Points, points: Points, normals: Points, openness: Values) -> Points:
        """RGB in [0, 1] of points (m, world) on matt surfaces with these reflectances and normals.

        Lamps light a surface by Lambert's law, softened so that a surface turned a little away from
        a lamp still gets some of its light. `openness` is 0 in a corner and 1 in the open: a corner
        gets about half of the light from all sides and a little less of the lamps' light. This
        stands in for contact shadows. Source: our choice; it only makes shapes visible.
        """
        # Light from all sides, and what is added where the normal points up.
        energy = (0.34 + 0.14 * (0.5 + 0.5 * normals[:, 1])) * (0.55 + 0.45 * openness)
        for position in self.lamps:
            towards = np.asarray(position) - points
            squared = row_dot(towards, towards)
            cosine = row_dot(towards, normals) / np.sqrt(squared)
            wrapped = np.maximum(cosine + 0.35, 0.0) / 1.35
            falloff = self.strength / (1.0 + squared / 2.6**2)  # half of the strength at 2.6 m
            energy += falloff * wrapped * (0.85 + 0.15 * openness)
        return np.clip(albedo * energy[:, None], 0.0, 1.0)
