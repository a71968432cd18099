"""Write synthetic scenes in the layout of the Neural RGB-D dataset, and find their rooms again."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np

from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.device import usable_cores
from nbtrack.machinery.errors import DataError, look_up
from nbtrack.machinery.files import fingerprint, json_text, naming_damaged
from nbtrack.provenance import package_code
from nbtrack.recordings.writer import WrittenFrame, write_sequence
from nbtrack.synthetic.keyframes import keyframe_trajectory
from nbtrack.synthetic.motion import handheld_trajectory, tour
from nbtrack.synthetic.render import add_kinect_noise, filter_depth, render_frame
from nbtrack.synthetic.room import Room, build_room, description

ROOM_FILE = "room.json"
ROOM_VERSION = 2  # raise it when a room, the motion or the sensor model changes
_AGAIN = "remove the folder and make the room again"
_FRAMES_AT_ONCE = 32  # rendered ahead of writing: bounds memory where writing is slower
MOTIONS = {"keyframes": keyframe_trajectory, "handheld": handheld_trajectory, "tour": tour}


def room_intrinsics(width: int, height: int) -> Intrinsics:
    """The camera of all synthetic rooms: 60 degrees wide, as that of the Neural RGB-D dataset."""
    return Intrinsics.from_focal(width, height, float(width / (2 * np.tan(np.radians(60.0) / 2))))


def room_frames(
    room: Room, n_frames: int, width: int, height: int, seed: int, motion: str = "handheld"
) -> Iterator[WrittenFrame]:
    """Renders a room's frames in order; memory does not grow with their number.

    `motion` is a name in `MOTIONS`. `seed` determines the camera's path and the depth noise. Every
    frame has its own random numbers, so that the result does not depend on the number of threads.
    When the first frame is asked for, it raises ConfigError for an unknown motion, and what the
    motion raises.
    """
    camera = room_intrinsics(width, height)
    poses = look_up("motion", motion, MOTIONS)(room, n_frames, seed)

    def make_frame(number: int) -> WrittenFrame:
        color, depth, _ = render_frame(room, camera, poses[number])
        rng = np.random.default_rng([seed, number, room.number])
        noisy = add_kinect_noise(depth, camera.fx, rng)
        maps = {"depth": depth, "depth_with_noise": noisy, "depth_filtered": filter_depth(noisy)}
        depths_mm = {name: np.rint(1e3 * values).astype(np.uint16) for name, values in maps.items()}
        return color, depths_mm, poses[number]

    # Threads suffice, since NumPy releases the interpreter lock.
    with ThreadPoolExecutor(usable_cores()) as pool:
        for start in range(0, n_frames, _FRAMES_AT_ONCE):
            yield from pool.map(make_frame, range(start, min(start + _FRAMES_AT_ONCE, n_frames)))


def make_room(
    name: str,
    folder: Path,
    n_frames: int,
    width: int,
    height: int,
    seed: int = 0,
    motion: str = "handheld",
    progress: Callable[[int], object] = lambda done: None,
) -> Path:
    """Writes a synthetic scene in the layout of the Neural RGB-D dataset; returns `folder`.

    `depth/` gets the exact depth, `depth_with_noise/` what a sensor measures, and `depth_filtered/`
    that after a bilateral filter. Both pose files hold the exact poses. `room.json` records the
    arguments; the same arguments give the same bytes. `progress` is told the number of frames
    written so far. Raises as `build_room`, `room_frames` and `write_sequence` do.
    """
    made_with = {"room": name, "version": ROOM_VERSION, "motion": motion, "seed": seed}
    size = {"frames": n_frames, "width": width, "height": height}
    notes = {ROOM_FILE: json_text(made_with | size)}
    frames = room_frames(build_room(name), n_frames, width, height, seed, motion)
    with closing(frames):  # ends the rendering threads, even if writing fails
        write_sequence(folder, room_intrinsics(width, height), frames, notes, progress)
    return folder


def room_version(name: str) -> str:
    """Hash of a room's description and the generator's code, as twelve hexadecimal digits.

    Raises ConfigError for an unknown room.
    """
    return fingerprint(description(name), package_code("synthetic"))


def room_of(folder: Path) -> Room | None:
    """The exact room that a sequence folder shows; None for a recording of the real world.

    Raises DataError if `room.json` is damaged, or another version of the generator wrote it, and
    ConfigError for an unknown room.
    """
    path = folder / ROOM_FILE
    if not path.is_file():
        return None
    with naming_damaged(path, "record of a room", _AGAIN):
        record = json.loads(path.read_text(encoding="utf-8"))
        name, version = record["room"], record["version"]
    if version != ROOM_VERSION:
        raise DataError(f"{path} has version {version}; {ROOM_VERSION} is made here; {_AGAIN}")
    return build_room(name)
