"""A room of thin structures."""

from nbtrack.synthetic.fittings import lattice, window
from nbtrack.synthetic.furniture import Place, ball, block, column, table, wire_stool
from nbtrack.synthetic.materials import Checker, Light, Plain, ShellMaterial, Stripes, Wood
from nbtrack.synthetic.primitives import Cylinder
from nbtrack.synthetic.room import Part, Room, Walk
from nbtrack.synthetic.rooms.palette import (
    CEILING,
    DAYLIGHT,
    LEAVES,
    METAL,
    OAK,
    TERRACOTTA,
    WALNUT,
    WHITE,
)
from nbtrack.synthetic.shell import centered_shell


def trellis_room() -> Room:
    """Thin structures. Trellises, plant stakes, a ladder, wire-legged stools and table."""
    green = Plain((0.32, 0.50, 0.40), 0.12, 0.3, seed=51)
    bamboo = Plain((0.80, 0.68, 0.40), 0.12, 0.25, seed=52)
    red = Plain((0.74, 0.30, 0.26), 0.12, 0.25, seed=53)
    parts = [
        *lattice((-0.55, 1.15, -1.7), (1.9, 2.1), (5, 4), 0.014, True, WHITE),
        block((-0.55, -1.68), (1.9, 0.32, 0.26), WALNUT),
        ball((-1.05, -1.66), 0.46, 0.2, LEAVES),
        *lattice((-1.72, 1.0, 0.55), (1.3, 2.0), (3, 4), 0.018, False, green),
        *_staked_plant((1.45, -1.35), bamboo),
        *_ladder((1.35, 1.72), OAK),
        *table((-1.2, 1.4), (0.62, 0.72, 0.62), green, METAL, 0.014),
        column((-1.25, 1.38), 0.13, 0.22, TERRACOTTA, 0.72),
        ball((-1.25, 1.38), 1.06, 0.17, LEAVES),
        *wire_stool((-0.35, 1.45), 0.46, red, METAL),
        *wire_stool((1.5, -0.35), 0.62, bamboo, METAL),
        *window(2.0, 0.35, (1.2, 1.2), True, WHITE, DAYLIGHT),
        *lattice((-0.3, 1.25, 1.886), (1.3, 1.5), (4, 3), 0.012, True, bamboo),
    ]
    tiles = Checker((0.74, 0.48, 0.36), (0.62, 0.38, 0.28), 0.6)
    walls = Plain((0.86, 0.80, 0.66), 0.09, 0.5, seed=54)
    papered = Stripes((0.60, 0.70, 0.72), (0.68, 0.78, 0.78), 0.7)
    return Room(
        "trellis_room", "trellises, staked plants, ladder, wire-legged stools and table",
        centered_shell(4.0, 2.6, 3.8), ShellMaterial(tiles, CEILING, walls, papered), tuple(parts),
        Light(((-0.5, 2.35, 0.6), (0.9, 2.1, -0.5))), Walk((0.15, 0.15), -0.4, 1, -0.25),
    )  # fmt: skip


def _staked_plant(place: Place, bamboo: Plain) -> list[Part]:
    """A pot with leaves and three stakes that meet high above it."""
    x, z = place
    parts = [column(place, 0.2, 0.34, TERRACOTTA), ball(place, 0.5, 0.24, LEAVES)]
    for across, along in ((1.0, 0.3), (-0.8, 0.8), (-0.2, -1.0)):
        foot = (x + 0.15 * across, 0.3, z + 0.15 * along)
        # The stakes cross below their tops, as if tied together.
        head = (x - 0.03 * across, 1.9, z - 0.03 * along)
        parts.append(Part(Cylinder(foot, head, 0.009), bamboo))
    return parts


def _ladder(place: Place, wood: Wood) -> list[Part]:
    """Two rails that lean against the wall at +z, and four rungs."""
    x, z = place
    half, lean, height = 0.2, 0.45, 1.9
    parts = [
        Part(Cylinder((x + side, 0.0, z - lean), (x + side, height, z + 0.1), 0.02), wood)
        for side in (-half, half)
    ]
    for share in (0.17, 0.37, 0.57, 0.77):
        y, depth = share * height, z - lean + share * (lean + 0.1)
        parts.append(Part(Cylinder((x - half, y, depth), (x + half, y, depth), 0.013), wood))
    return parts
