"""Recordings of phones with LiDAR, by two apps, whose cameras have ARKit's axes and units.

Poses are camera-to-world in metres with OpenGL's axes (x right, y up, z towards the viewer).
Principal points count from the frame's upper left corner, as those of Apple's
`ARCamera.intrinsics` do.

Record3D: an .r3d file, unpacked as the ZIP file that it is. `metadata` is JSON: K, the colour
images' camera matrix column by column, their size w and h, and a pose qx qy qz qw tx ty tz a
frame. `rgbd/N.depth` holds metres as float32, row by row in colour's proportions, compressed by
LZFSE. Sources: the app's author, github.com/marek-simonik/record3d, issues 18, 33, 36 and 93; K's
order as viser's `Record3dLoader` reads it.

Polycam's raw data, the export of its developer mode: files are named after their time in
microseconds. `cameras/*.json` hold fx, fy, cx, cy of images of width and height, and t_00 to t_23,
the rows of a pose; `corrected_cameras` the same after the app's optimisation, which comes with
`corrected_images`, whose lens is taken out. Depth is 16-bit PNG in millimetres. Sources:
github.com/PolyCam/polyform, README and `core/capture_folder.py`.
"""

from pathlib import Path

import numpy as np

from nbtrack.core.arrays import DepthImage, Poses
from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.files import naming_damaged
from nbtrack.data.text_files import Times, from_quaternions, read_object
from nbtrack.recordings.calibration import Calibration, calibration, camera_matrix
from nbtrack.recordings.formats import FORMATS, Declaration, Format

_ADVICE = "export the recording again, as .r3d which is to be unpacked, or as raw data"


def _camera(path: Path, numbers: list[float], size: tuple[float, float]) -> Calibration:
    """The camera of fx, fy, cx, cy as the apps write them, for images of a width and height."""
    fx, fy, cx, cy = numbers
    K = camera_matrix(fx, fy, cx - 0.5, cy - 0.5)
    return calibration(path, K, size=(int(size[0]), int(size[1])))


def _record3d_poses(path: Path, order: str) -> tuple[Poses, Times | None]:
    """The poses, and the times (s) of their frames; the `order` of quaternions is the app's."""
    content = read_object(path, "JSON")
    with naming_damaged(path, "Record3D metadata", _ADVICE):
        rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        times = np.array(content.get("frameTimestamps", ()), dtype=np.float64)
        if times.shape != (len(rows),) or not np.isfinite(times).all():
            times = np.arange(len(rows)) / float(content["fps"])
        rows = np.column_stack([times, rows[:, 4:], rows[:, :4]])
        return from_quaternions(rows, "xyzw", path), times


def _record3d_camera(path: Path) -> Calibration:
    """The first frame's, as the app writes it; later ones move by a pixel or two."""
    content = read_object(path, "JSON")
    with naming_damaged(path, "Record3D metadata", _ADVICE):
        fx, _, _, _, fy, _, cx, cy, _ = map(float, content["K"])
        return _camera(path, [fx, fy, cx, cy], (content["w"], content["h"]))


def _record3d_depth(path: Path, camera: Calibration) -> DepthImage:
    """Millimetres. LZFSE is no part of Python: `liblzfse` reads it, where that is installed."""
    content = path.read_bytes()
    if content[:3] == b"bvx":  # how LZFSE's blocks begin
        try:
            import liblzfse
        except ImportError:
            raise MissingError(
                f"{path} is compressed by LZFSE: run `pip install pyliblzfse`, or put 16-bit PNG "
                "files in millimetres into depth/ in place of the .depth files"
            ) from None
        with naming_damaged(path, "LZFSE file", _ADVICE):
            content = liblzfse.decompress(content)
    width, height = camera.size
    columns = round(np.sqrt(len(content) / 4 * width / height))
    rows = round(columns * height / width)
    if not columns or rows * columns * 4 != len(content):
        raise DataError(
            f"{path} holds {len(content)} bytes: it must be float32 depth in the proportions of "
            f"{width}x{height}; {_ADVICE}"
        )
    depth_mm = 1000 * np.nan_to_num(np.frombuffer(content, "<f4").reshape(rows, columns))
    return np.rint(depth_mm.clip(0, 65535)).astype(np.uint16)


def _corrected(path: Path) -> Path:
    """Polycam's optimised camera of a frame, where the app has made one."""
    corrected = path.parent.parent / "corrected_cameras" / path.name
    return corrected if corrected.is_file() else path


def _polycam_pose(path: Path, order: str) -> tuple[Poses, Times | None]:
    """A frame's pose and its time (s); there are no quaternions whose `order` would count."""
    content = read_object(_corrected(path))
    with naming_damaged(path, "Polycam camera", _ADVICE):
        pose = np.eye(4)
        pose[:3] = [[float(content[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
        return pose[None], np.array([int(path.stem) / 1e6])


def _polycam_camera(path: Path) -> Calibration:
    """The median of all frames' cameras, which differ by a pixel or two."""
    contents = [read_object(_corrected(file)) for file in sorted(path.parent.glob("*.json"))]
    with naming_damaged(path, "Polycam camera", _ADVICE):
        names = ("fx", "fy", "cx", "cy", "width", "height")
        numbers = [[float(content[name]) for name in names] for content in contents]
        *numbers, width, height = np.median(numbers, axis=0).tolist()
        return _camera(path, numbers, (width, height))


_FILES = ("keyframes/cameras/*.json",)
FORMATS["polycam"] = Format(
    "Polycam raw data", color=("keyframes/corrected_images/*", "keyframes/images/*"),
    depth=("keyframes/depth/*",), poses=_FILES, cameras=_FILES,
    declared=Declaration(camera_axes="opengl"),
    read_poses=_polycam_pose, read_camera=_polycam_camera,
)  # fmt: skip
_FILES = ("metadata", "metadata.json")
FORMATS["record3d"] = Format(
    "Record3D", color=("rgbd/*", "rgb/*"), depth=("rgbd/*.depth", "depth/*"), poses=_FILES,
    cameras=_FILES, declared=Declaration(camera_axes="opengl"), counts_from_0=True,
    stamps_tell=False, read_poses=_record3d_poses, read_camera=_record3d_camera,
    read_depth=_record3d_depth,
)  # fmt: skip
