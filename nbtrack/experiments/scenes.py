"""From what a user calls a sequence to a folder on disk: a path, a room, a scene of the dataset."""

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from filelock import FileLock

from nbtrack.core.config import ScenesConfig
from nbtrack.core.errors import DataError, MissingError, nearest_name
from nbtrack.core.paths import data_folder, runs_folder
from nbtrack.core.provenance import code_fingerprint, fingerprint
from nbtrack.data.readers import FORMATS, Recording, open_recording
from nbtrack.data.sequence import RgbdSequence, parse_frames, read_frames
from nbtrack.synthetic import ROOMS, Room, make_room, room_of

DATASET_SCENES = (
    "breakfast_room", "complete_kitchen", "green_room", "grey_white_room", "kitchen",
    "morning_apartment", "staircase", "thin_geometry", "whiteroom",
)  # fmt: skip
"""Folders of the Neural RGB-D dataset, in the order of the paper's Table I."""


@dataclass(frozen=True)
class Scene:
    """A sequence on disk, read when it is needed."""

    name: str
    folder: Path
    format: str | None = None  # None: told by the files that are there

    @property
    def room(self) -> Room | None:
        """The exact geometry, if the scene is a synthetic room."""
        return room_of(self.folder)

    def open(self) -> Recording:
        """Its files, poses and calibration. Raises as `open_recording` does."""
        return open_recording(self.folder, self.format)

    def read(self, frames: slice = slice(None), progress: bool = False) -> RgbdSequence:
        """The scene's frames. Raises DataError or MissingError as `read_sequence` does."""
        return read_frames(self.open(), frames, progress)

    def frame_numbers(self, frames: str) -> range:
        """Which frames a slice such as `10:50:2` selects, those with a NaN pose included.

        Raises DataError if it selects none.
        """
        total = len(self.open())
        selected = range(total)[parse_frames(frames)]
        if not selected:
            raise DataError(
                f"frames {frames} select nothing of the {total} frames in {self.folder}: choose a "
                f"range within 0:{total}"
            )
        return selected

    @cached_property
    def fingerprint(self) -> str:
        """Changes with what was read and how: texts, the images' names and sizes, and the reader.

        An image that changes in place and keeps its size is not noticed.
        """
        recording = self.open()
        texts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in recording.text_files]
        reader = code_fingerprint(FORMATS[recording.declared.format].open)
        return fingerprint(recording.file_sizes, texts, recording.declared, reader)


def room_folder(name: str, config: ScenesConfig) -> Path:
    """Where a synthetic room of this size, length and seed lies, made or not yet."""
    size = f"{config.n_frames}x{config.width}"
    return runs_folder() / "rooms" / f"{name}-{size}-seed{config.seed}" / name


def find_scene(
    sequence: str | Path,
    config: ScenesConfig,
    progress: Callable[[int, int], None] | None = None,
    workers: int = 1,
    format: str | None = None,
) -> Scene:
    """The scene that a user means.

    Args:
        sequence: a folder in a supported layout, the name of a synthetic room (made here at the
            size that `config` gives, unless it is there already), or of a scene of the Neural
            RGB-D dataset below the data folder.
        progress: called with frames done and in all while a room is made.
        workers: processes that make it.
        format: of the folder; by default told by its files.

    Raises:
        MissingError: there is no such folder, room or scene.
    """
    text = str(sequence)
    folder = Path(text)
    if text not in ROOMS and text not in DATASET_SCENES:
        if folder.is_dir():
            return Scene(folder.resolve().name, folder.resolve(), format)
        names = [*ROOMS, *DATASET_SCENES]
        raise MissingError(
            f"no sequence {text!r}: it is neither a folder nor a known scene; "
            f"{nearest_name(text, names)}"
        )
    if text in ROOMS and (config.synthetic or text not in DATASET_SCENES):
        folder = room_folder(text, config)
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            # Another command may want the same room: it waits, and finds it made.
            with FileLock(folder.with_suffix(".lock")):
                if not folder.is_dir():
                    _make_room(text, folder, config, workers, progress)
        return Scene(text, folder)
    folder = data_folder() / text
    if not folder.is_dir():
        raise MissingError(
            f"no folder {folder}: download the Neural RGB-D dataset there (see data/README.md), "
            f"or use a synthetic room, which needs no download: {', '.join(ROOMS)}"
        )
    return Scene(text, folder, format)


def _make_room(
    name: str,
    folder: Path,
    config: ScenesConfig,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Make a room of the cache; what a killed attempt has left is removed first."""
    for unfinished in folder.parent.glob(f".{folder.name}.*.unfinished"):
        shutil.rmtree(unfinished, ignore_errors=True)
    height = config.width * 3 // 4
    make_room(name, folder, config.n_frames, config.width, height, config.seed, workers, progress)
