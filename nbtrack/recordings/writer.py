"""Write frames, or a recording of any format, in the Neural RGB-D layout."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import astuple
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from nbtrack.core.arrays import ColorImage, DepthImage, Frames, Pose, Poses
from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.calibration import camera_matrix
from nbtrack.recordings.formats import DECLARATION_FILE, FORMATS
from nbtrack.recordings.images import images_of
from nbtrack.recordings.pairing import TIMES_FILE
from nbtrack.recordings.pose_files import number_lines
from nbtrack.recordings.reading import read_frames, select_frames
from nbtrack.recordings.recording import Recording

# RGB colour; depth maps (mm) by the name of their folder; camera-to-world pose, OpenCV camera axes.
WrittenFrame = tuple[ColorImage, dict[str, DepthImage], Pose]


def write_sequence(
    folder: Path,
    camera: Intrinsics,
    frames: Iterable[WrittenFrame],
    notes: Mapping[str, str] | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> None:
    """Write frames as a scene in the Neural RGB-D layout.

    Args:
        folder: the scene's folder, which must not exist.
        frames: at least one.
        notes: texts of further files, by file name.
        progress: called after each frame with the number of frames that are written.

    The folder is put in place when it is complete, so a killed run leaves no half of a scene. If
    the system ends the process at once, a hidden folder `.NAME.….unfinished` stays beside it.
    Raises DataError if the folder exists.
    """
    if folder.exists():
        raise DataError(f"{folder} exists: choose another folder or remove it first")
    folder.parent.mkdir(parents=True, exist_ok=True)
    # The temporary folder is a sibling, so that the final rename stays within one file system. Its
    # name begins with that of the folder, so that errors tell which one is meant; not with all of
    # it, since a name may be as long as a file system allows.
    with TemporaryDirectory(".unfinished", f".{folder.name[:40]}.", folder.parent) as hidden:
        unfinished = Path(hidden) / "scene"
        unfinished.mkdir()
        poses = []
        for color, depths_mm, T_world_camera in frames:
            _write_images(unfinished, len(poses), color, depths_mm)
            poses.append(T_world_camera)
            progress(len(poses))
        for name, text in {**_texts(camera, np.stack(poses)), **(notes or {})}.items():
            (unfinished / name).write_text(text, encoding="utf-8")
        unfinished.rename(folder)  # fails if another command has finished it meanwhile


def _write_images(
    folder: Path, number: int, color: ColorImage, depths_mm: dict[str, DepthImage]
) -> None:
    """Write the images of the frame with this number."""
    images = {f"{name}/depth": image for name, image in depths_mm.items()}
    images["images/img"] = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    for prefix, image in images.items():
        # 1 is the fastest compression: rooms are made often, and read from a local disk.
        _, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        write_atomic(folder / f"{prefix}{number}.png", content.tobytes())


def _texts(camera: Intrinsics, T_world_camera: Poses) -> dict[str, str]:
    """The texts of the pose files and of the camera file, by file name."""
    # The layout's y and z axes point the other way than OpenCV's. Turning them is its own inverse,
    # so the function that reads the layout's poses also writes them.
    T_file = FORMATS["neural_rgbd"].declared.poses_to_opencv(T_world_camera)
    # The dataset has both files; programs that read it may look for either.
    texts = dict.fromkeys(["poses.txt", "trainval_poses.txt"], number_lines(T_file.reshape(-1, 4)))
    # The camera that a reader of the focal length alone assumes.
    by_focal = Intrinsics.from_focal(camera.width, camera.height, camera.fx)
    if np.allclose(astuple(camera), astuple(by_focal), rtol=0, atol=1e-6):  # equal but for rounding
        return texts | {"focal.txt": f"{float(camera.fx)!r}\n"}
    # Another camera gets no `focal.txt`: programs that know only this file then stop instead of
    # assuming a wrong camera. In `intrinsics.txt` pixel centres have whole coordinates.
    K = camera_matrix(camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
    return texts | {"intrinsics.txt": number_lines(K)}


def convert_sequence(recording: Recording, out: Path, frames: slice = slice(None)) -> str:
    """Write a recording in the Neural RGB-D layout; returns a text that tells the user about it.

    Frames are written as `read_frames` gives them, numbered from 0: depth is z-depth in mm, images
    have one size, and the distortion of a lens is taken out. Frames without a pose get a NaN pose.
    A camera that the layout cannot describe is written to `intrinsics.txt`. The folder `out`
    appears when it is complete. Raises DataError if `out` exists, if an image cannot be read, or if
    no selected frame has a pose.
    """
    select_frames(recording, frames)  # raises if no frame has a pose
    numbers = select_frames(recording, frames, needs_poses=False)
    camera = images_of(recording).camera_of(numbers[0])
    with ProgressBar("converting", len(numbers)) as bar:
        notes = {TIMES_FILE: number_lines(recording.times[numbers, None])}
        if unit_m := recording.declared.metres_per_unit:
            notes[DECLARATION_FILE] = f"metres_per_unit = {unit_m}\n"
        write_sequence(out, camera, _frames(recording, numbers), notes, bar.move_to)
    n_lost = int((~recording.has_pose[numbers]).sum())
    lost = f" ({n_lost} without a pose)" if n_lost else ""
    said = f"{out}: {len(numbers)} frames{lost} of {camera.width}x{camera.height}, read as "
    lines = [said + recording.format.label, *recording.notes]
    if not (out / "focal.txt").is_file():
        what = "the camera is more than focal.txt can say: it is in intrinsics.txt"
        lines.append(f"{what}, which nbtrack reads and other programs do not know")
    return "\n  ".join(lines)


def _frames(recording: Recording, numbers: Frames) -> Iterator[WrittenFrame]:
    """The frames with these numbers one by one, so that memory holds no more than one."""
    for number in numbers:
        read = read_frames(recording, np.array([number]), origin=np.zeros(3))
        yield read.colors[0], {"depth": read.depths_mm[0]}, read.T_world_camera[0]
        images_of(recording).forget()
