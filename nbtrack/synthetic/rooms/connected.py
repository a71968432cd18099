"""Rooms that a camera walks through: two rooms with a doorway between them, and a long hall."""

from nbtrack.synthetic.fittings import door, wall_with_doorway, window
from nbtrack.synthetic.furniture import (
    ball,
    block,
    bookcase,
    chair,
    column,
    floor_lamp,
    picture,
    sofa,
    table,
)
from nbtrack.synthetic.materials import (
    Checker,
    Colorful,
    Light,
    Plain,
    ShellMaterial,
    Split,
    Stripes,
)
from nbtrack.synthetic.primitives import Cylinder
from nbtrack.synthetic.room import Part, Room, Walk
from nbtrack.synthetic.rooms.palette import (
    CEILING,
    DAYLIGHT,
    LAMPSHADE,
    LEAVES,
    METAL,
    OAK,
    OAK_X,
    TERRACOTTA,
    WALNUT,
    WALNUT_X,
    WHITE,
)
from nbtrack.synthetic.shell import centered_shell

# Walks from +z to -z. With this yaw at the start, a camera that turns left by half a circle per
# crossing looks ahead when it passes the middle.
_START_YAW = -1.9


def two_rooms() -> Room:
    """Connected rooms. A dining room and a small lounge; the camera passes the doorway."""
    cloth = Plain((0.34, 0.48, 0.46), 0.14, 0.25, seed=111)
    pillow = Stripes((0.94, 0.84, 0.60), (0.80, 0.46, 0.32), 0.22, (0.8, 0.6, 0.0))
    rug = Checker((0.32, 0.38, 0.52), (0.82, 0.78, 0.68), 0.5)
    red = Plain((0.72, 0.32, 0.28), 0.14, 0.25, seed=112)
    books = [
        Colorful((0.55, 0.45, 0.38), 0.22, 0.3, (0.0, 0.0, 1.0), seed) for seed in (113, 114, 115)
    ]
    partition = Split(
        Plain((0.80, 0.78, 0.74), 0.08, 0.5, seed=116), Plain((0.84, 0.70, 0.60), 0.08, 0.5), 2
    )
    parts = [
        *wall_with_doorway(0.0, 3.8, 2.6, (0.0, 1.3, 2.2), partition),
        block((0.0, 0.0), (1.3, 0.015, 0.16), WALNUT),
        *table((-0.75, 2.6), (1.3, 0.74, 0.8), OAK, METAL),
        column((-0.6, 2.6), 0.1, 0.22, red, 0.74),
        *chair((-0.45, 1.95), 3.0, red, METAL),
        block((1.66, 1.9), (0.44, 0.85, 1.3), WALNUT),
        column((1.66, 2.2), 0.09, 0.3, TERRACOTTA, 0.85),
        picture((1.885, 1.6, 1.75), (0.9, 0.7), False, ((0.2, 0.18, 0.16),
                (0.92, 0.84, 0.62), (0.64, 0.34, 0.30)), 117),
        *window(-1.9, 1.7, (1.2, 1.2), True, WHITE, DAYLIGHT),
        *door(3.4, 0.9, False, WHITE, OAK_X, METAL),
        *sofa((0.2, -2.96), 1.8, cloth, pillow),
        block((0.1, -1.95), (1.8, 0.012, 1.2), rug),
        block((0.1, -2.05), (0.8, 0.36, 0.45), WALNUT_X),
        *bookcase((1.73, -1.8), (0.34, 1.7, 1.2), WALNUT, books),
        *floor_lamp((-1.35, -3.05), 1.6, METAL, LAMPSHADE),
        picture((0.2, 1.6, -3.385), (1.1, 0.7), True, ((0.9, 0.88, 0.84),
                (0.30, 0.46, 0.54), (0.90, 0.74, 0.46)), 118),
        *window(-1.9, -1.8, (1.2, 1.2), True, WHITE, DAYLIGHT),
        column((-1.55, -0.5), 0.18, 0.34, TERRACOTTA),
        ball((-1.55, -0.5), 0.62, 0.3, LEAVES),
    ]  # fmt: skip
    floor = Split(OAK, Checker((0.80, 0.76, 0.70), (0.56, 0.52, 0.48), 0.8), 2)
    walls = Split(
        Plain((0.62, 0.72, 0.78), 0.09, 0.5, seed=119), Plain((0.88, 0.82, 0.66), 0.09, 0.5), 2
    )
    ends = Split(Stripes((0.74, 0.80, 0.82), (0.66, 0.74, 0.78), 0.6), Plain((0.80, 0.62, 0.5)), 2)
    return Room(
        "two_rooms", "dining room and lounge with a doorway: table, chair, sofa, bookcase",
        centered_shell(3.8, 2.6, 6.8), ShellMaterial(floor, CEILING, walls, ends), tuple(parts),
        Light(((0.2, 2.35, 1.9), (-0.2, 2.35, -1.9))),
        Walk((0.0, 0.65), _START_YAW, 1, -0.2, (0.0, -0.65)),
    )  # fmt: skip


def long_hall() -> Room:
    """A long hall. Doors, cupboards, a bench, coats and lamps; near walls and far ends."""
    runner = Checker((0.56, 0.24, 0.26), (0.80, 0.64, 0.46), 0.6)
    leaf = Plain((0.46, 0.56, 0.54), 0.08, 0.4, seed=121)
    mirror = Plain((0.60, 0.70, 0.74), 0.3, 0.6, seed=128)
    coats = [Plain((0.70, 0.36, 0.28), 0.16, 0.25, seed=122),
             Plain((0.26, 0.34, 0.50), 0.16, 0.25, seed=123),
             Plain((0.76, 0.66, 0.40), 0.16, 0.25, seed=124)]  # fmt: skip
    parts = [
        block((0.0, 0.0), (0.95, 0.012, 7.4), runner),
        *door(-1.2, -1.9, True, WHITE, leaf, METAL),
        *door(-1.2, 2.1, True, WHITE, leaf, METAL),
        *door(1.2, 0.35, True, WHITE, leaf, METAL),
        *door(-4.3, -0.15, False, WHITE, OAK_X, METAL),
        *window(4.3, 0.1, (1.1, 1.3), False, WHITE, DAYLIGHT),
        block((0.97, -2.9), (0.46, 1.95, 1.2), OAK),
        block((-1.0, 3.4), (0.4, 1.3, 0.8), WALNUT),
        column((-1.0, 3.4), 0.1, 0.3, TERRACOTTA, 1.3),
        block((-1.0, 0.1), (0.36, 0.06, 1.2), OAK, 0.4),
        *(block((-1.0, z), (0.3, 0.4, 0.06), METAL) for z in (-0.4, 0.6)),
        block((1.18, -1.1), (0.04, 0.14, 1.1), WALNUT, 1.6),
        *(block((1.13, z), (0.14, 0.85, 0.24), coat, 0.75)
          for z, coat in zip((-1.45, -1.12, -0.8), coats, strict=True)),
        block((1.03, 2.2), (0.32, 0.78, 1.0), WHITE),
        column((1.03, 1.95), 0.08, 0.26, coats[1], 0.78),
        ball((1.03, 2.45), 0.78 + 0.13, 0.13, LAMPSHADE),
        block((1.19, 2.2), (0.03, 0.9, 0.6), mirror, 1.2),
        *(ball((0.0, z), 2.5, 0.14, LAMPSHADE) for z in (-2.7, 0.0, 2.7)),
        picture((-1.185, 1.55, 0.1), (1.0, 0.7), False, ((0.2, 0.18, 0.16),
                (0.90, 0.84, 0.68), (0.28, 0.46, 0.52)), 125),
        picture((-1.185, 1.55, -3.2), (0.6, 0.8), False, ((0.9, 0.88, 0.84),
                (0.86, 0.56, 0.36), (0.34, 0.28, 0.40)), 126),
        column((0.98, -2.05), 0.11, 0.5, METAL),
        Part(Cylinder((0.96, 0.1, -2.05), (1.04, 0.85, -2.0), 0.02), coats[0]),
    ]  # fmt: skip
    walls = Stripes((0.86, 0.80, 0.68), (0.78, 0.72, 0.60), 0.8, (0.0, 0.0, 1.0))
    ends = Plain((0.70, 0.76, 0.72), 0.09, 0.5, seed=127)
    return Room(
        "long_hall", "long hall with doors, cupboards, bench, coats, runner, mirror and lamps",
        centered_shell(2.4, 2.7, 8.6), ShellMaterial(OAK, CEILING, walls, ends), tuple(parts),
        Light(((0.0, 2.2, -2.7), (0.0, 2.2, 0.0), (0.0, 2.2, 2.7)), 0.42),
        Walk((0.0, 0.65), _START_YAW, 1, -0.16, (0.0, -0.65)),
    )  # fmt: skip
