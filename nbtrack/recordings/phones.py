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

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nbtrack.core.arrays import DepthImage, Poses
from nbtrack.machinery.files import naming_damaged
from nbtrack.machinery.inputs import read_object
from nbtrack.recordings.calibration import Calibration, calibration, camera_matrix
from nbtrack.recordings.formats import Declaration, Format
from nbtrack.recordings.pose_files import Times, from_quaternions

_ADVICE_ON_DEPTH = "run `pip install pyliblzfse`, or put 16-bit PNG files (mm) into depth/ instead"


def _camera(path: Path, numbers: Sequence[float]) -> Calibration:
    """The camera of fx, fy, cx, cy, width and height as the apps write them."""
    fx, fy, cx, cy, width, height = numbers
    # The apps count from the first pixel's corner, a camera matrix of OpenCV's from its centre.
    return calibration(path, camera_matrix(fx, fy, cx - 0.5, cy - 0.5), (int(width), int(height)))


def _record3d_poses(path: Path, order: str) -> tuple[Poses, Times]:
    """The poses and their frames' times (s); `order` is not used: the app always writes xyzw."""
    content = read_object(path, "JSON")
    rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)  # qx qy qz qw tx ty tz
    times = np.array(content.get("frameTimestamps", ()), dtype=np.float64)
    if times.shape != (len(rows),) or not np.isfinite(times).all():
        times = np.arange(len(rows)) / float(content["fps"])
    return from_quaternions(np.column_stack([times, rows[:, 4:], rows[:, :4]]), "xyzw", path)


def _record3d_camera(path: Path) -> Calibration:
    """The camera of the first frame, which the app writes; later ones move by a pixel or two."""
    content = read_object(path, "JSON")
    # The matrix, column by column.
    fx, _, _, _, fy, _, cx, cy, _ = np.array(content["K"], dtype=np.float64)
    return _camera(path, [fx, fy, cx, cy, content["w"], content["h"]])


def _record3d_depth(content: bytes, path: Path, camera: Calibration) -> DepthImage:
    """Depth in millimetres; 0 where there is none, 65535 where it is farther than 16 bits can say.

    LZFSE is no part of Python: `liblzfse` reads it, where that is installed.
    """
    kind = "file of float32 depth, plain or by LZFSE, in the proportions of colour"
    with naming_damaged(path, kind, _ADVICE_ON_DEPTH):
        if content[:3] == b"bvx":  # how LZFSE's blocks begin
            import liblzfse

            content = liblzfse.decompress(content)
        metres = np.frombuffer(content, "<f4")
        width, height = camera.size
        # The file does not say its size: its rows follow from the proportions of colour.
        depth_mm = 1000 * metres.reshape(round(np.sqrt(metres.size * height / width)), -1)
        return np.rint(np.nan_to_num(depth_mm).clip(0, 65535)).astype(np.uint16)


def _corrected(path: Path) -> Path:
    """Polycam's optimised camera file of a frame; `path` itself where the app has made none."""
    corrected = path.parent.parent / "corrected_cameras" / path.name
    return corrected if corrected.is_file() else path


def _polycam_pose(path: Path, order: str) -> tuple[Poses, Times]:
    """A frame's pose and its time (s), which names the file in microseconds.

    `order` is not used: the poses are matrices.
    """
    content = read_object(_corrected(path), "JSON")
    pose = np.eye(4)
    pose[:3] = [[float(content[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
    return pose[None], np.array([int(path.stem) / 1e6])


def _polycam_camera(path: Path) -> Calibration:
    """The median of all frames' cameras, which differ by a pixel or two; `path` is any of them."""
    rows = []
    for file in map(_corrected, sorted(path.parent.glob("*.json"))):
        with naming_damaged(file, "camera of Polycam", "export the recording again"):
            content, names = read_object(file, "JSON"), ("fx", "fy", "cx", "cy", "width", "height")
            rows.append([float(content[name]) for name in names])
    return _camera(path, np.median(rows, axis=0).tolist())


_POLYCAM_FILES = ("keyframes/cameras/*.json",)
POLYCAM = Format(
    "Polycam raw data", color=("keyframes/corrected_images/*", "keyframes/images/*"),
    depth=("keyframes/depth/*",), poses=_POLYCAM_FILES, cameras=_POLYCAM_FILES,
    declared=Declaration(camera_axes="opengl"),
    read_poses=_polycam_pose, read_camera=_polycam_camera,
)  # fmt: skip
_RECORD3D_FILES = ("metadata", "metadata.json")
RECORD3D = Format(
    "Record3D", color=("rgbd/*", "rgb/*"), depth=("rgbd/*.depth", "depth/*"),
    poses=_RECORD3D_FILES, cameras=_RECORD3D_FILES,
    # Pose N of the list is that of image N, whatever its time.
    declared=Declaration(camera_axes="opengl"), counts_from_0=True, stamps_tell=False,
    read_poses=_record3d_poses, read_camera=_record3d_camera, read_depth=_record3d_depth,
)  # fmt: skip
