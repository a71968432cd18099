"""A tall room with stairs."""

from nbtrack.synthetic.fittings import banister, door, staircase, window
from nbtrack.synthetic.furniture import ball, block, column, picture
from nbtrack.synthetic.materials import Checker, Light, Plain, ShellMaterial, Stripes
from nbtrack.synthetic.room import Room, Walk
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
    WHITE,
)
from nbtrack.synthetic.shell import centered_shell


def stairwell() -> Room:
    """Stairs. Two flights around a corner with landings and banisters, in a tall room."""
    rug = Stripes((0.62, 0.26, 0.26), (0.86, 0.72, 0.50), 0.4)
    blue = Plain((0.30, 0.42, 0.56), 0.14, 0.3, seed=81)
    parts = [
        *staircase((1.75, 1.4), (0.0, -1.0), 8, (0.9, 0.2, 0.28), OAK),
        block((1.75, -1.52), (0.9, 0.2, 1.36), OAK_X, 1.6),
        *staircase((1.3, -1.75), (-1.0, 0.0), 5, (0.9, 0.2, 0.28), OAK_X, 1.8, 0.3),
        block((-1.15, -1.75), (2.1, 0.2, 0.9), OAK_X, 2.8),
        block((1.32, 1.46), (0.09, 1.15, 0.09), WALNUT),
        *banister((1.33, 0.2, 1.26), (1.33, 1.6, -0.7), 6, WHITE, WALNUT),
        *banister((1.16, 2.0, -1.33), (0.04, 2.8, -1.33), 4, WHITE, WALNUT),
        *banister((-0.2, 3.0, -1.33), (-2.1, 3.0, -1.33), 5, WHITE, WALNUT),
        block((-0.3, 0.5), (1.3, 0.012, 1.8), rug),
        *door(2.2, -0.6, False, WHITE, blue, METAL),
        *window(-2.2, -0.4, (1.1, 1.5), True, WHITE, DAYLIGHT, 1.2),
        block((-1.98, 1.1), (0.42, 1.7, 0.9), WALNUT),
        column((-1.96, 1.0), 0.13, 0.24, blue, 1.7),
        column((0.8, 1.9), 0.17, 0.34, TERRACOTTA),
        ball((0.8, 1.9), 0.62, 0.3, LEAVES),
        picture((-0.9, 1.6, -2.185), (1.2, 0.8), True, ((0.2, 0.18, 0.16),
                (0.90, 0.84, 0.66), (0.32, 0.44, 0.56)), 82),
        block((-1.5, -1.9), (1.1, 0.8, 0.4), WALNUT),
        ball((-1.2, -1.88), 0.8 + 0.14, 0.14, LAMPSHADE),
        picture((2.185, 2.0, 0.9), (0.6, 0.8), False, ((0.9, 0.88, 0.84),
                (0.86, 0.56, 0.36), (0.34, 0.28, 0.40)), 83),
    ]  # fmt: skip
    floor = Checker((0.78, 0.75, 0.70), (0.46, 0.44, 0.44), 0.8)
    walls = Plain((0.84, 0.80, 0.70), 0.08, 0.6, seed=84)
    ends = Plain((0.70, 0.76, 0.74), 0.08, 0.6, seed=85)
    return Room(
        "stairwell", "two flights of stairs with landings and banisters, console, bench, plant",
        centered_shell(4.4, 4.6, 4.4), ShellMaterial(floor, CEILING, walls, ends), tuple(parts),
        Light(((-0.6, 3.4, 0.6), (0.3, 2.4, 0.2))), Walk((-0.35, 0.35), -0.2, -1, -0.08),
    )  # fmt: skip
