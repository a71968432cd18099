"""The Neural RGB-D layout (Azinovic et al. 2022), one folder a scene; data/README.md describes it.

images/img0.png ...             8-bit colour
depth_filtered/depth0.png ...   uint16 millimetres along the optical axis, 0 = no measurement
depth/, depth_with_noise/       the same, clean and noisy, where a scene has them
focal.txt                       one number, pixels; the principal point is the image's middle
intrinsics.txt                  instead of it, an addition of this package: a camera matrix
poses.txt, trainval_poses.txt   camera-to-world, four rows a frame, OpenGL camera axes
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import Calibration, is_focal, read_calibration
from nbtrack.data.readers.declaration import Declaration
from nbtrack.data.readers.frame_files import check_paired, numbered_files
from nbtrack.data.readers.pose_files import blocks
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file, read_numbers, read_text

# Which depth to read when the caller does not say: filtered is what the dataset's own loader and
# most users of the dataset take; the others serve scenes that lack it.
DEPTH_FOLDERS = ("depth_filtered", "depth", "depth_with_noise")
FOCAL_FILE, INTRINSICS_FILE = "focal.txt", "intrinsics.txt"
_NEEDED = "the Neural RGB-D layout"


def read_focal(path: Path) -> float:
    """Focal length (pixels) from `focal.txt`. Raises DataError unless it is a positive number."""
    text = read_text(path, _NEEDED).strip()
    try:
        focal = float(text)
    except ValueError:
        focal = float("nan")
    if not is_focal(focal):
        raise DataError(
            f"{path} holds {text[:40]!r}: it must be one positive number, "
            "the focal length in pixels"
        )
    return focal


def read_poses(path: Path) -> Float[np.ndarray, "frames 4 4"]:
    """Camera-to-world matrices as they stand in the file (OpenGL camera axes, NaN kept).

    Raises:
        DataError: a row has not four numbers, or the rows do not divide into blocks of four.
    """
    meaning = "four numbers (camera-to-world, four rows a frame)"
    return blocks(read_numbers(path, (4,), meaning, _NEEDED), path)


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    color_files = numbered_files(folder / "images", "img0.png, img1.png, ...")
    candidates = [request.depth_folder] if request.depth_folder else list(DEPTH_FOLDERS)
    found = [name for name in candidates if (folder / name).is_dir()]
    if not found:
        raise MissingError(f"no depth in {folder}: it needs a folder {' or '.join(candidates)}")
    depth_files = numbered_files(folder / found[0], "depth0.png, depth1.png, ...")
    check_paired(folder, color_files, depth_files, "depth maps")
    pose_file = folder / (request.pose_file or "poses.txt")
    calibration = _calibration(folder)
    return Recording(
        folder, color_files, depth_files, read_poses(pose_file), pose_file, calibration, declared,
        [pose_file, calibration.source],
    )  # fmt: skip


def _calibration(folder: Path) -> Calibration:
    matrix = folder / INTRINSICS_FILE
    if is_file(matrix):
        return read_calibration(matrix, _NEEDED)
    focal = read_focal(folder / FOCAL_FILE)
    return Calibration(folder / FOCAL_FILE, focal, focal)


register(Format(
    "neural_rgbd", "Neural RGB-D", ("images", "focal.txt|intrinsics.txt", "poses.txt"), _open,
    Declaration(camera_axes="opengl"),
))  # fmt: skip
