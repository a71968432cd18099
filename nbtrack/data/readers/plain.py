"""A plain folder of an own recording.

    color/, depth/       images with the same frame numbers; 16-bit depth, millimetres
    intrinsics.json      width, height, fx, fy, cx, cy; or intrinsics.txt: `fx fy cx cy` or 3x3
    trajectory.txt       poses, or poses.txt: `timestamp tx ty tz qx qy qz qw` a line, or 16 or 12
                         numbers a line; or poses/ with one 4x4 matrix a frame
    sequence.toml        whatever differs: depth scale, camera axes, direction, quaternion order

Poses are camera-to-world in metres with OpenCV camera axes. A pose file has a line for every frame,
in their order; one in TUM's format may leave frames out if its timestamps are frame numbers divided
by the frame rate, as nbtrack's own trajectories have them.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import read_calibration
from nbtrack.data.readers.declaration import Declaration
from nbtrack.data.readers.frame_files import check_paired, frame_number, numbered_files
from nbtrack.data.readers.pose_files import blocks, from_quaternions, read_pose_folder
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file, read_numbers

_NEEDED = "a plain recording"
_CALIBRATION_FILES = (
    "intrinsics.json", "intrinsics.txt", "intrinsic.json", "camera_intrinsic.json"
)  # fmt: skip
_POSE_FILES = ("trajectory.txt", "poses.txt")
_MEANING = "'timestamp tx ty tz qx qy qz qw', or 16 or 12 numbers of a matrix"


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    color_files = numbered_files(folder / "color", "000000.png, 000001.png, ...")
    depth_files = numbered_files(
        folder / (request.depth_folder or "depth"), "000000.png, 000001.png, ..."
    )
    check_paired(folder, color_files, depth_files, "depth maps")
    cameras = [folder / name for name in _CALIBRATION_FILES]
    camera_file = next((path for path in cameras if is_file(path)), cameras[0])
    calibration = read_calibration(camera_file, _NEEDED)
    names = [request.pose_file] if request.pose_file else _POSE_FILES
    files = [folder / name for name in names if is_file(folder / name)]
    if len(files) > 1:
        raise DataError(
            f"{folder} has {' and '.join(file.name for file in files)}: choose with --poses, or "
            "remove one"
        )
    if files:
        poses, pose_file, texts = _from_table(files[0], color_files, declared), files[0], files
    else:
        pose_file = folder / (request.pose_file or "poses")
        if not pose_file.is_dir():
            raise MissingError(
                f"no poses in {folder}: it needs {' or '.join(names)}, or a folder poses/ with a "
                "4x4 matrix a frame"
            )
        texts = numbered_files(pose_file, "000000.txt, 000001.txt, ...", suffixes=(".txt",))
        check_paired(folder, color_files, texts, "poses")
        poses = read_pose_folder(texts, _NEEDED)
    return Recording(
        folder, color_files, depth_files, poses, pose_file, calibration, declared,
        [*texts, camera_file], resize_color=False,
    )  # fmt: skip


def _from_table(
    path: Path, color_files: list[Path], declared: Declaration
) -> Float[np.ndarray, "poses 4 4"]:
    numbers = read_numbers(path, (8, 12, 16), _MEANING, _NEEDED)
    if numbers.shape[1] != 8:
        return blocks(numbers, path)
    poses = from_quaternions(numbers[:, 1:], declared.quaternion, path)
    if len(poses) == len(color_files):
        return poses
    # Frame numbers, if the timestamps are nothing else.
    frames = numbers[:, 0].clip(-1, 1e9) * declared.frame_rate
    first = frame_number(color_files[0]) or 0
    known = {(frame_number(file) or 0) - first: i for i, file in enumerate(color_files)}
    whole = np.abs(frames - np.rint(frames)) < 0.01
    if not (whole & np.isin(np.rint(frames), list(known))).all():
        return poses  # the caller tells that their number is wrong
    placed = np.full((len(color_files), 4, 4), np.nan)
    placed[[known[int(frame)] for frame in np.rint(frames)]] = poses
    return placed


register(Format(
    "plain", "plain folder",
    ("color", "depth", "intrinsics.*|intrinsic.json|camera_intrinsic.json",
     "trajectory.txt|poses.txt|poses"),
    _open,
))  # fmt: skip
