"""From what a user calls a sequence to a folder on disk: a path, a room, a scene of the dataset."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nbtrack.core.arrays import Frames
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.presets import Preset, ScenesConfig
from nbtrack.experiments.runs import check_no_recording, is_own_output
from nbtrack.machinery.errors import ConfigError, DataError, MissingError, check_kind, nearest_name
from nbtrack.machinery.files import absolute, data_folder, fingerprint, locked, runs_folder
from nbtrack.machinery.progress import ProgressBar, tell
from nbtrack.recordings import reading
from nbtrack.recordings.images import images_of
from nbtrack.recordings.recording import Recording, open_recording
from nbtrack.synthetic import ROOMS, Room, make_room, room_of, room_version

_KNOWN = [*ROOMS, *DATASET_SCENES]


@dataclass(frozen=True)
class Scene:
    """A sequence on disk, opened when it is first needed."""

    name: str
    folder: Path
    format: str | None = None  # None: told by the files that are there
    made: ScenesConfig | None = None  # the settings of a synthetic room that was made in the cache

    @property
    def room(self) -> Room | None:
        """The exact geometry, if the scene is a synthetic room."""
        return room_of(self.folder)

    @cached_property
    def recording(self) -> Recording:
        """Its files, poses and calibration. Raises as `open_recording` does."""
        return open_recording(self.folder, self.format)

    @cached_property
    def fingerprint(self) -> str:
        """Changes with what is read."""
        return fingerprint(*images_of(self.recording).contents())

    def read(self, frames: str = ":", **options: Any) -> RgbdSequence:
        """The frames of a slice such as `10:50:2`, without depths that are outliers.

        More options, and what is raised, are those of `read_frames`. Images are read-only: they are
        shared by all that read this scene, also by what maps it.
        """
        frame_ids = reading.parse_frames(frames)
        read = reading.without_outliers(reading.read_frames(self.recording, frame_ids, **options))
        read.colors.flags.writeable = read.depths_mm.flags.writeable = False
        return read

    def select(self, frames: str, needs_poses: bool = True) -> Frames:
        """Numbers of the frames of a slice; raises as `select_frames` does."""
        return reading.select_frames(self.recording, reading.parse_frames(frames), needs_poses)


def open_scene(sequence: str | Path, preset: Preset, format: str | None = None) -> Scene:
    """The scene that a user means.

    It is a folder in a supported layout, the name of a synthetic room (made here at the size that
    the preset gives, unless it is there already), or of a scene of the Neural RGB-D dataset below
    the data folder. A folder of that name comes first, unless nbtrack wrote its results there. The
    format of a folder is by default told by its files. Raises ConfigError where there is no such
    folder, room or scene; MissingError where the scene of the dataset was not downloaded.
    """
    check_kind(Preset, preset=preset)
    text = str(sequence)
    folder = absolute(sequence)
    # A room or scene comes before a file of its name, and before a folder with nbtrack's results.
    is_hidden = text in _KNOWN and (folder.is_file() or is_own_output(folder))
    # Opening another plain file raises an error that says what to give instead.
    if (folder.is_dir() or folder.is_file()) and not is_hidden:
        if text in _KNOWN:
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


def open_scenes(preset: Preset) -> list[Scene]:
    """The preset's scenes; synthetic rooms that are not there are made.

    Scenes that lack a folder, or whose folder is damaged, are left out, and a line names them.
    Raises ConfigError where no name is given, or one twice, or an unknown one; where no scene is
    whole, what is wrong with the first.
    """
    check_kind(Preset, preset=preset)
    names = preset.scenes.names
    if not names or len({Path(name).name for name in names}) < len(names):
        given = ", ".join(names) or "(none)"
        raise ConfigError(f"scenes {given}: give at least one, and of one name only one")
    scenes, missing = [], {}
    for name in names:
        try:
            scene = open_scene(name, preset)
            scene.select(":")  # opens the recording, so that a damaged folder is found here
            scenes.append(scene)
        except (MissingError, DataError) as error:
            missing[name] = error
    if not scenes:
        raise missing[names[0]]
    if missing:
        tell(f"missing, and left out: {', '.join(missing)} ({next(iter(missing.values()))})")
    return scenes


def write_room(name: str, folder: Path, config: ScenesConfig) -> None:
    """Write a synthetic room as a sequence folder, and show a progress bar."""
    n_frames, seed, motion = config.n_frames, config.seed, config.motion
    width, height = config.width, config.width * 3 // 4
    with ProgressBar(f"room {name}", n_frames) as bar:
        make_room(name, folder, n_frames, width, height, seed, motion, bar.move_to)


def _room(name: str, config: ScenesConfig) -> Scene:
    """The recording of a synthetic room with these `SIZES`, in the cache, made if missing."""
    recipe = f"{config.motion}-{config.n_frames}x{config.width}-seed{config.seed}"
    folder = runs_folder() / "rooms" / f"{name}-{recipe}-{room_version(name)}" / name
    if not folder.is_dir():  # `write_sequence` puts it in place when it is complete
        check_no_recording(runs_folder())
        # Another command that needs the same room waits, and then reads it.
        with locked(folder.with_suffix(".lock")):
            if not folder.is_dir():
                write_room(name, folder, config)
    return Scene(name, folder, made=config)
