"""Recordings of phones with LiDAR by two apps, Record3D and Polycam.

In both, poses are camera-to-world in metres with ARKit's camera axes, which are OpenGL's (x right,
y up, z towards the viewer). Principal points count from the image's upper left corner, as those of
Apple's `ARCamera.intrinsics` do.

Record3D writes an .r3d file; this is a ZIP file, which the user has unpacked. `metadata` is JSON
with the camera matrix K of the colour images column by column, their size w and h, and for each
frame a pose qx qy qz qw tx ty tz. `rgbd/N.depth` holds metres as float32, row by row, in the
proportions of colour, compressed by LZFSE. Sources: the app's author,
github.com/marek-simonik/record3d, issues 18, 33, 36 and 93; for the order of K viser's
`Record3dLoader`.

Polycam writes raw data in its developer mode. Files are named after their time in microseconds.
`cameras/*.json` hold fx, fy, cx, cy, the width and height of the images, and the rows of a pose as
t_00 to t_23. `corrected_cameras` hold the same after the app's optimisation; `corrected_images`
come with them and have no distortion. Depth is 16-bit PNG in millimetres. Sources:
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
_CAMERA_ENTRIES = ("fx", "fy", "cx", "cy", "width", "height")  # of Polycam's files


def _camera(path: Path, numbers: Sequence[float]) -> Calibration:
    """The camera of fx, fy, cx, cy, width and height (pixels) as the apps write them."""
    fx, fy, cx, cy, width, height = numbers
    # The apps count from the corner of the first pixel, OpenCV's camera matrix from its centre.
    return calibration(path, camera_matrix(fx, fy, cx - 0.5, cy - 0.5), (int(width), int(height)))


def _record3d_poses(path: Path, order: str) -> tuple[Poses, Times]:
    """The poses and times (s) of all frames.

    `order`, which every reader of poses takes, is not used: the app always writes xyzw.
    """
    content = read_object(path, "JSON")
    rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)  # qx qy qz qw tx ty tz
    times = np.array(content.get("frameTimestamps", ()), dtype=np.float64)
    # Without a time for each frame, frame numbers and the rate give the times.
    if times.shape != (len(rows),) or not np.isfinite(times).all():
        times = np.arange(len(rows)) / float(content["fps"])
    return from_quaternions(np.column_stack([times, rows[:, 4:], rows[:, :4]]), "xyzw", path)


def _record3d_camera(path: Path) -> Calibration:
    """The camera of the first frame, the only one that the app writes.

    The principal points of later frames differ by a pixel or two.
    """
    content = read_object(path, "JSON")
    # The matrix is stored column by column.
    fx, _, _, _, fy, _, cx, cy, _ = np.array(content["K"], dtype=np.float64)
    return _camera(path, [fx, fy, cx, cy, content["w"], content["h"]])


def _record3d_depth(content: bytes, path: Path, camera: Calibration) -> DepthImage:
    """Depth in millimetres from the content of a file.

    It is 0 where none is measured, and 65535 where it is farther than 16 bits can say. Raises
    DataError for other content, and if the package `liblzfse`, which decompresses LZFSE, is not
    installed.
    """
    kind = "file of float32 depth, plain or by LZFSE, in the proportions of colour"
    with naming_damaged(path, kind, _ADVICE_ON_DEPTH):
        if content[:3] == b"bvx":  # every block of LZFSE begins so
            import liblzfse

            content = liblzfse.decompress(content)
        metres = np.frombuffer(content, "<f4")
        width, height = camera.size
        # The file does not say its size. The number of its rows follows from colour's proportions.
        n_rows = round(np.sqrt(metres.size * height / width))
        depth_mm = 1000 * metres.reshape(n_rows, -1)
        return np.rint(np.nan_to_num(depth_mm).clip(0, 65535)).astype(np.uint16)


def _corrected(path: Path) -> Path:
    """The file of a frame's optimised camera beside `path`; `path` itself if there is none."""
    corrected = path.parent.parent / "corrected_cameras" / path.name
    return corrected if corrected.is_file() else path


def _polycam_pose(path: Path, order: str) -> tuple[Poses, Times]:
    """The pose of a frame and its time (s); the file is named after this time in microseconds.

    `order`, which every reader of poses takes, is not used: the poses are matrices.
    """
    content = read_object(_corrected(path), "JSON")
    pose = np.eye(4)
    pose[:3] = [[float(content[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
    return pose[None], np.array([int(path.stem) / 1e6])


def _polycam_camera(path: Path) -> Calibration:
    """The median of the cameras of all frames, which differ by a pixel or two.

    `path` is the file of any frame; the others lie beside it.
    """
    rows = []
    for file in map(_corrected, sorted(path.parent.glob("*.json"))):
        with naming_damaged(file, "camera of Polycam", "export the recording again"):
            content = read_object(file, "JSON")
            rows.append([float(content[name]) for name in _CAMERA_ENTRIES])
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
    # Pose N of the list belongs to image N, whatever its time is.
    declared=Declaration(camera_axes="opengl"), counts_from_0=True, stamps_tell=False,
    read_poses=_record3d_poses, read_camera=_record3d_camera, read_depth=_record3d_depth,
)  # fmt: skip
