"""The two rooms on which settings were chosen; no reported table holds them."""

from nbtrack.synthetic.fittings import window
from nbtrack.synthetic.furniture import ball, block, column, picture, table
from nbtrack.synthetic.materials import (
    Checker,
    Light,
    Material,
    Plain,
    ShellMaterial,
    Stripes,
    Wood,
)
from nbtrack.synthetic.room import Part, Room, Walk
from nbtrack.synthetic.rooms.palette import (
    CEILING,
    DAYLIGHT,
    LAMPSHADE,
    METAL,
    OAK,
    OAK_X,
    TERRACOTTA,
    WALNUT,
    WHITE,
)
from nbtrack.synthetic.shell import centered_shell


def bedroom() -> Room:
    """Bed with pillows, two bedside tables with lamps, wardrobe, curtain, round rug, pouf."""
    blanket = Checker((0.80, 0.46, 0.44), (0.94, 0.82, 0.74), 0.45, (0, 2))
    linen = Plain((0.94, 0.92, 0.88), 0.07, 0.3, seed=31)
    teal = Plain((0.24, 0.50, 0.50), 0.16, 0.22, seed=32)
    curtain = Plain((0.56, 0.62, 0.80), 0.14, 0.4, seed=33)
    parts = [
        block((-0.95, 0.1), (2.0, 0.3, 1.6), WALNUT),
        block((-0.93, 0.1), (1.94, 0.22, 1.5), linen, 0.3),
        block((-0.62, 0.1), (1.34, 0.26, 1.54), blanket, 0.3),
        block((-1.66, -0.28), (0.34, 0.14, 0.6), linen, 0.52, 0.08),
        block((-1.66, 0.48), (0.34, 0.14, 0.6), linen, 0.52, -0.05),
        block((-1.96, 0.1), (0.08, 1.05, 1.7), WALNUT),
        *table((-1.72, -1.05), (0.42, 0.5, 0.42), OAK, OAK),
        ball((-1.72, -1.05), 0.64, 0.14, LAMPSHADE),
        block((-1.74, 1.22), (0.42, 0.5, 0.42), OAK),
        ball((-1.74, 1.22), 0.64, 0.14, LAMPSHADE),
        block((0.3, -1.5), (1.5, 2.05, 0.56), OAK_X),
        block((0.3, -1.215), (0.012, 1.9, 0.02), METAL, 0.08),
        *window(2.0, 0.25, (1.2, 1.15), True, WHITE, DAYLIGHT),
        *(column((1.88, z), 0.085, 2.1, curtain, 0.15) for z in (-0.68, -0.53, 0.98, 1.13)),
        column((0.75, 0.55), 0.7, 0.014, Stripes((0.86, 0.72, 0.40), (0.62, 0.66, 0.50), 0.4)),
        column((1.35, 1.35), 0.26, 0.4, teal),
        picture((-0.4, 1.55, 1.785), (1.1, 0.7), True, ((0.86, 0.80, 0.68),
                (0.30, 0.44, 0.58), (0.92, 0.76, 0.56)), 34),
    ]  # fmt: skip
    floor = Wood((0.62, 0.47, 0.34), (0.48, 0.34, 0.23), 0.4, seed=35)
    walls = Plain((0.78, 0.83, 0.78), 0.09, 0.5, seed=36)
    papered = Stripes((0.90, 0.83, 0.80), (0.84, 0.75, 0.72), 0.5)
    return Room(
        "bedroom", "bed, bedside tables with lamps, wardrobe, curtain, round rug, pouf",
        centered_shell(4.0, 2.5, 3.6), ShellMaterial(floor, CEILING, walls, papered), tuple(parts),
        Light(((-0.5, 2.3, 0.9), (1.3, 1.9, 0.1))), Walk((0.35, 0.3), 0.1, 1),
    )  # fmt: skip


def kitchen_nook() -> Room:
    """Counter in an L with hanging cupboards, fridge, pots, a round table and three stools."""
    blue = Plain((0.30, 0.44, 0.58), 0.1, 0.4, seed=41)
    stone = Plain((0.72, 0.71, 0.70), 0.22, 0.2, seed=42)
    copper = Plain((0.80, 0.50, 0.34), 0.12, 0.3, seed=43)
    red = Plain((0.76, 0.28, 0.24), 0.12, 0.25, seed=44)
    tiles = Checker((0.92, 0.92, 0.88), (0.52, 0.70, 0.72), 0.4, (0, 1))
    parts = [
        block((-0.3, -1.6), (2.0, 0.86, 0.56), blue),
        block((-0.3, -1.59), (2.04, 0.05, 0.6), stone, 0.86),
        block((-1.4, -0.75), (0.56, 0.86, 1.14), blue),
        block((-1.39, -0.75), (0.6, 0.05, 1.16), stone, 0.86),
        block((-0.3, -1.885), (2.0, 0.5, 0.03), tiles, 0.91),
        block((-0.55, -1.73), (1.5, 0.62, 0.34), OAK_X, 1.5),
        block((1.15, -1.55), (0.66, 1.8, 0.64), WHITE),
        block((0.86, -1.215), (0.03, 0.6, 0.03), METAL, 0.8),
        column((-0.75, -1.6), 0.13, 0.18, METAL, 0.91),
        column((-0.35, -1.55), 0.1, 0.13, copper, 0.91),
        ball((-1.4, -0.55), 0.91 + 0.13, 0.14, TERRACOTTA),
        column((-1.42, -0.95), 0.07, 0.26, red, 0.91),
        column((0.85, 0.85), 0.5, 0.04, OAK, 0.7),
        column((0.85, 0.85), 0.05, 0.7, METAL),
        column((0.85, 0.85), 0.26, 0.03, METAL),
        ball((0.8, 0.8), 0.74 + 0.1, 0.11, Plain((0.86, 0.70, 0.26), 0.1, seed=45)),
        *_stool((0.15, 1.05), red),
        *_stool((1.3, 0.15), blue),
        *_stool((0.95, 1.6), red),
        *window(-1.7, 0.75, (1.2, 1.1), True, WHITE, DAYLIGHT),
        picture((1.685, 1.55, -0.35), (0.8, 0.7), False, ((0.22, 0.24, 0.26),
                (0.94, 0.88, 0.76), (0.80, 0.36, 0.26)), 46),
    ]  # fmt: skip
    floor = Checker((0.80, 0.76, 0.70), (0.50, 0.46, 0.44), 0.8)
    walls = Plain((0.92, 0.84, 0.64), 0.08, 0.5, seed=47)
    ends = Plain((0.86, 0.86, 0.80), 0.1, 0.5, seed=48)
    return Room(
        "kitchen_nook", "L-shaped counter, cupboards, fridge, pots, round table, stools",
        centered_shell(3.4, 2.6, 3.8), ShellMaterial(floor, CEILING, walls, ends), tuple(parts),
        Light(((-0.2, 2.4, -0.5), (0.7, 2.1, 1.0))), Walk((-0.1, 0.0), 0.75, -1),
    )  # fmt: skip


def _stool(place: tuple[float, float], seat: Material) -> list[Part]:
    return [
        column(place, 0.17, 0.05, seat, 0.42),
        column(place, 0.025, 0.42, METAL),
        column(place, 0.15, 0.02, METAL),
    ]
