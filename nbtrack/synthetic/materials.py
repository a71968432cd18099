"""What surfaces look like: albedo as a smooth function of world position, and the room's light.

Patterns have wavelengths of 0.2 m and more, so that small images do not alias and a small network
can learn them. Nothing depends on the direction of view: the fields of this package have none.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nbtrack.synthetic.closed_forms import Points, Values, Vector3, row_dot

Color = tuple[float, float, float]


class Material(ABC):
    """Diffuse reflectance of a surface."""

    @abstractmethod
    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1] at surface points (m, world) with unit normals."""


@lru_cache(maxsize=256)
def _waves(wavelength: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    lengths = wavelength * np.array([1.0, 1.2, 1.5, 1.9, 2.4])
    return (2 * np.pi * vectors / lengths[:, None]).T, rng.uniform(0, 2 * np.pi, 5)


def smooth_noise(points_world: Points, wavelength: float, seed: int) -> Values:
    """Sum of five sines in fixed random directions, about in [-1, 1].

    Args:
        wavelength: the shortest one (m); the others are up to 2.4 times as long.
    """
    vectors, phases = _waves(wavelength, seed)
    return np.sin(points_world @ vectors + phases).sum(axis=1) / 2.5


def _square_wave(phase: Values) -> Values:
    """A square wave in [0, 1] with rounded edges: a hard edge would ring in any smooth field."""
    sine = np.sin(phase)
    return 0.5 + 0.5 * sine / np.sqrt(sine * sine + 0.04)


def _mix(first: Color, second: Color, amount: Values) -> Points:
    return np.asarray(first) + amount[:, None] * (np.asarray(second) - np.asarray(first))


@dataclass(frozen=True)
class Plain(Material):
    """One color with a faint cloudy variation, as of paint, cloth or plaster."""

    color: Color
    variation: float = 0.08  # relative change of brightness
    wavelength: float = 0.45  # m
    seed: int = 0

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        noise = smooth_noise(points_world, self.wavelength, self.seed)
        return np.asarray(self.color) * (1.0 + self.variation * noise)[:, None]


@dataclass(frozen=True)
class Checker(Material):
    """Two colors in rounded squares over two world axes."""

    first: Color
    second: Color
    period: float  # m, two squares
    axes: tuple[int, int] = (0, 2)

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        angular = 2 * np.pi / self.period
        product = np.sin(angular * points_world[:, self.axes[0]] + 0.7) * np.sin(
            angular * points_world[:, self.axes[1]] + 0.4
        )
        return _mix(self.first, self.second, 0.5 + 0.5 * product / np.sqrt(product**2 + 0.02))


@dataclass(frozen=True)
class Stripes(Material):
    """Two colors in rounded stripes, perpendicular to a direction."""

    first: Color
    second: Color
    period: float  # m
    direction: Vector3 = (1.0, 0.0, 0.0)  # unit vector across the stripes

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        phase = 2 * np.pi / self.period * (points_world @ np.asarray(self.direction))
        return _mix(self.first, self.second, _square_wave(phase))


@dataclass(frozen=True)
class Wood(Material):
    """Planks with grain: a slow wave across the fibres, bent by smooth noise."""

    light: Color
    dark: Color
    period: float = 0.3  # m, across the grain
    direction: Vector3 = (0.0, 0.0, 1.0)  # unit vector across the grain
    seed: int = 0

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        across = points_world @ np.asarray(self.direction)
        bend = smooth_noise(points_world, 0.6, self.seed)
        wave = 0.5 + 0.5 * np.sin(2 * np.pi / self.period * across + 1.6 * bend)
        return _mix(self.light, self.dark, 0.75 * wave + 0.25 * (0.5 + 0.5 * bend))


@dataclass(frozen=True)
class Colorful(Material):
    """Many colors side by side along a direction: book spines, tins, a patchwork."""

    base: Color
    spread: float = 0.22  # how far the colors lie from the base
    period: float = 0.25  # m
    direction: Vector3 = (1.0, 0.0, 0.0)  # unit vector along the row
    seed: int = 0

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        phase = 2 * np.pi / self.period * (points_world @ np.asarray(self.direction))
        turns = np.random.default_rng(self.seed).uniform(0, 2 * np.pi, 3)
        waves = np.sin(phase[:, None] * np.array([1.0, 0.83, 0.64]) + turns)
        # Half of the change is common to all channels: spines differ in brightness, not hue alone.
        waves = 0.7 * waves + 0.5 * np.sin(1.13 * phase + turns[0])[:, None]
        return np.clip(np.asarray(self.base) + self.spread * waves, 0.05, 1.0)


@dataclass(frozen=True)
class Patchwork(Material):
    """Rounded patches in many colors, on faces of any direction: a quilt, a woven carpet."""

    base: Color
    spread: float = 0.2  # how far the colors lie from the base
    period: float = 0.6  # m, two patches
    seed: int = 0

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        rng = np.random.default_rng(self.seed)
        # Another period for each axis and channel: no two patches near each other look alike.
        angular = 2 * np.pi / (self.period * rng.uniform(0.8, 1.4, (3, 4)))
        phases = rng.uniform(0, 2 * np.pi, (3, 4))
        total = np.sin(points_world[:, :, None] * angular + phases).sum(axis=1)
        waves = total / np.sqrt(total * total + 0.2)
        # Patches differ in brightness, which the last wave gives, more than in hue.
        mixed = 0.6 * waves[:, :3] + 0.9 * waves[:, 3:]
        return np.clip(np.asarray(self.base) + self.spread * mixed, 0.05, 1.0)


@dataclass(frozen=True)
class Split(Material):
    """Two materials on either side of a plane across a world axis: paint that ends at a wall."""

    below: Material
    above: Material
    axis: int
    at: float = 0.0  # m

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        above = points_world[:, self.axis, None] > self.at
        return np.where(
            above,
            self.above.albedo(points_world, normals),
            self.below.albedo(points_world, normals),
        )


@dataclass(frozen=True)
class Picture(Material):
    """A framed picture: a frame of one color around soft shapes in two others."""

    center: Vector3
    size: tuple[float, float]  # m: width along `right`, height along y
    right: Vector3  # unit vector
    frame: Color
    first: Color
    second: Color
    border: float = 0.05  # m, width of the frame
    seed: int = 0

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        offset = points_world - np.asarray(self.center)
        across, up = np.abs(offset @ np.asarray(self.right)), np.abs(offset[:, 1])
        inset = np.minimum(self.size[0] / 2 - across, self.size[1] / 2 - up)
        shapes = _square_wave(2.5 * smooth_noise(points_world, 0.25, self.seed))
        return np.where((inset < self.border)[:, None], np.asarray(self.frame),
                        _mix(self.first, self.second, shapes))  # fmt: skip


@dataclass(frozen=True)
class ShellMaterial(Material):
    """Floor, ceiling and two pairs of walls of a `RoomShell`, told apart by their normals."""

    floor: Material
    ceiling: Material
    walls_x: Material  # the two walls perpendicular to x
    walls_z: Material  # the two walls perpendicular to z

    def albedo(self, points_world: Points, normals: Points) -> Points:
        """RGB in [0, 1]."""
        colors = np.empty_like(points_world)
        faces = [
            (normals[:, 1] > 0.5, self.floor),
            (normals[:, 1] < -0.5, self.ceiling),
            (np.abs(normals[:, 0]) > 0.5, self.walls_x),
            (np.abs(normals[:, 2]) > 0.5, self.walls_z),
        ]
        for chosen, material in faces:
            if chosen.any():
                colors[chosen] = material.albedo(points_world[chosen], normals[chosen])
        return colors


@dataclass(frozen=True)
class Light:
    """Soft lamps, light from all sides and a little more from above."""

    lamps: tuple[Vector3, ...]  # positions (m, world)
    strength: float = 0.62  # of each lamp, at its own place
    reach: float = 2.6  # m at which a lamp's light has halved
    ambient: float = 0.34
    sky: float = 0.14  # added where the normal points up

    def shade(
        self, albedo: Points, points_world: Points, normals: Points, openness: Values
    ) -> Points:
        """RGB in [0, 1] of a matt surface: Lambert's law, wrapped so that its terminator is soft.

        Args:
            openness: 0 in a corner to 1 in the open; darkens the light from all sides, which
                stands in for contact shadows.

        Source: our choice; a light model is needed only to give shapes a look.
        """
        energy = (self.ambient + self.sky * (0.5 + 0.5 * normals[:, 1])) * (0.55 + 0.45 * openness)
        for position in self.lamps:
            towards = np.asarray(position) - points_world
            squared = row_dot(towards, towards)
            cosine = row_dot(towards, normals) / np.sqrt(squared)
            wrapped = np.maximum(cosine + 0.35, 0.0) / 1.35
            falloff = self.strength / (1.0 + squared / self.reach**2)
            energy += falloff * wrapped * (0.85 + 0.15 * openness)
        return np.clip(albedo * energy[:, None], 0.0, 1.0)
