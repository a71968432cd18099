"""Two rooms of ordinary furniture: one with strong texture all over, one with hardly any."""

from nbtrack.synthetic.fittings import window
from nbtrack.synthetic.furniture import (
    armchair,
    ball,
    block,
    bookcase,
    chair,
    column,
    floor_lamp,
    sofa,
    table,
)
from nbtrack.synthetic.materials import (
    Checker,
    Colorful,
    Light,
    Patchwork,
    Plain,
    ShellMaterial,
    Stripes,
)
from nbtrack.synthetic.room import Room, Walk
from nbtrack.synthetic.rooms.palette import DAYLIGHT, METAL, WALNUT
from nbtrack.synthetic.shell import centered_shell


def patchwork_den() -> Room:
    """Strong texture. Checks, stripes and patches on walls, floor, ceiling and furniture."""
    quilt = Patchwork((0.62, 0.46, 0.40), 0.2, 0.5, 91)
    weave = Patchwork((0.46, 0.50, 0.56), 0.2, 0.4, 92)
    checks = Checker((0.92, 0.84, 0.62), (0.26, 0.42, 0.52), 0.3, (0, 1))
    ribbons = Stripes((0.88, 0.46, 0.26), (0.94, 0.88, 0.74), 0.22, (0.6, 0.0, 0.8))
    curtain = Stripes((0.30, 0.50, 0.46), (0.92, 0.80, 0.52), 0.26, (0.0, 1.0, 0.0))
    chest = Checker((0.80, 0.30, 0.28), (0.95, 0.90, 0.80), 0.3, (0, 1))
    box = Checker((0.24, 0.36, 0.56), (0.90, 0.78, 0.40), 0.3, (1, 2))
    books = [
        Colorful((0.55, 0.48, 0.42), 0.26, 0.25, (0.0, 0.0, 1.0), seed) for seed in (93, 94, 95)
    ]
    parts = [
        *sofa((-0.35, -1.36), 1.9, quilt, checks),
        *armchair((1.35, -1.0), -0.6, weave, ribbons),
        block((0.0, 0.0), (2.3, 0.012, 1.7), Patchwork((0.56, 0.38, 0.34), 0.22, 0.55, 96)),
        *bookcase((-1.73, 0.45), (0.34, 1.5, 1.1), WALNUT, books),
        *floor_lamp((0.95, -1.55), 1.6, METAL, Stripes((1.0, 0.9, 0.66), (0.84, 0.5, 0.3), 0.2)),
        block((0.35, 1.52), (1.4, 0.75, 0.5), chest),
        column((0.0, 1.5), 0.12, 0.24, ribbons, 0.75),
        block((0.6, 1.5), (0.3, 0.2, 0.24), weave, 0.75, 0.4),
        column((-1.2, 1.35), 0.27, 0.42, ribbons),
        block((1.5, 0.95), (0.5, 0.5, 0.5), box),
        block((1.48, 0.97), (0.34, 0.3, 0.34), quilt, 0.5, 0.5),
        block((-0.45, -1.785), (1.5, 0.9, 0.03), weave, 1.15),
        *window(1.9, -0.1, (1.1, 1.1), True, WALNUT, DAYLIGHT),
        block((1.84, -0.82), (0.08, 1.9, 0.34), curtain, 0.35),
        block((1.84, 0.62), (0.08, 1.9, 0.34), curtain, 0.35),
    ]  # fmt: skip
    floor = Patchwork((0.56, 0.47, 0.38), 0.15, 0.7, 97)
    ceiling = Checker((0.96, 0.92, 0.84), (0.74, 0.70, 0.62), 0.8)
    walls = Checker((0.82, 0.60, 0.42), (0.92, 0.84, 0.66), 0.6, (1, 2))
    ends = Stripes((0.42, 0.58, 0.62), (0.88, 0.86, 0.74), 0.4, (0.8, 0.6, 0.0))
    return Room(
        "patchwork_den", "quilted sofa and armchair, rug, bookcase, curtains, checked chest, boxes",
        centered_shell(3.8, 2.5, 3.6), ShellMaterial(floor, ceiling, walls, ends), tuple(parts),
        Light(((-0.5, 2.2, 0.5), (0.8, 1.9, -0.3))), Walk((0.0, 0.2), -0.4, 1),
    )  # fmt: skip


def grey_studio() -> Room:
    """Low texture. Ordinary furniture in grey and white, hardly a pattern anywhere."""
    pale = Plain((0.72, 0.72, 0.72), 0.02, 0.7, seed=101)
    light = Plain((0.62, 0.62, 0.63), 0.025, 0.6, seed=102)
    middle = Plain((0.52, 0.52, 0.53), 0.03, 0.5, seed=103)
    dark = Plain((0.36, 0.36, 0.37), 0.03, 0.5, seed=104)
    pane = Plain((0.88, 0.89, 0.90), 0.02, 0.8, seed=105)
    parts = [
        *sofa((0.3, -1.36), 1.9, middle, light),
        block((0.2, -0.2), (1.9, 0.012, 1.3), light),
        *table((0.25, -0.45), (0.9, 0.42, 0.5), pale, dark),
        *bookcase((-1.83, -0.2), (0.34, 1.7, 1.1), pale, [middle, light, dark]),
        *floor_lamp((-1.2, -1.45), 1.6, dark, pale),
        block((-0.5, 1.56), (1.5, 0.7, 0.45), light),
        column((-0.9, 1.54), 0.1, 0.3, middle, 0.7),
        ball((-0.2, 1.52), 0.7 + 0.13, 0.13, pale),
        *chair((1.2, 1.0), -2.2, light, dark),
        block((1.65, -1.35), (0.45, 0.5, 0.45), pale),
        *window(2.0, 0.1, (1.3, 1.2), True, light, pane),
        block((0.3, -1.785), (1.1, 0.7, 0.03), light, 1.25),
        block((-0.5, 1.785), (0.8, 0.9, 0.03), middle, 1.15),
    ]
    floor = Plain((0.60, 0.60, 0.60), 0.03, 0.7, seed=106)
    ceiling = Plain((0.90, 0.90, 0.90), 0.02, 0.8, seed=107)
    walls = Plain((0.76, 0.76, 0.77), 0.02, 0.8, seed=108)
    ends = Plain((0.82, 0.82, 0.81), 0.02, 0.8, seed=109)
    return Room(
        "grey_studio", "grey and white sofa, tables, bookcase, lamp, chair, sideboard",
        centered_shell(4.0, 2.6, 3.6), ShellMaterial(floor, ceiling, walls, ends), tuple(parts),
        Light(((-0.4, 2.35, 0.5), (1.0, 2.0, -0.4))), Walk((0.1, 0.3), 0.2, 1),
    )  # fmt: skip
