"""Replica as rendered for iMAP and shared with NICE-SLAM: one folder a scene.

    traj.txt                      16 numbers a line: camera-to-world, OpenCV camera axes
    results/frame000000.jpg ...   8-bit colour
    results/depth000000.png ...   16-bit depth, 6553.5 a metre
    cam_params.json               here or one folder up: w, h, fx, fy, cx, cy, scale in `camera`

Source: NICE-SLAM's loader, which turns the y and z axes of these poses to reach OpenGL's.
"""

from pathlib import Path

from nbtrack.core.errors import DataError
from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import read_calibration
from nbtrack.data.readers.declaration import DECLARATION_FILE, Declaration
from nbtrack.data.readers.frame_files import check_paired, numbered_files
from nbtrack.data.readers.pose_files import blocks
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file, read_json, read_numbers

_NEEDED = "the Replica layout"
_SCALE = 6553.5


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    results = folder / "results"
    color_files = numbered_files(results, "frame000000.jpg", "frame*")
    depth_files = numbered_files(results, "depth000000.png", "depth*")
    check_paired(folder, color_files, depth_files, "depth maps")
    pose_file = folder / (request.pose_file or "traj.txt")
    meaning = "16 numbers, a camera-to-world matrix"
    numbers = read_numbers(pose_file, (16,), meaning, _NEEDED)
    own = folder / "cam_params.json"
    camera_file = own if is_file(own) else folder.resolve().parent / own.name
    calibration = read_calibration(camera_file if is_file(camera_file) else own, _NEEDED)
    _check_scale(camera_file, declared)
    return Recording(
        folder, color_files, depth_files, blocks(numbers, pose_file), pose_file, calibration,
        declared, [pose_file, camera_file],
    )  # fmt: skip


def _check_scale(path: Path, declared: Declaration) -> None:
    """The file's own depth scale must be the one in use: two that differ are a guess."""
    content = read_json(path, _NEEDED)
    camera = content["camera"] if isinstance(content.get("camera"), dict) else content
    scale = camera.get("scale", declared.depth_scale)
    if scale != declared.depth_scale:
        raise DataError(
            f"{path}: scale is {str(scale)[:40]!r} but {declared.depth_scale:g} depth values a "
            f"metre are in use: correct scale, or set depth_scale in {DECLARATION_FILE} to it"
        )


register(Format(
    "replica", "Replica (NICE-SLAM)", ("traj.txt", "results"), _open,
    Declaration(depth_scale=_SCALE),
))  # fmt: skip
