"""What surfaces look like: albedo as a smooth function of world position, and the room's light.

A material is a function of points (m, world) on a surface, (n, 3): its reflectance there, RGB in
[0, 1], (n, 3). `functools.partial` fixes its options. Periods, wavelengths and sizes are in
metres, directions unit vectors across the pattern.

Patterns have wavelengths of 0.2 m and more, so that small images do not alias and a small network
can learn them. Nothing depends on the direction of view: the fields of this package have none.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nbtrack.synthetic.primitives import Box, Points, Solid, Values, Vector3, row_dot

Pair = tuple[float, float]  # (x, z) of a place, or width and height
Color = tuple[float, float, float]
Material = Callable[[Points], Points]


@dataclass(frozen=True)
class Part:
    """A solid and what it is made of."""

    solid: Solid
    material: Material


def _smooth_noise(points: Points, wavelength: float, seed: int) -> Values:
    """Five sines in random directions, about in [-1, 1], `wavelength` (m) to 2.4 times as long."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    lengths = wavelength * np.array([1.0, 1.2, 1.5, 1.9, 2.4])
    waves = points @ (2 * np.pi * vectors / lengths[:, None]).T
    return np.sin(waves + rng.uniform(0, 2 * np.pi, 5)).sum(axis=1) / 2.5


def _squared(wave: Values, softness: float = 0.04) -> Values:
    """A wave about 0 made square, in [0, 1], with rounded edges: hard ones ring in a smooth field.

    The larger `softness` (in squares of the wave), the rounder they are.
    """
    return 0.5 + 0.5 * wave / np.sqrt(wave * wave + softness)


def _mix(first: Color, second: Color, amount: Values) -> Points:
    """Colors between two: the first where the amount is 0, the second where it is 1."""
    return np.asarray(first) + amount[:, None] * (np.asarray(second) - np.asarray(first))


def plain(
    points: Points, color: Color, variation: float = 0.08, wavelength: float = 0.45, seed: int = 0
) -> Points:
    """One color with a faint, relative, cloudy variation, as of paint, cloth or plaster."""
    return np.asarray(color) * (1.0 + variation * _smooth_noise(points, wavelength, seed))[:, None]


def checker(
    points: Points, first: Color, second: Color, period: float, axes: tuple[int, int] = (0, 2)
) -> Points:
    """Two colors in rounded squares over two world axes; a period is two squares."""
    phases = 2 * np.pi / period * points[:, axes]
    product = np.sin(phases[:, 0] + 0.7) * np.sin(phases[:, 1] + 0.4)  # phases: our choice
    return _mix(first, second, _squared(product, softness=0.02))


def stripes(
    points: Points, first: Color, second: Color, period: float, direction: Vector3 = (1.0, 0.0, 0.0)
) -> Points:
    """Two colors in rounded stripes; a period is two stripes."""
    phase = 2 * np.pi / period * (points @ np.asarray(direction))
    return _mix(first, second, _squared(np.sin(phase)))


def wood(
    points: Points, light: Color, dark: Color, period: float = 0.3, axis: int = 2, seed: int = 0
) -> Points:
    """Planks with grain across an axis: a slow wave across the fibres, bent by smooth noise."""
    bend = _smooth_noise(points, 0.6, seed)
    wave = 0.5 + 0.5 * np.sin(2 * np.pi / period * points[:, axis] + 1.6 * bend)
    return _mix(light, dark, 0.75 * wave + 0.25 * (0.5 + 0.5 * bend))


def colorful(
    points: Points, base: Color, seed: int, spread: float, period: float, axis: int
) -> Points:
    """Many colors side by side along an axis, up to about `spread` from a base: books, tins."""
    phase = 2 * np.pi / period * points[:, axis]
    shifts = np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)  # rad
    # Red, green and blue have different periods.
    of_channels = np.sin(phase[:, None] * np.array([1.0, 0.83, 0.64]) + shifts)
    # Half of the change is common to all channels: spines differ in brightness, not hue alone.
    waves = 0.7 * of_channels + 0.5 * np.sin(1.13 * phase + shifts[0])[:, None]
    return np.clip(np.asarray(base) + spread * waves, 0.05, 1.0)


def patchwork(points: Points, base: Color, period: float, seed: int, spread: float = 0.2) -> Points:
    """Rounded patches in many colors around a base, on any face: a quilt, a woven carpet."""
    rng = np.random.default_rng(seed)
    # Another period for each axis and channel: no two patches near each other look alike. The
    # channels are three colors and a brightness.
    angular = 2 * np.pi / (period * rng.uniform(0.8, 1.4, (3, 4)))
    total = np.sin(points[:, :, None] * angular + rng.uniform(0, 2 * np.pi, (3, 4))).sum(axis=1)
    waves = total / np.sqrt(total * total + 0.2)
    # Patches differ in brightness more than in hue.
    return np.clip(np.asarray(base) + spread * (0.6 * waves[:, :3] + 0.9 * waves[:, 3:]), 0.05, 1.0)


def split(points: Points, below: Material, above: Material, axis: int) -> Points:
    """A material below 0 of a world axis and one above: paint that ends at a wall."""
    return np.where(points[:, axis, None] > 0.0, above(points), below(points))


def framed(
    points: Points, center: Vector3, size: Pair, axis: int, colors: tuple[Color, ...], seed: int
) -> Points:
    """A picture across `axis`: a frame of the first color, 5 cm wide, around soft shapes in two."""
    frame, first, second = colors
    offset = np.abs(points - np.asarray(center))
    sideways = 2 - axis  # z of a picture across x, x of one across z
    # How far (m) a point lies inside of the picture's border; `size` is width and height.
    inset = np.minimum(size[0] / 2 - offset[:, sideways], size[1] / 2 - offset[:, 1])
    shapes = _mix(first, second, _squared(np.sin(2.5 * _smooth_noise(points, 0.25, seed))))
    return np.where((inset < 0.05)[:, None], np.asarray(frame), shapes)


def lining(
    points: Points, shell: Box, floor: Material, ceiling: Material, sides: Material, ends: Material
) -> Points:
    """Colors of a room's shell; walls perpendicular to x are `sides`, those to z are `ends`."""
    colors = np.empty_like(points)
    x, y, z = shell.normals(points).T  # into the room: up from the floor
    linings = [(y > 0.5, floor), (y < -0.5, ceiling), (abs(x) > 0.5, sides), (abs(z) > 0.5, ends)]
    for is_there, material in linings:
        colors[is_there] = material(points[is_there])
    return colors


@dataclass(frozen=True)
class Light:
    """Soft lamps, light from all sides and a little more from above."""

    lamps: tuple[Vector3, ...]  # positions (m, world)
    strength: float = 0.62  # of each lamp, at its own place

    def shade(self, albedo: Points, points: Points, normals: Points, openness: Values) -> Points:
        """RGB in [0, 1] of a matt surface: Lambert's law, wrapped so that its terminator is soft.

        `openness` is 0 in a corner and 1 in the open: corners have about half of the light from all
        sides and a little less of the lamps', which stands in for contact shadows. Source: our
        choice; it only gives shapes a look.
        """
        # Light from all sides, and what is added where the normal points up.
        energy = (0.34 + 0.14 * (0.5 + 0.5 * normals[:, 1])) * (0.55 + 0.45 * openness)
        for position in self.lamps:
            towards = np.asarray(position) - points
            squared = row_dot(towards, towards)
            cosine = row_dot(towards, normals) / np.sqrt(squared)
            wrapped = np.maximum(cosine + 0.35, 0.0) / 1.35
            falloff = self.strength / (1.0 + squared / 2.6**2)  # at 2.6 m it has halved
            energy += falloff * wrapped * (0.85 + 0.15 * openness)
        return np.clip(albedo * energy[:, None], 0.0, 1.0)
