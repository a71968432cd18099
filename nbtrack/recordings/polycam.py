"""Polycam's raw data, the export of its developer mode.

Files are named after their time in microseconds. `cameras/*.json` hold fx, fy, cx, cy of images of
width and height, and t_00 to t_23, the rows of a camera-to-world matrix in metres with ARKit's axes
(x right, y up, z towards the viewer); `corrected_cameras` the same after the app's optimisation,
which comes with `corrected_images`, whose lens is taken out. Depth is 16-bit PNG in millimetres.
Sources: github.com/PolyCam/polyform, README and `core/capture_folder.py`. Principal points count
from the frame's upper left corner, as those of Apple's `ARCamera.intrinsics` do.
"""

from pathlib import Path

import numpy as np

from nbtrack.core.arrays import Poses
from nbtrack.core.files import naming_damaged
from nbtrack.data.text_files import Times, read_object
from nbtrack.recordings.calibration import Calibration, checked_camera
from nbtrack.recordings.formats import FORMATS, Declaration, Format

_ADVICE = "export the raw data again"


def _corrected(path: Path) -> Path:
    """The optimised camera of a frame, where the app has made one."""
    corrected = path.parent.parent / "corrected_cameras" / path.name
    return corrected if corrected.is_file() else path


def _read_pose(path: Path, order: str) -> tuple[Poses, Times | None]:
    """A frame's pose and its time (s); there are no quaternions whose `order` would count."""
    content = read_object(_corrected(path))
    with naming_damaged(path, "Polycam camera", _ADVICE):
        pose = np.eye(4)
        pose[:3] = [[float(content[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
        return pose[None], np.array([int(path.stem) / 1e6])


def _read_camera(path: Path) -> Calibration:
    """The median of all frames' cameras, which differ by a pixel or two."""
    files = [_corrected(file) for file in sorted(path.parent.glob("*.json"))]
    with naming_damaged(path, "Polycam camera", _ADVICE):
        names = ("fx", "fy", "cx", "cy", "width", "height")
        contents = [read_object(file) for file in files]
        numbers = [[float(content[name]) for name in names] for content in contents]
        fx, fy, cx, cy, width, height = np.median(numbers, axis=0).tolist()
        return checked_camera(Calibration(path, fx, fy, (cx, cy), (int(width), int(height))))


FORMATS["polycam"] = Format(
    "Polycam raw data", color=("keyframes/corrected_images/*", "keyframes/images/*"),
    depth=("keyframes/depth/*",), poses=("keyframes/cameras/*.json",),
    cameras=("keyframes/cameras/*.json",), declared=Declaration(camera_axes="opengl"),
    read_poses=_read_pose, read_camera=_read_camera,
)  # fmt: skip
