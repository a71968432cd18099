"""Make a synthetic scene on disk, in the Neural RGB-D layout, and find its exact room again."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import ConfigError, DataError
from nbtrack.data.writer import SequenceWriter
from nbtrack.synthetic.motion import handheld_trajectory
from nbtrack.synthetic.render import render_frame
from nbtrack.synthetic.room import Room
from nbtrack.synthetic.rooms import build_room
from nbtrack.synthetic.sensor import add_kinect_noise, filter_depth

ROOM_FILE = "room.json"
ROOM_VERSION = 1  # raise it when a room, the motion or the sensor model changes
FIELD_OF_VIEW = np.radians(60.0)  # horizontal, as in the Neural RGB-D dataset


@dataclass(frozen=True)
class Frame:
    """What is written of one frame."""

    color: UInt8[np.ndarray, "h w 3"]  # RGB
    depths_mm: dict[str, UInt16[np.ndarray, "h w"]]  # by depth folder, 0 = invalid
    T_world_camera: Float[np.ndarray, "4 4"]  # OpenCV camera axes


def room_intrinsics(width: int, height: int) -> Intrinsics:
    """The camera of all synthetic rooms: 60 degrees wide, square pixels, centered."""
    return Intrinsics.from_focal(width, height, float(width / (2 * np.tan(FIELD_OF_VIEW / 2))))


def room_frames(
    room: Room, n_frames: int, width: int, height: int, seed: int, workers: int = 1
) -> Iterator[Frame]:
    """Render a room's frames one after the other; memory does not grow with their number.

    Every frame has its own random numbers, so the result does not depend on `workers`.

    Args:
        seed: of the camera's path and the depth noise; the room itself is always the same.
        workers: processes that render; with one, everything runs in this process.

    Raises:
        ConfigError: a number is too small.
        NumericalError: no camera path fits into the room.
    """
    for label, value, least in [
        ("frames", n_frames, 2), ("width", width, 8), ("height", height, 8),
        ("workers", workers, 1), ("seed", seed, 0),
    ]:  # fmt: skip
        if value < least:
            raise ConfigError(f"{label} = {value}; {least} or more are allowed; raise it")
    poses = handheld_trajectory(room, n_frames, seed)
    make = partial(_make_frame, room, room_intrinsics(width, height), seed)
    if workers == 1:
        yield from map(make, range(n_frames), poses)
        return
    # Spawned, not forked: the caller may have threads (torch) that do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        block = 4 * workers  # frames in flight: bounds memory when writing is slower
        for start in range(0, n_frames, block):
            numbers = range(start, min(start + block, n_frames))
            yield from pool.map(make, numbers, poses[numbers.start : numbers.stop])


def _make_frame(
    room: Room,
    intrinsics: Intrinsics,
    seed: int,
    number: int,
    T_world_camera: Float[np.ndarray, "4 4"],
) -> Frame:
    color, depth, _ = render_frame(room, intrinsics, T_world_camera)
    rng = np.random.default_rng([seed, number, room.number])
    noisy = add_kinect_noise(depth, intrinsics.fx, rng)
    maps = {"depth": depth, "depth_with_noise": noisy, "depth_filtered": filter_depth(noisy)}
    depths_mm = {name: np.rint(1e3 * values).astype(np.uint16) for name, values in maps.items()}
    return Frame(color, depths_mm, T_world_camera)


def make_room(
    name: str,
    folder: Path,
    n_frames: int,
    width: int,
    height: int,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a synthetic scene as the Neural RGB-D dataset does; returns `folder`.

    Clean depth goes to `depth/`, the sensor's to `depth_with_noise/` and `depth_filtered/`; the
    poses are exact in both pose files. `room.json` records how the scene was made. The same
    arguments give the same bytes. The folder appears when it is complete.

    Args:
        name: one of `ROOMS`.
        folder: must not exist yet.
        progress: called with (frames done, frames in all) after each frame.

    Raises:
        MissingError: no room of that name.
        ConfigError: a number is too small.
        DataError: the folder exists.
    """
    room = build_room(name)
    frames = room_frames(room, n_frames, width, height, seed, workers)
    intrinsics = room_intrinsics(width, height)
    record = {
        "room": name, "version": ROOM_VERSION, "seed": seed, "frames": n_frames,
        "width": width, "height": height,
    }  # fmt: skip
    depth_folders = ("depth", "depth_with_noise", "depth_filtered")
    with SequenceWriter(folder, intrinsics, depth_folders) as writer:
        writer.write_text(ROOM_FILE, json.dumps(record, indent=2) + "\n")
        for done, frame in enumerate(frames, start=1):
            writer.add(frame.color, frame.depths_mm, frame.T_world_camera)
            if progress is not None:
                progress(done, n_frames)
    return folder


def room_of(folder: Path) -> Room | None:
    """The exact room that a sequence folder shows; None for a recording of the real world.

    Raises:
        DataError: `room.json` is damaged or written by another version of the generator.
        MissingError: it names a room that does not exist.
    """
    path = folder / ROOM_FILE
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        name, version = record["room"], record["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} cannot be read ({error!r}); it names room and version; make the room again"
        ) from error
    if version != ROOM_VERSION:
        raise DataError(
            f"{path} has version {version}; this package makes version {ROOM_VERSION}; "
            "remove the folder and make the room again"
        )
    return build_room(name)
