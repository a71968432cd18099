"""Formats of recordings, and which one a folder has; data/README.md describes them.

`FORMATS` is one table of layouts and conventions. A format of one's own is one more entry. What a
recording does otherwise than its format, it says in `sequence.toml`: any field of `Declaration`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import is_zipfile

import numpy as np

from nbtrack.core.arrays import DepthImage, Poses
from nbtrack.data.dataset import DATASET_UNITS
from nbtrack.machinery.errors import ConfigError, DataError, MissingError, look_up
from nbtrack.machinery.files import absolute
from nbtrack.machinery.inputs import read_object
from nbtrack.machinery.registry import Registry
from nbtrack.machinery.settings import limited, one_of, with_values
from nbtrack.recordings.calibration import Calibration, read_calibration
from nbtrack.recordings.pose_files import Times, frame_keys, read_poses

DECLARATION_FILE = "sequence.toml"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
CAMERA_TO_WORLD = "camera-to-world"
WORLD_TO_CAMERA = "world-to-camera"
SPELLED_AXES = {"opencv": "right down forward", "opengl": "right up backward"}
# Where an axis may point, seen from behind the camera, in OpenCV's x, y and z. `0 -` gives no -0.0.
_DIRECTIONS = dict(zip(("right", "down", "forward"), np.eye(3), strict=True))
_DIRECTIONS |= dict(zip(("left", "up", "backward"), 0 - np.eye(3), strict=True))


@dataclass(frozen=True)
class Declaration:
    """How the numbers of a recording are meant; limits are far beyond any camera's."""

    format: str = ""  # empty: told by the files
    depth_scale: float = limited(1000.0, 1e-8, 1e8)  # depth values a metre
    no_depth: int = limited(0, 0, 65535)  # a value that means "not measured", besides 0
    depth_along: str = one_of("axis", "ray")  # the optical axis (z-depth), or the ray (distance)
    # 1/m, of true depth = m + depth_error_per_m * m² where m is measured. The bound keeps 65 m > 0.
    depth_error_per_m: float = limited(0.0, -0.015, 0.015)
    camera_axes: str = "opencv"  # or "opengl", or where x, y, z point: "right up forward"
    poses: str = one_of(CAMERA_TO_WORLD, WORLD_TO_CAMERA)
    quaternion: str = one_of("xyzw", "wxyz")  # the order in pose files with quaternions
    frame_rate: float = limited(30.0, 1e-8, 1e8)  # Hz
    metres_per_unit: float = limited(0.0, 0.0, 1e8)  # of the map; 0: half its longest side

    def __post_init__(self) -> None:
        if len(self._axes) != 3 or not np.linalg.det(self._axes):
            raise ConfigError(
                f"camera_axes = {self.camera_axes!r}: write 'opencv', 'opengl', or where x, y and "
                "z point, as in 'right up forward' (of right/left, up/down, forward/backward)"
            )

    @property
    def _axes(self) -> np.ndarray:
        """The file's x, y and z axes (rows) in OpenCV's camera frame; zeros for unknown words."""
        words = SPELLED_AXES.get(self.camera_axes, self.camera_axes).split()
        return np.array([_DIRECTIONS.get(word, np.zeros(3)) for word in words])

    def inverted_if_world_to_camera(self, poses: Poses) -> Poses:
        """The inverse poses if the file's are declared world-to-camera, else a copy; NaN stays NaN.

        So it makes camera-to-world poses of the file's, and the file's of camera-to-world ones.
        """
        inverse = poses.copy()
        if self.poses == WORLD_TO_CAMERA:
            # A transpose, unlike a solver, takes NaN and never fails.
            inverse[:, :3, :3] = poses[:, :3, :3].mT
            inverse[:, :3, 3:] = -inverse[:, :3, :3] @ poses[:, :3, 3:]
        return inverse

    def poses_to_opencv(self, file_poses: Poses) -> Poses:
        """The file's poses as camera-to-world, with OpenCV's camera axes; NaN poses stay NaN."""
        axes = self._axes  # as a matrix, from OpenCV's camera frame to the file's
        T_world_camera = self.inverted_if_world_to_camera(file_poses)
        T_world_camera[:, :3, :3] = T_world_camera[:, :3, :3] @ axes
        # Left-handed camera axes, whose determinant is -1, come with a left-handed world. With the
        # sign of the world's z changed the rotations are proper ones again.
        T_world_camera[:, 2] *= np.linalg.det(axes)
        return T_world_camera


@dataclass(frozen=True)
class Format:
    """One layout of recordings on disk. Paths are patterns within the recording's folder."""

    label: str  # for people
    # Image files, of the first pattern that finds any; or a .txt with `timestamp file` a line.
    color: tuple[str, ...]
    depth: tuple[str, ...]  # the same
    poses: tuple[str, ...]  # a file of all poses, or with `*` one a frame
    cameras: tuple[str, ...]  # calibration files; the first that is there
    # Without such a file, the first whose `source` has a name that occurs in the folder's name.
    known_cameras: tuple[Calibration, ...] = ()
    declared: Declaration = Declaration()  # what its numbers mean
    counts_from_0: bool = False  # a number is the place of the frame's pose in a list
    stamps_tell: bool = True  # poses of a list belong to frames by their times, else by place alone
    resize_color: bool = False  # colour has another size than depth and shows the same view
    # Poses and their times (s; NaN: none) of a file, given the order of its quaternions.
    read_poses: Callable[[Path, str], tuple[Poses, Times]] = read_poses
    read_camera: Callable[[Path], Calibration] = read_calibration
    # Depth values, `depth_scale` a metre, of a depth map that is no PNG or JPEG, given what is in
    # its file, its path for messages, and the camera.
    read_depth: Callable[[bytes, Path, Calibration], DepthImage] | None = None

    @property
    def needs(self) -> tuple[tuple[str, ...], ...]:
        """Groups of patterns; one of each group must be there."""
        cameras = () if self.known_cameras else (self.cameras,)
        return self.color, self.depth, self.poses, *cameras

    def files(self, folder: Path, patterns: Sequence[str], what: str) -> list[Path]:
        """Files of the first pattern that has any, or raises MissingError.

        `what` says in the message which files are missing.
        """
        for pattern in patterns:
            if files := files_of(folder, pattern):
                return files
        needed = f"{self.label} needs {' or '.join(patterns)}"
        advice = "add it, or name another format with --format"
        raise MissingError(f"no {what} in {folder}: {needed}; {advice}")


def files_of(folder: Path, pattern: str) -> list[Path]:
    """The file that is called as the pattern, or those that match it; `img2` before `img10`.

    A pattern without a suffix, or with `.*`, matches images only (`IMAGE_SUFFIXES`).
    """
    if (folder / pattern).is_file():
        return [folder / pattern]
    suffix = Path(pattern).suffix
    suffixes = IMAGE_SUFFIXES if suffix in ("", ".*") else (suffix,)
    paths = (folder / pattern).parent.glob(Path(pattern).name)
    # Hidden files are the system's.
    files = [p for p in paths if p.suffix.lower() in suffixes and p.name[0] != "." and p.is_file()]
    return [path for _, path in sorted(zip(frame_keys(files), files, strict=True))]


_VGA = (640, 480)
# The benchmark's own calibrations of its three cameras, their principal points moved by half a
# pixel, since pixel centres lie at integer + 0.5. Their lenses are not corrected: its page on the
# Kinect's calibration says that the driver has done so, and laid depth on colour by the pixel.
_TUM_CAMERAS = (
    Calibration(Path("freiburg1"), 517.3, 516.5, (319.1, 255.8), _VGA),
    Calibration(Path("freiburg2"), 520.9, 521.0, (325.6, 250.2), _VGA),
    Calibration(Path("freiburg3"), 535.4, 539.2, (320.6, 248.1), _VGA),
)  # fmt: skip
_FORMATS: dict[str, Format | str] = {
    # Azinovic et al. 2022. Filtered depth is what the dataset's own loader takes; intrinsics.txt
    # is an addition of this package.
    "neural_rgbd": Format(
        "Neural RGB-D", color=("images/*",),
        depth=("depth_filtered/*", "depth/*", "depth_with_noise/*"), poses=("poses.txt",),
        cameras=("intrinsics.txt", "focal.txt", "K.txt"),
        declared=Declaration(camera_axes="opengl"), counts_from_0=True,
    ),
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
    # as the middle of the image. `Path()` has an empty name, which occurs in every folder's name.
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
    "polycam": "nbtrack.recordings.phones:POLYCAM",
    "record3d": "nbtrack.recordings.phones:RECORD3D",
}  # fmt: skip
FORMATS: Registry[Format] = Registry(_FORMATS)


def declaration(folder: Path, format: str | None = None, depth_scale: float = 0.0) -> Declaration:
    """What a recording's numbers mean, with its format: named, declared, or told by the files.

    The folder's `sequence.toml` comes first, then the depth scale given here (of a calibration
    file; 0: none) and the unit of a scene of the dataset, then the format's. If files are missing,
    the format is the one with the largest share of what it needs; reading says what is missing.
    Raises MissingError, ConfigError or DataError for what it cannot tell.
    """
    if folder.is_file():
        unzip = f"unpack it by `unzip {folder.name} -d {folder.stem}`, and "
        advice = f"{unzip if is_zipfile(folder) else ''}give the recording's folder"
        raise DataError(f"{folder} is a file: {advice}")
    if not folder.is_dir():
        raise MissingError(f"no folder {folder}: give a recording's, or a synthetic room's name")
    path = folder / DECLARATION_FILE
    declared = read_object(path) if path.is_file() else {}
    try:
        own_format = with_values(Declaration(), declared).format  # raises for a wrong key or value
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None
    format = format or own_format or _told_by_files(folder)
    usual = look_up("format", format, FORMATS).declared
    unit_m = DATASET_UNITS.get(absolute(folder).name, 0.0) if format == "neural_rgbd" else 0.0
    depth_scale = depth_scale or usual.depth_scale
    usual = replace(usual, depth_scale=depth_scale, metres_per_unit=unit_m)
    return replace(with_values(usual, declared), format=format)


def _told_by_files(folder: Path) -> str:
    """The format with the largest share of what it needs, the first of equals.

    Raises MissingError if no format has any of its files, and DataError if several have all.
    """
    shares = {name: np.mean([_is_there(folder, p) for p in f.needs]) for name, f in FORMATS.items()}
    maximum = max(shares.values())
    best = [name for name, share in shares.items() if share == maximum]
    if maximum == 0:
        files = (f"{name} ({', '.join(p[0] for p in FORMATS[name].needs)})" for name in best)
        raise MissingError(f"{folder} is no recording: it needs the files of {'; '.join(files)}")
    if len(best) > 1 and maximum == 1:
        advice = f'choose with --format, or by format = "{best[0]}" in {DECLARATION_FILE}'
        raise DataError(f"{folder} can be read as {' or '.join(best)}: {advice}")
    return best[0]


def holds_recording(folder: Path) -> bool:
    """Whether a folder has both colour and depth of a known format."""
    return any(_is_there(folder, f.color) and _is_there(folder, f.depth) for f in FORMATS.values())


def _is_there(folder: Path, patterns: tuple[str, ...]) -> bool:
    """Whether a folder has a file of any of the patterns."""
    return any(any(folder.glob(pattern)) for pattern in patterns)
