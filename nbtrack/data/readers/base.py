"""What a format is, which there are, and how a folder's own is told."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from nbtrack.core.errors import ConfigError, DataError, MissingError, nearest_name
from nbtrack.data.readers.declaration import DECLARATION_FILE, Declaration, declared_in
from nbtrack.data.readers.pose_files import checked
from nbtrack.data.readers.recording import Recording


@dataclass(frozen=True)
class Request:
    """Parts of a folder that a user may name, where its format has several."""

    depth_folder: str | None = None
    pose_file: str | None = None


Opener = Callable[[Path, Declaration, Request], Recording]


@dataclass(frozen=True)
class Format:
    """One layout of recordings on disk."""

    name: str
    label: str  # for people
    signs: tuple[str, ...]  # patterns of files and folders that tell it; `a|b`: either
    open: Opener
    # What its files mean, unless `sequence.toml` says otherwise.
    declared: Declaration = field(default_factory=Declaration)

    @property
    def needs(self) -> str:
        """Its files, for messages."""
        return ", ".join(sign.replace("|", " or ") for sign in self.signs)

    def share(self, folder: Path) -> float:
        """Share of the signs that a folder shows."""
        shown = [any(any(folder.glob(p)) for p in sign.split("|")) for sign in self.signs]
        return sum(shown) / len(shown)


FORMATS: dict[str, Format] = {}


def register(layout: Format) -> None:
    """Make a format known to every command. Raises ConfigError if its name is taken."""
    if layout.name in FORMATS:
        raise ConfigError(f"format {layout.name!r} is registered twice: choose another name")
    FORMATS[layout.name] = layout


def find_format(folder: Path, name: str | None = None) -> Format:
    """The format of a folder: the one named, or declared, or the one whose files are there.

    Where files are missing, the format that the most are left of; its reader says what is missing.

    Raises:
        MissingError: the folder does not exist, or looks like no format.
        ConfigError: no format has that name.
        DataError: the folder is whole as several formats.
    """
    if not folder.is_dir():
        raise MissingError(
            f"no folder {folder}: give a folder with a recording, or the name of a synthetic room"
        )
    if name is None:
        name = declared_in(folder, Declaration()).format
    if name is not None:
        if name not in FORMATS:
            raise ConfigError(f"unknown format {name[:40]!r}: {nearest_name(name, list(FORMATS))}")
        return FORMATS[name]
    shares = {layout.name: layout.share(folder) for layout in FORMATS.values()}
    most = max(shares.values())
    if most == 0:
        wanted = "; ".join(f"{layout.name} ({layout.needs})" for layout in FORMATS.values())
        raise MissingError(
            f"{folder} looks like no known recording: it needs the files of {wanted}"
        )
    best = [name for name, share in shares.items() if share == most]
    if len(best) > 1 and most == 1:
        raise DataError(
            f"{folder} can be read as {' or '.join(best)}: choose with --format, or format = "
            f'"{best[0]}" in {DECLARATION_FILE}'
        )
    return FORMATS[best[0]]


def open_recording(
    folder: Path | str,
    format: str | None = None,
    depth_folder: str | None = None,
    pose_file: str | None = None,
) -> Recording:
    """Find the files of a recording and read its poses and calibration; pixels come later.

    Args:
        format: the name of one; by default told by the files.
        depth_folder, pose_file: of those formats that have several.

    Raises:
        MissingError: the folder or a file that the format needs does not exist.
        DataError: a text cannot be read, or counts disagree.
        ConfigError: no format has that name.
    """
    folder = Path(folder)
    layout = find_format(folder, format)
    declared = replace(declared_in(folder, layout.declared), format=layout.name)
    recording = layout.open(folder, declared, Request(depth_folder, pose_file))
    n_poses, n_images = len(recording.file_poses), len(recording)
    if n_poses != n_images:
        raise DataError(
            f"{recording.pose_file} has {n_poses} poses but there are {n_images} images: every "
            "frame needs one; write 'nan' for each number of a frame without a pose"
        )
    declaration = folder / DECLARATION_FILE
    texts = recording.text_files + [declaration] * declaration.is_file()
    poses = checked(recording.file_poses, recording.pose_file)
    return replace(recording, file_poses=poses, text_files=texts)
