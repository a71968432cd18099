"""A room of large bare walls."""

from nbtrack.synthetic.fittings import door
from nbtrack.synthetic.furniture import ball, block, column, picture
from nbtrack.synthetic.materials import Light, Plain, ShellMaterial, Wood
from nbtrack.synthetic.room import Room, Walk
from nbtrack.synthetic.rooms.palette import CEILING, METAL, OAK, TERRACOTTA, WHITE
from nbtrack.synthetic.shell import centered_shell


def gallery() -> Room:
    """Large bare walls. A few pictures, things on pedestals, a bench, a door; far walls."""
    blue = Plain((0.24, 0.36, 0.58), 0.14, 0.3, seed=61)
    bronze = Plain((0.58, 0.44, 0.28), 0.16, 0.25, seed=62)
    red = Plain((0.72, 0.24, 0.20), 0.1, 0.3, seed=63)
    plinth = Plain((0.78, 0.77, 0.74), 0.03, 0.6, seed=64)
    black, cream = (0.14, 0.14, 0.15), (0.92, 0.88, 0.78)
    parts = [
        picture((-1.1, 1.55, -2.735), (1.7, 1.15), True, (black, cream, (0.20, 0.42, 0.52)), 65),
        picture((1.7, 1.55, -2.735), (0.7, 0.9), True, (black, cream, (0.66, 0.28, 0.26)), 66),
        picture((0.9, 1.6, 2.735), (2.0, 1.2), True, (black, (0.88, 0.72, 0.40),
                (0.26, 0.30, 0.46)), 67),
        picture((-2.985, 1.55, 0.4), (1.0, 1.3), False, (black, cream, (0.30, 0.50, 0.36)), 68),
        picture((2.985, 1.55, -0.9), (0.8, 0.6), False, (black, cream, (0.84, 0.52, 0.30)), 69),
        block((-1.9, -1.6), (0.42, 1.0, 0.42), plinth),
        ball((-1.9, -1.6), 1.0 + 0.19, 0.19, bronze),
        block((1.95, -1.7), (0.36, 1.1, 0.36), plinth),
        column((1.95, -1.7), 0.11, 0.4, TERRACOTTA, 1.1),
        block((2.05, 1.55), (0.46, 0.85, 0.46), plinth),
        block((2.05, 1.55), (0.26, 0.3, 0.26), blue, 0.85, 0.5),
        block((-2.0, 1.7), (0.95, 0.3, 0.95), plinth, 0.0, 0.2),
        column((-2.1, 1.75), 0.13, 1.2, bronze, 0.3),
        block((-1.85, 1.55), (0.3, 0.7, 0.3), red, 0.3, 0.8),
        block((0.1, -1.0), (1.5, 0.07, 0.42), OAK, 0.38),
        block((-0.45, -1.0), (0.07, 0.38, 0.36), METAL),
        block((0.65, -1.0), (0.07, 0.38, 0.36), METAL),
        *door(2.75, -1.35, False, WHITE, OAK, METAL),
        column((2.88, 0.75), 0.08, 0.5, red, 0.85),
        block((0.0, -1.4), (4.0, 0.06, 0.08), METAL, 2.88),
        block((0.0, 1.4), (4.0, 0.06, 0.08), METAL, 2.88),
    ]  # fmt: skip
    floor = Wood((0.64, 0.55, 0.45), (0.54, 0.45, 0.36), 0.5, seed=70)
    walls = Plain((0.84, 0.84, 0.82), 0.02, 0.9, seed=71)
    ends = Plain((0.82, 0.84, 0.86), 0.02, 0.9, seed=72)
    return Room(
        "gallery", "large bare walls with a few pictures, things on pedestals, bench, door",
        centered_shell(6.0, 3.0, 5.5), ShellMaterial(floor, CEILING, walls, ends), tuple(parts),
        Light(((-1.3, 2.6, 0.3), (1.4, 2.6, -0.2))), Walk((0.0, 0.2), 0.3, -1, -0.14),
    )  # fmt: skip
