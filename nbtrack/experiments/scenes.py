"""Find the folder of what a user calls a sequence: a path, a room or a scene of the dataset."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nbtrack.core.arrays import Frames
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.presets import Preset, ScenesConfig
from nbtrack.experiments.runs import check_no_recording, is_own_output
from nbtrack.machinery.errors import ConfigError, DataError, MissingError, nearest_name, typed
from nbtrack.machinery.files import absolute, data_folder, fingerprint, locked, runs_folder
from nbtrack.machinery.progress import ProgressBar, tell
from nbtrack.recordings import reading
from nbtrack.recordings.formats import holds_recording
from nbtrack.recordings.images import images_of
from nbtrack.recordings.recording import Recording, open_recording
from nbtrack.synthetic import ROOMS, Room, make_room, room_of, room_version

_KNOWN = [*ROOMS, *DATASET_SCENES]


@dataclass(frozen=True)
class Scene:
    """A sequence on disk, which is opened when it is first needed."""

    name: str
    folder: Path
    format: str | None = None  # None: the files in the folder tell it
    made: ScenesConfig | None = None  # settings of a synthetic room in the cache; None for others

    @property
    def room(self) -> Room | None:
        """The exact geometry of a synthetic room; None for any other scene."""
        return room_of(self.folder)

    @cached_property
    def recording(self) -> Recording:
        """The scene's files, poses and calibration.

        Raises MissingError, DataError or ConfigError if something is not there or is wrong.
        """
        return open_recording(self.folder, self.format)

    @cached_property
    def fingerprint(self) -> str:
        """Twelve hexadecimal digits that change with anything that is read of the scene."""
        return fingerprint(*images_of(self.recording).contents())

    def read(self, frames: str = ":", **options: Any) -> RgbdSequence:
        """Read the frames of a slice such as `10:50:2`, and set depths that are outliers to 0.

        `options` are other arguments of `read_frames`. Images are read-only, since all who read
        this scene share them, also the job that maps it. Raises DataError if an image cannot be
        read, or if no frame is left.
        """
        frame_ids = reading.parse_frames(frames)
        read = reading.without_outliers(reading.read_frames(self.recording, frame_ids, **options))
        read.colors.flags.writeable = read.depths_mm.flags.writeable = False
        return read

    def select(self, frames: str, needs_poses: bool = True) -> Frames:
        """The numbers of the frames in a slice such as `10:50:2`, by default only those with poses.

        Raises DataError if the text is no slice, or if the slice selects no frame.
        """
        return reading.select_frames(self.recording, reading.parse_frames(frames), needs_poses)


@typed
def open_scene(sequence: str | Path, preset: Preset, format: str | None = None) -> Scene:
    """The scene that a user means by `sequence`.

    It is a path of a folder in a supported layout, the name of a synthetic room, or the name of a
    scene of the Neural RGB-D dataset below the data folder. A room is made in the cache, at the
    size that the preset gives, if it is not there. If a path and a name are the same text, the
    folder is meant, unless it holds results of nbtrack. Without `format` a folder's files tell it.
    Raises ConfigError if there is no such folder, room or scene, and MissingError if the scene of
    the dataset was not downloaded.
    """
    text, folder = str(sequence), absolute(sequence)
    if is_own_output(folder) and text not in _KNOWN and not holds_recording(folder):
        raise ConfigError(f"{text} holds results of nbtrack: give the recording that was tracked")
    if text not in _KNOWN and folder.exists():
        return Scene(folder.name, folder, format)  # of a plain file: its opening says what to give
    if folder.is_dir() and not is_own_output(folder):
        tell(f"{text}: the folder {folder} is read, not the room or scene of that name")
        return Scene(folder.name, folder, format)
    if text in ROOMS:
        return _room(text, preset.scenes)
    if text in DATASET_SCENES:
        downloaded = data_folder() / text
        if downloaded.is_dir():
            return Scene(text, downloaded, format)
        advice = f"`nbtrack data fetch {text}` brings it (data/README.md); rooms need no download"
        raise MissingError(f"no folder {downloaded} of the Neural RGB-D dataset: {advice}")
    found = f"no sequence {text!r}: it is neither a folder nor a known scene"
    raise ConfigError(f"{found}; {nearest_name(text, _KNOWN)}")


@typed
def open_scenes(preset: Preset) -> list[Scene]:
    """Open the scenes that the preset names; synthetic rooms that are not there are made.

    A scene whose folder is missing or damaged is left out, and a printed line says so. If this
    happens to all scenes, the error of the first one is raised. Raises ConfigError if the preset
    names no scene, names an unknown one, or names two by paths with the same last part, which is
    the scene's name in tables.
    """
    names = preset.scenes.names
    last_parts = {Path(name).name for name in names}
    if not names or len(last_parts) < len(names):
        given = ", ".join(names) or "(none)"
        raise ConfigError(f"scenes {given}: give at least one, and of one name only one")
    scenes, errors = [], {}
    for name in names:
        try:
            scene = open_scene(name, preset)
            scene.select(":")  # opens the recording, so that a damaged folder is found here
            scenes.append(scene)
        except (MissingError, DataError) as error:
            errors[name] = error
    if not scenes:
        raise errors[names[0]]
    if errors:
        first_error, *_ = errors.values()
        tell(f"missing, and left out: {', '.join(errors)} ({first_error})")
    return scenes


def write_room(name: str, folder: Path, config: ScenesConfig) -> None:
    """Render a synthetic room and write it as a sequence folder, with a progress bar."""
    n_frames, seed, motion = config.n_frames, config.seed, config.motion
    width, height = config.width, config.width * 3 // 4
    with ProgressBar(f"room {name}", n_frames) as bar:
        make_room(name, folder, n_frames, width, height, seed, motion, bar.move_to)


def _room(name: str, config: ScenesConfig) -> Scene:
    """A synthetic room with the motion, frames, width and seed of `config`, in the cache.

    It is made if it is not there.
    """
    recipe = f"{config.motion}-{config.n_frames}x{config.width}-seed{config.seed}"
    folder = runs_folder() / "rooms" / f"{name}-{recipe}-{room_version(name)}" / name
    if not folder.is_dir():  # `write_sequence` puts it in place when it is complete
        check_no_recording(runs_folder())
        # Another command that needs the same room waits, and then reads it.
        with locked(folder.with_suffix(".lock")):
            if not folder.is_dir():
                write_room(name, folder, config)
    return Scene(name, folder, made=config)
