"""ScanNet (Dai et al. 2017) as its SensReader exports a scan.

    color/0.jpg ...                  8-bit colour, larger than depth; resized to it here
    depth/0.png ...                  16-bit millimetres, 0 = no measurement
    pose/0.txt ...                   4x4, camera-to-world, OpenCV camera axes; -inf = no pose
    intrinsic/intrinsic_depth.txt    4x4 camera matrix of the depth images

Source: the ScanNet repository, SensReader; colour and depth share one view after the export.
"""

from pathlib import Path

from nbtrack.data.readers.base import Format, Request, register
from nbtrack.data.readers.calibration import read_calibration
from nbtrack.data.readers.declaration import Declaration
from nbtrack.data.readers.frame_files import check_paired, numbered_files
from nbtrack.data.readers.pose_files import read_pose_folder
from nbtrack.data.readers.recording import Recording

_NEEDED = "the ScanNet layout"


def _open(folder: Path, declared: Declaration, request: Request) -> Recording:
    color_files = numbered_files(folder / "color", "0.jpg, 1.jpg, ...")
    depth_files = numbered_files(folder / "depth", "0.png, 1.png, ...")
    check_paired(folder, color_files, depth_files, "depth maps")
    pose_folder = folder / "pose"
    pose_files = numbered_files(pose_folder, "0.txt, 1.txt, ...", suffixes=(".txt",))
    check_paired(folder, color_files, pose_files, "poses")
    camera_file = folder / "intrinsic" / "intrinsic_depth.txt"
    return Recording(
        folder, color_files, depth_files, read_pose_folder(pose_files, _NEEDED), pose_folder,
        read_calibration(camera_file, _NEEDED), declared, [*pose_files, camera_file],
        resize_color=True,
    )  # fmt: skip


register(Format("scannet", "ScanNet export", ("color", "depth", "pose", "intrinsic"), _open))
