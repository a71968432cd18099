"""Formats of recordings besides the dataset's: they join as one of your own does.

data/README.md describes them all.
"""

from pathlib import Path

from nbtrack.data.formats import FORMATS, Declaration, Format
from nbtrack.data.text_files import Calibration

_VGA = (640, 480)
# The benchmark's own calibrations of its three cameras. Their lenses are not corrected: its page on
# the Kinect's calibration says that the driver has done so, and laid depth on colour by the pixel.
_TUM_CAMERAS = (
    Calibration(Path("freiburg1"), 517.3, 516.5, (319.1, 255.8), _VGA),
    Calibration(Path("freiburg2"), 520.9, 521.0, (325.6, 250.2), _VGA),
    Calibration(Path("freiburg3"), 535.4, 539.2, (320.6, 248.1), _VGA),
)  # fmt: skip
FORMATS |= {
    # Sturm et al. 2012. The depth maps carry their scale correction already.
    "tum": Format(
        "TUM RGB-D", color=("rgb.txt",), depth=("depth.txt",), poses=("groundtruth.txt",),
        cameras=("intrinsics.json", "intrinsics.txt", "calibration.txt"),
        known_cameras=_TUM_CAMERAS, declared=Declaration(depth_scale=5000.0),
    ),
    # As rendered for iMAP and shared with NICE-SLAM, whose loader turns the y and z axes of these
    # poses to reach OpenGL's.
    "replica": Format(
        "Replica (NICE-SLAM)", color=("results/frame*",), depth=("results/depth*",),
        poses=("traj.txt",), cameras=("cam_params.json", "../cam_params.json"),
        declared=Declaration(depth_scale=6553.5), counts_from_0=True,
    ),
    # Shotton et al. 2013. Colour and depth come from two cameras 25 mm apart that the dataset does
    # not register. Its page states the focal length and the principal point (320, 240), taken here
    # as the middle of the image.
    "7scenes": Format(
        "7-Scenes", color=("*.color.*",), depth=("*.depth.*",), poses=("*.pose.txt",),
        cameras=("intrinsics.txt", "camera-intrinsics.txt", "../camera-intrinsics.txt"),
        declared=Declaration(no_depth=65535),
        known_cameras=(Calibration(Path(), 585.0, 585.0, None, _VGA),),
    ),
    # Dai et al. 2017, as SensReader exports a scan: one view, colour larger than depth.
    "scannet": Format(
        "ScanNet export", color=("color/*",), depth=("depth/*",), poses=("pose/*.txt",),
        cameras=("intrinsic/intrinsic_depth.txt",), resize_color=True,
    ),
    # A folder of an own recording, or of Open3D's: image/, .log and the last three cameras.
    "plain": Format(
        "plain folder", color=("color/*", "image/*"), depth=("depth/*",),
        poses=("trajectory.txt", "poses.txt", "poses/*.txt", "trajectory.log"),
        cameras=("intrinsics.json", "intrinsics.txt", "K.txt",
                 "intrinsic.json", "camera_intrinsic.json", "camera_primesense.json"),
    ),
}  # fmt: skip
