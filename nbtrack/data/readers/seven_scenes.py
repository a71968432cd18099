"""The RGB-D dataset 7-Scenes (Shotton et al. 2013): one folder a sequence, such as chess/seq-01.

    frame-000000.color.png   8-bit colour
    frame-000000.depth.png   16-bit millimetres; 65535 = no measurement
    frame-000000.pose.txt    4x4, camera-to-world, OpenCV camera axes

Colour and depth come from two cameras 25 mm apart and are not registered to each other; the
dataset gives no calibration for it. Source: the dataset's page, which states focal length 585 and
principal point (320, 240), taken here as the middle of the image.
"""

from pathlib import Path

from nbtrack.core.errors import MissingError
from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import Calibration, read_calibration
from nbtrack.data.readers.declaration import Declaration
from nbtrack.data.readers.frame_files import check_paired, numbered_files
from nbtrack.data.readers.pose_files import read_pose_folder
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file

_NEEDED = "the 7-Scenes layout"
_FOCAL = 585.0
_SIZE = (640, 480)


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    if not any(folder.glob("*.color.png")) and any(folder.glob("seq-*")):
        raise MissingError(
            f"{folder} holds a whole scene of 7-Scenes: give one of its sequences, such as "
            f"{sorted(folder.glob('seq-*'))[0]}"
        )
    color_files = numbered_files(folder, "frame-000000.color.png", "*.color.*")
    depth_files = numbered_files(folder, "frame-000000.depth.png", "*.depth.*")
    check_paired(folder, color_files, depth_files, "depth maps")
    pose_files = numbered_files(folder, "frame-000000.pose.txt", "*.pose.txt", (".txt",))
    check_paired(folder, color_files, pose_files, "poses")
    poses = read_pose_folder(pose_files, _NEEDED)
    own = folder / "intrinsics.txt"
    calibration = Calibration(folder, _FOCAL, _FOCAL, None, _SIZE)
    if is_file(own):
        calibration = read_calibration(own, _NEEDED)
    return Recording(
        folder, color_files, depth_files, poses, folder, calibration, declared,
        pose_files + [own] * is_file(own),
    )  # fmt: skip


register(Format(
    "7scenes", "7-Scenes", ("*.color.png|seq-*", "*.depth.png|seq-*", "*.pose.txt|seq-*"), _open,
    Declaration(no_depth=65535),
))  # fmt: skip
