"""Download one scene of the Neural RGB-D dataset from its ZIP file, without the other eight."""

import contextlib
import re
import zipfile
import zlib
from pathlib import Path

from nbtrack.data.dataset import DATASET_SCENES, DATASET_ZIP
from nbtrack.machinery.errors import DataError, MissingError, look_up
from nbtrack.machinery.files import absolute, naming_damaged, write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.registry import from_extra

# The paths that are written below a scene's folder: what nbtrack reads of a scene. Any other path,
# as with `..`, could lead out of the folder.
_NAME = re.compile(r"(?a)(?:images|depth_filtered)/[\w-][\w.-]*\.(?:png|jpe?g)|[\w-][\w.-]*\.txt")
_AGAIN = "run the same command again to go on, or name a mirror or a local ZIP file with --url"
Files = dict[str, zipfile.ZipInfo]  # entries of the ZIP file, by paths below the scene's folder


def fetch_scene(name: str, folder: Path, source: str = DATASET_ZIP) -> str:
    """Download the images, depth maps and texts of a scene; returns a line on what was written.

    `source` is the address of the ZIP file, from which only the scene's parts are asked for, or a
    local path. Files that are complete stay as they are, so that a killed fetch can go on.
    Raises ConfigError for an unknown name; MissingError if the ZIP file is not there, or the scene
    is not in it; DataError if the ZIP file cannot be read, or a file of other content is in the
    way; OSError if the disk fills up.
    """
    look_up("scene of the dataset", name, DATASET_SCENES)
    with contextlib.ExitStack() as opened:
        with naming_damaged(source, "ZIP file", _AGAIN):
            archive = opened.enter_context(_archive(source, opened))
        files = _files_of(name, archive, source)
        missing = {path: info for path, info in files.items() if _is_missing(folder / path, info)}
        total, done = sum(info.compress_size for info in missing.values()), 0  # bytes
        with ProgressBar(f"fetching {name}", max(total, 1)) as bar:
            for path, info in missing.items():
                with naming_damaged(source, "ZIP file", _AGAIN):
                    content = archive.read(info)  # raises an error for a wrong checksum
                write_atomic(folder / path, content)
                done += info.compress_size
                bar.move_to(done, f"{done / 1e6:.0f} of {total / 1e6:.0f} MB")
    present = len(files) - len(missing)
    return f"{folder}: {len(missing)} files fetched, {total / 1e6:.1f} MB; {present} were there"


def _archive(source: str, opened: contextlib.ExitStack) -> zipfile.ZipFile:
    """Open the ZIP file at an address or a path; `opened` will close the connection it needs."""
    if not re.match("https?://", source):
        path = absolute(source.removeprefix("file://"))
        if not path.is_file():
            raise MissingError(f"no file {path}: give --url an http(s) address or a ZIP file")
        return zipfile.ZipFile(path)
    remotezip, requests = (from_extra(name, "fetch") for name in ("remotezip", "requests"))
    session = opened.enter_context(requests.Session())  # one connection for all files
    try:
        return remotezip.RemoteZip(source, session=session, timeout=60)  # s without an answer
    except remotezip.RangeNotSupported:
        advice = "take another mirror, or download the whole file and give its path to --url"
        raise DataError(f"{source}: the server gives no ranges of a file: {advice}") from None


def _files_of(name: str, archive: zipfile.ZipFile, source: str) -> Files:
    """The files of a scene that nbtrack reads, by their paths in the scene's folder.

    The scene's folder may lie at any depth of the archive. Of several folders with the scene's
    name, the one with the most files of allowed paths is taken. Raises MissingError if it has no
    images or no depth.
    """
    by_parent: dict[str, Files] = {}
    for info in archive.infolist():
        parent, _, path = f"/{info.filename}".rpartition(f"/{name}/")
        if _NAME.fullmatch(path):
            by_parent.setdefault(parent, {})[path] = info
    files = max(by_parent.values(), key=len, default={})
    folders = {path.rpartition("/")[0] for path in files}
    if not {"images", "depth_filtered"} <= folders:
        found = f"{source} has no images and depth in a folder {name!r}"
        raise MissingError(f"{found}: name the dataset's own ZIP file with --url")
    return files


def _is_missing(file: Path, info: zipfile.ZipInfo) -> bool:
    """Whether a file is not there, or is shorter than the ZIP file's, as by a killed download.

    Raises DataError if the file is not shorter and has other content than the ZIP file's.
    """
    content = file.read_bytes() if file.is_file() else b""
    if (len(content), zlib.crc32(content)) == (info.file_size, info.CRC):
        return False
    if len(content) >= info.file_size:
        raise DataError(f"{file} is not the dataset's: move it away, and run the command again")
    return True
