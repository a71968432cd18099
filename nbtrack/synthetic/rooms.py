"""The furnished rooms, by name. To add one: a function that returns a `Room`, entered in `ROOMS`.

Each room is about 4 x 2.6 x 3.5 m, centered on x = z = 0. Furniture stands along the walls, so
that a camera at head height finds free space in the middle.
"""

from collections.abc import Callable

from nbtrack.errors import MissingError, nearest_name
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
    Material,
    Plain,
    ShellMaterial,
    Stripes,
    Wood,
)
from nbtrack.synthetic.room import Part, Room, Walk
from nbtrack.synthetic.shell import RoomShell

OAK = Wood((0.80, 0.62, 0.42), (0.62, 0.44, 0.27))
OAK_X = Wood((0.80, 0.62, 0.42), (0.62, 0.44, 0.27), direction=(1.0, 0.0, 0.0))
WALNUT = Wood((0.50, 0.34, 0.23), (0.34, 0.22, 0.14), period=0.4)
WALNUT_X = Wood((0.50, 0.34, 0.23), (0.34, 0.22, 0.14), period=0.4, direction=(1.0, 0.0, 0.0))
WHITE = Plain((0.90, 0.89, 0.86), 0.05, seed=1)
CEILING = Plain((0.95, 0.94, 0.92), 0.05, 0.7, seed=2)
METAL = Plain((0.34, 0.35, 0.37), 0.1, 0.3, seed=3)
SCREEN = Plain((0.10, 0.12, 0.16), 0.5, 0.25, seed=4)
LAMPSHADE = Plain((1.0, 0.93, 0.76), 0.04, seed=5)
LEAVES = Plain((0.30, 0.52, 0.26), 0.4, 0.2, seed=6)
TERRACOTTA = Plain((0.76, 0.44, 0.30), 0.12, 0.3, seed=7)
DAYLIGHT = Plain((0.80, 0.92, 1.0), 0.1, 0.8, seed=8)


def _shell(width: float, height: float, depth: float) -> RoomShell:
    return RoomShell((-width / 2, 0.0, -depth / 2), (width / 2, height, depth / 2))


def _window(wall: float, along: float, size: tuple[float, float], on_x: bool) -> list[Part]:
    """Frame and pane in the middle of a wall at coordinate `wall` of z (`on_x`: of x)."""
    width, height = size
    parts = []
    for edge, thickness, material in ((0.0, 0.05, WHITE), (0.14, 0.07, DAYLIGHT)):
        long, tall = width - edge, height - edge
        place = (wall, along) if on_x else (along, wall)
        edges = (thickness, tall, long) if on_x else (long, tall, thickness)
        parts.append(block(place, edges, material, 1.0 + edge / 2))
    return parts


def living_room() -> Room:
    """Sofa under two pictures, coffee table on a rug, bookcase, television, lamp and plant."""
    cloth = Plain((0.36, 0.47, 0.58), 0.14, 0.25, seed=11)
    pillow = Stripes((0.93, 0.78, 0.42), (0.88, 0.55, 0.30), 0.22, (0.8, 0.6, 0.0))
    rug = Checker((0.72, 0.30, 0.26), (0.90, 0.78, 0.62), 0.5)
    books = [
        Colorful((0.55, 0.45, 0.38), 0.22, 0.3, (0.0, 0.0, 1.0), seed) for seed in (12, 13, 14, 15)
    ]
    parts = [
        *sofa((-0.25, -1.36), 2.0, cloth, pillow),
        block((-0.1, -0.3), (2.0, 0.012, 1.3), rug),
        *table((-0.1, -0.5), (0.95, 0.42, 0.5), OAK, METAL),
        *bookcase((-1.93, 0.35), (0.34, 1.9, 1.1), WALNUT, books),
        *floor_lamp((1.5, -1.4), 1.65, METAL, LAMPSHADE),
        block((0.2, 1.58), (1.7, 0.45, 0.42), OAK_X),
        block((0.2, 1.66), (1.2, 0.68, 0.06), SCREEN, 0.5),
        picture((-0.75, 1.62, -1.785), (0.8, 0.6), True, ((0.2, 0.18, 0.16),
                (0.92, 0.86, 0.70), (0.24, 0.48, 0.52)), 16),
        picture((0.4, 1.66, -1.785), (0.55, 0.75), True, ((0.9, 0.88, 0.84),
                (0.90, 0.52, 0.34), (0.30, 0.26, 0.42)), 17),
        *_window(2.1, 0.2, (1.3, 1.2), on_x=True),
        column((1.7, 1.35), 0.2, 0.36, TERRACOTTA),
        ball((1.7, 1.35), 0.68, 0.36, LEAVES),
    ]  # fmt: skip
    walls = Plain((0.88, 0.82, 0.72), 0.08, 0.6, seed=18)
    accent = Stripes((0.66, 0.74, 0.70), (0.72, 0.80, 0.76), 0.6)
    return Room(
        "living_room", "sofa, coffee table, bookcase, television, lamp, plant",
        _shell(4.2, 2.6, 3.6), ShellMaterial(OAK, CEILING, walls, accent), tuple(parts),
        Light(((-0.6, 2.35, 0.5), (1.2, 1.9, -0.6))), Walk((0.05, 0.3), -0.6, 1),
    )  # fmt: skip


def office() -> Room:
    """Two desks with screens, two chairs with thin legs, drawers, shelf, whiteboard and bins."""
    green = Plain((0.34, 0.56, 0.44), 0.16, 0.25, seed=21)
    orange = Plain((0.88, 0.50, 0.24), 0.14, 0.25, seed=22)
    folders = [
        Colorful((0.50, 0.50, 0.52), 0.22, 0.4, (1.0, 0.0, 0.0), seed) for seed in (23, 24, 25)
    ]
    carpet = Checker((0.50, 0.54, 0.60), (0.40, 0.44, 0.52), 1.0)
    desk = Wood((0.90, 0.82, 0.68), (0.78, 0.68, 0.52), seed=26)
    parts = [
        *table((-1.52, -0.35), (0.72, 0.74, 1.5), desk, METAL, 0.025),
        block((0.75, -1.32), (1.5, 0.05, 0.7), desk, 0.7),
        block((0.04, -1.32), (0.05, 0.7, 0.66), WHITE),
        block((1.46, -1.32), (0.05, 0.7, 0.66), WHITE),
        block((-1.68, -0.5), (0.06, 0.38, 0.62), SCREEN, 0.86),
        block((-1.7, -0.5), (0.14, 0.12, 0.2), METAL, 0.74),
        block((0.8, -1.5), (0.66, 0.4, 0.05), SCREEN, 0.86, 0.2),
        block((0.8, -1.52), (0.2, 0.12, 0.14), METAL, 0.74),
        *chair((-0.95, -0.35), 1.75, green, METAL),
        *chair((0.62, -0.72), 0.25, orange, METAL),
        *bookcase((-0.6, 1.52), (1.3, 1.35, 0.34), WHITE, folders),
        block((1.62, 0.95), (0.45, 0.68, 0.6), orange),
        column((-1.55, 0.7), 0.15, 0.36, METAL),
        column((1.68, -0.75), 0.13, 0.32, Plain((0.30, 0.42, 0.66), 0.1, seed=27)),
        block((1.885, 0.1), (0.03, 0.9, 1.4), WHITE, 0.95),
        picture((-1.885, 1.65, 0.6), (0.7, 0.9), False, ((0.15, 0.16, 0.18),
                (0.90, 0.85, 0.55), (0.62, 0.28, 0.32)), 28),
        block((1.0, 1.68), (0.85, 2.0, 0.05), OAK_X),
        block((0.0, -0.1), (1.4, 0.06, 0.3), LAMPSHADE, 2.64),
    ]  # fmt: skip
    walls = Plain((0.80, 0.84, 0.86), 0.09, 0.6, seed=29)
    back = Stripes((0.86, 0.84, 0.76), (0.80, 0.79, 0.70), 0.8)
    return Room(
        "office", "two desks with screens, chairs with thin legs, shelf, whiteboard, bins",
        _shell(3.8, 2.7, 3.4), ShellMaterial(carpet, CEILING, walls, back), tuple(parts),
        Light(((0.4, 2.5, -0.2), (-0.8, 2.3, 0.6))), Walk((0.15, 0.3), -0.5, 1),
    )  # fmt: skip


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
        *_window(2.0, 0.25, (1.2, 1.15), on_x=True),
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
        _shell(4.0, 2.5, 3.6), ShellMaterial(floor, CEILING, walls, papered), tuple(parts),
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
        *_window(-1.7, 0.75, (1.2, 1.1), on_x=True),
        picture((1.685, 1.55, -0.35), (0.8, 0.7), False, ((0.22, 0.24, 0.26),
                (0.94, 0.88, 0.76), (0.80, 0.36, 0.26)), 46),
    ]  # fmt: skip
    floor = Checker((0.80, 0.76, 0.70), (0.50, 0.46, 0.44), 0.8)
    walls = Plain((0.92, 0.84, 0.64), 0.08, 0.5, seed=47)
    ends = Plain((0.86, 0.86, 0.80), 0.1, 0.5, seed=48)
    return Room(
        "kitchen_nook", "L-shaped counter, cupboards, fridge, pots, round table, stools",
        _shell(3.4, 2.6, 3.8), ShellMaterial(floor, CEILING, walls, ends), tuple(parts),
        Light(((-0.2, 2.4, -0.5), (0.7, 2.1, 1.0))), Walk((-0.1, 0.0), 0.75, -1),
    )  # fmt: skip


def _stool(place: tuple[float, float], seat: Material) -> list[Part]:
    return [
        column(place, 0.17, 0.05, seat, 0.42),
        column(place, 0.025, 0.42, METAL),
        column(place, 0.15, 0.02, METAL),
    ]


ROOMS: dict[str, Callable[[], Room]] = {
    "living_room": living_room,
    "office": office,
    "bedroom": bedroom,
    "kitchen_nook": kitchen_nook,
}


def build_room(name: str) -> Room:
    """The synthetic room of that name.

    Raises:
        MissingError: no room has this name; the message lists all and the nearest.
    """
    if name not in ROOMS:
        raise MissingError(f"no synthetic room '{name}'; {nearest_name(name, list(ROOMS))}")
    return ROOMS[name]()
