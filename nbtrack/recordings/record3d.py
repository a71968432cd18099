"""Record3D's recordings: an .r3d file, unpacked as the ZIP file that it is.

`metadata` is JSON: K, the colour images' camera matrix column by column, their size w and h, and a
pose qx qy qz qw tx ty tz a frame, camera to world with OpenGL's axes (x right, y up, z towards the
viewer), in metres. `rgbd/N.depth` holds metres as float32, row by row in colour's proportions,
compressed by LZFSE. Sources: the app's author, github.com/marek-simonik/record3d, issues 18, 33,
36 and 93; K's order as viser's `Record3dLoader` reads it. Principal points count from the frame's
upper left corner, as those of Apple's `ARCamera.intrinsics` do.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import DepthImage, Poses
from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.files import naming_damaged
from nbtrack.data.text_files import Times, read_object
from nbtrack.recordings.calibration import Calibration, checked_camera
from nbtrack.recordings.formats import FORMATS, Declaration, Format

_ADVICE = "export the recording again as .r3d and unpack it"


def _read_poses(path: Path, order: str) -> tuple[Poses, Times | None]:
    """The poses, and the times (s) of their frames where the file says them; `order` is known."""
    content = read_object(path, "JSON")
    with naming_damaged(path, "Record3D metadata", _ADVICE):
        rows = np.array(content["poses"], dtype=np.float64).reshape(-1, 7)
        times = np.array(content.get("frameTimestamps", ()), dtype=np.float64)
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(rows[:, :4]).as_matrix()
        poses[:, :3, 3] = rows[:, 4:]
        is_timed = times.shape == (len(rows),) and np.isfinite(times).all()
        return poses, times if is_timed else np.arange(len(rows)) / float(content["fps"])


def _read_camera(path: Path) -> Calibration:
    """The first frame's, as the app writes it; later ones move by a pixel or two."""
    content = read_object(path, "JSON")
    with naming_damaged(path, "Record3D metadata", _ADVICE):
        fx, _, _, _, fy, _, cx, cy, _ = map(float, content["K"])
        size = int(content["w"]), int(content["h"])
        return checked_camera(Calibration(path, fx, fy, (cx, cy), size))


def _read_depth(path: Path, camera: Calibration) -> DepthImage:
    """Millimetres. LZFSE is no part of Python: `liblzfse` reads it, where that is installed."""
    content = path.read_bytes()
    if content[:3] == b"bvx":  # how LZFSE's blocks begin
        try:
            import liblzfse
        except ImportError:
            raise MissingError(
                f"{path} is compressed by LZFSE, which nbtrack does not read alone: run `pip "
                "install pyliblzfse`, or put 16-bit PNG files in millimetres into depth/ in place "
                "of the .depth files"
            ) from None
        with naming_damaged(path, "LZFSE file", _ADVICE):
            content = liblzfse.decompress(content)
    width, height = camera.size
    columns = round(np.sqrt(len(content) / 4 * width / height))
    rows = round(columns * height / width)
    if not columns or rows * columns * 4 != len(content):
        raise DataError(
            f"{path} holds {len(content)} bytes: it must be float32 depth in the proportions of "
            f"{width}x{height}; {_ADVICE}"
        )
    depth_mm = 1000 * np.nan_to_num(np.frombuffer(content, "<f4").reshape(rows, columns))
    return np.rint(depth_mm.clip(0, 65535)).astype(np.uint16)


_FILES = ("metadata", "metadata.json")
FORMATS["record3d"] = Format(
    "Record3D", color=("rgbd/*", "rgb/*"), depth=("rgbd/*.depth", "depth/*"), poses=_FILES,
    cameras=_FILES, declared=Declaration(camera_axes="opengl"), counts_from_0=True,
    read_poses=_read_poses, read_camera=_read_camera, read_depth=_read_depth,
)  # fmt: skip
