"""Formats of recordings, and which one a folder has; data/README.md describes them.

`FORMATS` is the table of all formats: how files are laid out, and what their numbers mean. A user
may add a format as one more entry. A recording that differs from its format in what its numbers
mean has a file `sequence.toml`, which may set any field of `Declaration`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

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
# Where a camera axis may point, seen from behind the camera, as vectors in OpenCV's camera frame.
# `0 - x`, unlike `-x`, gives no -0.0.
_DIRECTIONS = dict(zip(("right", "down", "forward"), np.eye(3), strict=True))
_DIRECTIONS |= dict(zip(("left", "up", "backward"), 0 - np.eye(3), strict=True))


@dataclass(frozen=True)
class Declaration:
    """What the numbers of a recording mean. The limits are far beyond any camera's numbers."""

    format: str = ""  # a name in `FORMATS`; empty: the files tell the format
    depth_scale: float = limited(1000.0, 1e-8, 1e8)  # depth values a metre
    # Depth values that mean "not measured", besides 0.
    no_depth: tuple[int, ...] = limited((0,), 0, 65535)
    depth_along: str = one_of("axis", "ray")  # the optical axis (z-depth), or the ray (distance)
    # 1/m: a measured depth m (metres) is truly m + depth_error_per_m * m². Within the limits the
    # true depth of 65 m is positive.
    depth_error_per_m: float = limited(0.0, -0.015, 0.015)
    camera_axes: str = "opencv"  # or "opengl", or where x, y, z point: "right up forward"
    poses: str = one_of(CAMERA_TO_WORLD, WORLD_TO_CAMERA)
    quaternion: str = one_of("xyzw", "wxyz")  # the order in pose files with quaternions
    frame_rate: float = limited(30.0, 1e-8, 1e8)  # Hz
    metres_per_unit: float = limited(0.0, 0.0, 1e8)  # of a map; 0: half the map's longest side

    def __post_init__(self) -> None:
        if len(self._axes) != 3 or not np.linalg.det(self._axes):
            raise ConfigError(
                f"camera_axes = {self.camera_axes!r:.80}: write 'opencv', 'opengl', or where x, y "
                "and z point, as in 'right up forward' (of right/left, up/down, forward/backward)"
            )

    @property
    def _axes(self) -> np.ndarray:
        """Rows with the file's x, y and z axes in OpenCV's camera frame; 0 for an unknown word."""
        words = SPELLED_AXES.get(self.camera_axes, self.camera_axes).split()
        return np.array([_DIRECTIONS.get(word, np.zeros(3)) for word in words])

    def inverted_if_world_to_camera(self, poses: Poses) -> Poses:
        """Convert the file's poses to camera-to-world poses, or these to the file's.

        Both ways are the same: poses are inverted if the file's are declared world-to-camera, else
        they are copied. NaN poses stay NaN.
        """
        converted = poses.copy()
        if self.poses == WORLD_TO_CAMERA:
            # The inverse by a transpose, unlike one by a solver, takes NaN and never fails.
            converted[:, :3, :3] = poses[:, :3, :3].mT
            converted[:, :3, 3:] = -converted[:, :3, :3] @ poses[:, :3, 3:]
        return converted

    def poses_to_opencv(self, file_poses: Poses) -> Poses:
        """The file's poses as camera-to-world, with OpenCV's camera axes; NaN poses stay NaN."""
        R_file_opencv = self._axes  # turns vectors of OpenCV's camera frame into the file's
        T_world_camera = self.inverted_if_world_to_camera(file_poses)
        T_world_camera[:, :3, :3] = T_world_camera[:, :3, :3] @ R_file_opencv
        # Left-handed camera axes have the determinant -1 and come with a left-handed world. A
        # change of the sign of the world's z makes the rotations proper ones again.
        T_world_camera[:, 2] *= np.linalg.det(R_file_opencv)
        return T_world_camera


@dataclass(frozen=True)
class Format:
    """One layout of recordings on disk. Files are given by patterns within a recording's folder."""

    label: str  # its name in texts for users
    # Image files: those of the first pattern that matches any. A pattern may also name a text file,
    # a list with `timestamp file` in each line.
    color: tuple[str, ...]
    depth: tuple[str, ...]  # depth maps, in the same way
    poses: tuple[str, ...]  # each a file with all poses, or with `*` a file for each frame
    cameras: tuple[str, ...]  # calibration files, of which the first that is there counts
    # Calibrations for a folder without such a file. The first is taken whose `source` has a name
    # that occurs in the folder's name.
    known_cameras: tuple[Calibration, ...] = ()
    declared: Declaration = Declaration()  # what its numbers mean
    counts_from_0: bool = False  # the number of an image is the place of its pose in the pose file
    # Whether times in a pose file tell the frames; else the order does, unless frames have times.
    stamps_tell: bool = True
    resize_color: bool = False  # colour has another size than depth and shows the same view
    # Reads a file's poses and their times (s; NaN: none), given the order of its quaternions. An
    # error of any type that it or `read_camera` raises for a damaged file becomes a DataError.
    read_poses: Callable[[Path, str], tuple[Poses, Times]] = read_poses
    read_camera: Callable[[Path], Calibration] = read_calibration
    # Reads depth values, `depth_scale` a metre, of a depth map that is no PNG or JPEG, given the
    # content of its file, its path for messages, and the camera.
    read_depth: Callable[[bytes, Path, Calibration], DepthImage] | None = None

    @property
    def needs(self) -> tuple[tuple[str, ...], ...]:
        """Groups of patterns; a recording has files of at least one pattern of each group."""
        cameras = () if self.known_cameras else (self.cameras,)
        return self.color, self.depth, self.poses, *cameras

    def files(self, folder: Path, patterns: Sequence[str], what: str) -> list[Path]:
        """The files of the first pattern that matches any in a folder, in order.

        Raises MissingError if no pattern does; `what` says in the message which files are missing.
        """
        for pattern in patterns:
            if files := files_of(folder, pattern):
                return files
        needed = f"{self.label} needs {' or '.join(dict.fromkeys(patterns))}"
        advice = "add it, or name another format with --format"
        raise MissingError(f"no {what} in {folder}: {needed}; {advice}")


def files_of(folder: Path, pattern: str) -> list[Path]:
    """The files in a folder that match a pattern, by the numbers in names: `img2` before `img10`.

    A file whose name is the pattern itself is the only match. A pattern without a suffix, or with
    `.*`, matches only images, which have `IMAGE_SUFFIXES`.
    """
    if (folder / pattern).is_file():
        return [folder / pattern]
    suffix = Path(pattern).suffix
    suffixes = IMAGE_SUFFIXES if suffix in ("", ".*") else (suffix,)
    paths = (folder / pattern).parent.glob(Path(pattern).name)
    # Hidden files are left out: systems put them beside images.
    files = [p for p in paths if p.suffix.lower() in suffixes and p.name[0] != "." and p.is_file()]
    return [file for _, file in sorted(zip(frame_keys(files), files, strict=True))]


_VGA = (640, 480)
# The TUM benchmark's calibrations of its three cameras. Principal points are moved by half a pixel,
# since pixel centres lie at integer + 0.5 here. The distortion of the lenses is not taken out: the
# benchmark's page on calibration says that the driver has done so and registered depth to colour.
_TUM_CAMERAS = (
    Calibration(Path("freiburg1"), 517.3, 516.5, (319.1, 255.8), _VGA),
    Calibration(Path("freiburg2"), 520.9, 521.0, (325.6, 250.2), _VGA),
    Calibration(Path("freiburg3"), 535.4, 539.2, (320.6, 248.1), _VGA),
)  # fmt: skip
_FORMATS: dict[str, Format | str] = {
    # Azinovic et al. 2022. The dataset's own loader reads filtered depth, too. The dataset has no
    # intrinsics.txt; nbtrack writes this file for cameras that focal.txt cannot say.
    "neural_rgbd": Format(
        "Neural RGB-D", color=("images/*",),
        depth=("depth_filtered/*", "depth/*", "depth_with_noise/*"), poses=("poses.txt",),
        cameras=("intrinsics.txt", "focal.txt", "K.txt"),
        declared=Declaration(camera_axes="opengl"), counts_from_0=True,
    ),
    # Sturm et al. 2012. The depth maps are stored with the correction of their scale.
    "tum": Format(
        "TUM RGB-D", color=("rgb.txt",), depth=("depth.txt",), poses=("groundtruth.txt",),
        cameras=("intrinsics.json", "intrinsics.txt", "calibration.txt"),
        known_cameras=_TUM_CAMERAS, declared=Declaration(depth_scale=5000.0),
    ),
    # As rendered for iMAP and shared with NICE-SLAM. Camera axes are OpenCV's: the loader of
    # NICE-SLAM turns y and z to get OpenGL's.
    "replica": Format(
        "Replica (NICE-SLAM)", color=("results/frame*",), depth=("results/depth*",),
        poses=("traj.txt",), cameras=("cam_params.json", "../cam_params.json"),
        declared=Declaration(depth_scale=6553.5), counts_from_0=True,
    ),
    # Shotton et al. 2013. Colour and depth come from two cameras 25 mm apart; the dataset does not
    # register one to the other. Its page states the focal length and the principal point
    # (320, 240), which is taken for the middle of the image here. `Path()` has an empty name, which
    # occurs in every folder's name, so the camera is known for all folders.
    "7scenes": Format(
        "7-Scenes", color=("*.color.*",), depth=("*.depth.*",), poses=("*.pose.txt",),
        cameras=("intrinsics.txt", "camera-intrinsics.txt", "../camera-intrinsics.txt"),
        declared=Declaration(no_depth=(65535,)),
        known_cameras=(Calibration(Path(), 585.0, 585.0, None, _VGA),),
    ),
    # Dai et al. 2017, as SensReader exports a scan. Colour shows the same view as depth, larger.
    "scannet": Format(
        "ScanNet export", color=("color/*",), depth=("depth/*",), poses=("pose/*.txt",),
        cameras=("intrinsic/intrinsic_depth.txt",), resize_color=True,
    ),
    # A user's own recording. The folder image/, the .log file and the last three calibration files
    # are those of recordings that Open3D made.
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
    """The declaration of a recording: its format, and what its numbers mean.

    The format is the one named here, else the one in `sequence.toml`, else the one whose files the
    folder has. Other values come from the folder's `sequence.toml`. A value that is not there comes
    from `depth_scale` (of a calibration file; 0: not known) or the unit of a scene of the dataset,
    else from the format.

    Raises MissingError if there is no folder or no recording in it, ConfigError for an unknown
    format, and DataError for a file in place of a folder, a wrong `sequence.toml`, or files of
    several formats.
    """
    if folder.is_file():
        advice = f"or, if it is a ZIP file, unpack it by `unzip {folder.name} -d {folder.stem}`"
        raise DataError(f"{folder} is a file: give the recording's folder, {advice}")
    if not folder.is_dir():
        raise MissingError(f"no folder {folder}: give a recording's, or a synthetic room's name")
    path = folder / DECLARATION_FILE
    values = read_object(path) if path.is_file() else {}
    try:
        declared_format = with_values(Declaration(), values).format  # raises for a wrong value
        if declared_format:
            look_up("format", declared_format, FORMATS)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None
    format = format or declared_format or _told_by_files(folder)
    usual = look_up("format", format, FORMATS).declared
    unit_m = DATASET_UNITS.get(absolute(folder).name, 0.0) if format == "neural_rgbd" else 0.0
    usual = replace(usual, depth_scale=depth_scale or usual.depth_scale, metres_per_unit=unit_m)
    return replace(with_values(usual, values), format=format)


def _told_by_files(folder: Path) -> str:
    """The name of the format whose files the folder has.

    If no format has all its groups of files, it is the one with the largest share of them, and the
    first of equals: reading will then say what is missing. Raises MissingError if no format has any
    of its files, and DataError if several formats have all.
    """
    shares = {}  # by format, the share of its groups of files that the folder has
    for name, layout in FORMATS.items():
        shares[name] = np.mean([_is_there(folder, patterns) for patterns in layout.needs])
    maximum = max(shares.values())
    best = [name for name, share in shares.items() if share == maximum]
    if maximum == 0:
        # Of each format the first pattern of each group of files.
        files = [f"{name} ({', '.join(p[0] for p in FORMATS[name].needs)})" for name in FORMATS]
        raise MissingError(f"{folder} is no recording: it needs the files of {'; '.join(files)}")
    if len(best) > 1 and maximum == 1:
        advice = f'choose with --format, or by format = "{best[0]}" in {DECLARATION_FILE}'
        raise DataError(f"{folder} can be read as {' or '.join(best)}: {advice}")
    return best[0]


def holds_recording(folder: Path) -> bool:
    """Whether a folder has files where a known format has colour, and files where it has depth."""
    return any(_is_there(folder, f.color) and _is_there(folder, f.depth) for f in FORMATS.values())


def _is_there(folder: Path, patterns: tuple[str, ...]) -> bool:
    """Whether a folder has a file that matches any of the patterns."""
    return any(any(folder.glob(pattern)) for pattern in patterns)
