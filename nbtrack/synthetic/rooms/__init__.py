"""The furnished rooms, by name. To add one: a function that returns a `Room`, entered in `ROOMS`.

Rooms are about 4 x 2.6 x 3.5 m or larger, centered on x = z = 0. Furniture stands along the
walls, so that a camera at head height finds free space in the middle.
"""

from collections.abc import Callable

from nbtrack.core.errors import MissingError, nearest_name
from nbtrack.synthetic.room import Room
from nbtrack.synthetic.rooms.bare import gallery
from nbtrack.synthetic.rooms.connected import long_hall, two_rooms
from nbtrack.synthetic.rooms.ordinary import living_room, office
from nbtrack.synthetic.rooms.stairs import stairwell
from nbtrack.synthetic.rooms.texture import grey_studio, patchwork_den
from nbtrack.synthetic.rooms.thin import trellis_room
from nbtrack.synthetic.rooms.tuning import bedroom, kitchen_nook

ROOMS: dict[str, Callable[[], Room]] = {
    "living_room": living_room,
    "office": office,
    "bedroom": bedroom,
    "kitchen_nook": kitchen_nook,
    "trellis_room": trellis_room,
    "gallery": gallery,
    "stairwell": stairwell,
    "patchwork_den": patchwork_den,
    "grey_studio": grey_studio,
    "two_rooms": two_rooms,
    "long_hall": long_hall,
}

REPORTED_ROOMS: tuple[str, ...] = (
    "living_room",
    "office",
    "trellis_room",
    "gallery",
    "stairwell",
    "patchwork_den",
    "grey_studio",
    "two_rooms",
    "long_hall",
)
"""Rooms whose numbers are reported, each with one kind of difficulty.

`bedroom` and `kitchen_nook` are left out: the settings were chosen on them, so that numbers from
there would be too good.
"""


def build_room(name: str) -> Room:
    """The synthetic room of that name.

    Raises:
        MissingError: no room has this name; the message lists all and the nearest.
    """
    if name not in ROOMS:
        raise MissingError(f"no synthetic room '{name}'; {nearest_name(name, list(ROOMS))}")
    return ROOMS[name]()
