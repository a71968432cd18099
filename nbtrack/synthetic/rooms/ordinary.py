"""Two everyday rooms: an ordinary living room and a cluttered office."""

from nbtrack.synthetic.fittings import window
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
    Stripes,
    Wood,
)
from nbtrack.synthetic.room import Room, Walk
from nbtrack.synthetic.rooms.palette import (
    CEILING,
    DAYLIGHT,
    LAMPSHADE,
    LEAVES,
    METAL,
    OAK,
    OAK_X,
    SCREEN,
    TERRACOTTA,
    WALNUT,
    WHITE,
)
from nbtrack.synthetic.shell import centered_shell


def living_room() -> Room:
    """Ordinary. Sofa under two pictures, table on a rug, bookcase, television, lamp, plant."""
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
        *window(2.1, 0.2, (1.3, 1.2), True, WHITE, DAYLIGHT),
        column((1.7, 1.35), 0.2, 0.36, TERRACOTTA),
        ball((1.7, 1.35), 0.68, 0.36, LEAVES),
    ]  # fmt: skip
    walls = Plain((0.88, 0.82, 0.72), 0.08, 0.6, seed=18)
    accent = Stripes((0.66, 0.74, 0.70), (0.72, 0.80, 0.76), 0.6)
    return Room(
        "living_room", "sofa, coffee table, bookcase, television, lamp, plant",
        centered_shell(4.2, 2.6, 3.6), ShellMaterial(OAK, CEILING, walls, accent), tuple(parts),
        Light(((-0.6, 2.35, 0.5), (1.2, 1.9, -0.6))), Walk((0.05, 0.3), -0.6, 1),
    )  # fmt: skip


def office() -> Room:
    """Clutter. Two desks with screens, chairs with thin legs, drawers, shelf, board, bins."""
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
        centered_shell(3.8, 2.7, 3.4), ShellMaterial(carpet, CEILING, walls, back), tuple(parts),
        Light(((0.4, 2.5, -0.2), (-0.8, 2.3, 0.6))), Walk((0.15, 0.3), -0.5, 1),
    )  # fmt: skip
