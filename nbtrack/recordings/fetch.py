"""Bring one scene of the Neural RGB-D dataset out of its ZIP file, without the other eight."""

import contextlib
import re
import shutil
import zipfile
import zlib
from pathlib import Path

from nbtrack.data.dataset import DATASET_SCENES, DATASET_ZIP
from nbtrack.machinery.errors import DataError, MissingError, look_up
from nbtrack.machinery.files import absolute, naming_damaged, write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.formats import FORMATS

# What may be written below a scene's folder. No other name is: it could lead out of there.
_NAME = re.compile(r"(?a)[\w-]+/[\w-][\w.-]*\.(?:png|jpe?g)|[\w-][\w.-]*\.txt")
_AGAIN = "run the same command again to go on, or name a mirror or a local ZIP file with --url"
Files = dict[str, zipfile.ZipInfo]  # by their paths below the scene's folder


def fetch_scene(name: str, folder: Path, source: str = DATASET_ZIP) -> str:
    """Write the images, the depth that is read, and the texts of a scene; say what was written.

    `source` is the ZIP file: an address, of which only the scene's parts are asked for, or a local
    path. Files that are there whole stay, so that a fetch that was killed goes on.
    Raises ConfigError for an unknown name, MissingError where the ZIP file, or the scene in it, is
    not there, DataError where it cannot be read, or where other files are in the way, and OSError
    where the disk is full.
    """
    look_up("scene of the dataset", name, DATASET_SCENES)
    with contextlib.ExitStack() as opened:
        with naming_damaged(source, "ZIP file", _AGAIN):
            archive = opened.enter_context(_archive(source, opened))
        files = _files_of(name, archive, source)
        missing = {path: info for path, info in files.items() if _is_missing(folder / path, info)}
        existing = next(path for path in (folder, *folder.parents) if path.is_dir())
        needed = sum(info.file_size for info in missing.values())
        free = shutil.disk_usage(existing).free
        if needed > free:
            found = f"{needed / 1e6:.0f} MB are needed, and {existing} has {free / 1e6:.0f} MB free"
            raise DataError(f"{found}: make room, or let NBTRACK_DATA name another disk")
        total, done = sum(info.compress_size for info in missing.values()), 0
        with ProgressBar(f"fetching {name}", max(total, 1)) as bar:
            for path, info in missing.items():
                with naming_damaged(source, "ZIP file", _AGAIN):
                    content = archive.read(info)  # raises where the checksum is another
                write_atomic(folder / path, content)
                done += info.compress_size
                bar.move_to(done, f"{done / 1e6:.0f} of {total / 1e6:.0f} MB")
    kept = len(files) - len(missing)
    return f"{folder}: {len(missing)} files fetched, {total / 1e6:.1f} MB; {kept} were there"


def _archive(source: str, opened: contextlib.ExitStack) -> zipfile.ZipFile:
    """The ZIP file at an address or a path; `opened` ends what it needs."""
    if not re.match("https?://", source):
        path = absolute(source.removeprefix("file://"))
        if not path.is_file():
            raise MissingError(f"no file {path}: give --url an http(s) address or a ZIP file")
        return zipfile.ZipFile(path)
    try:
        import remotezip  # an extra
        import requests
    except ImportError:
        raise MissingError("data fetch needs remotezip: pip install 'nbtrack[fetch]'") from None
    session = opened.enter_context(requests.Session())  # one connection for all files
    try:
        return remotezip.RemoteZip(source, session=session, timeout=60)  # s of silence
    except remotezip.RangeNotSupported:
        advice = "take another mirror, or download the whole file and give its path to --url"
        raise DataError(f"{source}: the server gives no ranges of a file: {advice}") from None


def _files_of(name: str, archive: zipfile.ZipFile, source: str) -> Files:
    """The files of a scene that are read, by their paths in the scene's folder.

    The scene's folder is the one of its name, at any depth of the archive, with most such files.
    """
    by_parent: dict[str, Files] = {}
    for info in archive.infolist():
        parent, _, path = f"/{info.filename}".rpartition(f"/{name}/")
        if _NAME.fullmatch(path):
            by_parent.setdefault(parent, {})[path] = info
    files = max(by_parent.values(), key=len, default={})
    kinds = {path: path.rpartition("/")[0] for path in files}  # folders; "" of texts
    wanted = [""]
    for patterns in (FORMATS["neural_rgbd"].color, FORMATS["neural_rgbd"].depth):
        folders = (pattern.rpartition("/")[0] for pattern in patterns)
        wanted += [folder for folder in folders if folder in kinds.values()][:1]  # the first
    if len(wanted) < 3:
        found = f"{source} has no images and depth in a folder {name!r}"
        raise MissingError(f"{found}: name the dataset's own ZIP file with --url")
    return {path: info for path, info in files.items() if kinds[path] in wanted}


def _is_missing(file: Path, info: zipfile.ZipInfo) -> bool:
    """Whether a file is not there, or only in part. Raises DataError where it is another one."""
    content = file.read_bytes() if file.is_file() else b""
    if (len(content), zlib.crc32(content)) == (info.file_size, info.CRC):
        return False
    if len(content) >= info.file_size:
        raise DataError(f"{file} is not the dataset's: move it away, and run the command again")
    return True
