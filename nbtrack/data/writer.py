"""Write frames, or a recording of any format, in the Neural RGB-D layout."""

import os
import shutil
from dataclasses import astuple
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from nbtrack.core.arrays import ColorImage, DepthImage, Pose
from nbtrack.core.camera import Intrinsics, swap_opengl_opencv
from nbtrack.core.errors import DataError
from nbtrack.core.progress import ProgressBar
from nbtrack.data.images import decode
from nbtrack.data.recording import Recording
from nbtrack.data.sequence import select_frames
from nbtrack.data.text_files import camera_matrix

DEPTH_FOLDERS = ("depth_filtered", "depth", "depth_with_noise")
_FRAMES_AT_ONCE = 32  # converted: 50 MB at 640x480
_SAME_CAMERA = 1e-6  # pixels: rounding, not another camera


class SequenceWriter:
    """Context manager that collects frames in a hidden folder and puts it in place at the end.

    A run that is killed, or ends with an exception, leaves no half-written scene behind. Raises
    DataError if the folder exists, a frame has another size, or no frame was added.
    """

    def __init__(
        self, folder: Path, intrinsics: Intrinsics, depth_folders: tuple[str, ...] = DEPTH_FOLDERS
    ) -> None:
        if folder.exists():
            raise DataError(f"{folder} exists: choose another folder or remove it first")
        self.folder, self.intrinsics, self.depth_folders = folder, intrinsics, depth_folders
        # A sibling, so that the final rename stays within one file system.
        # The process id keeps two commands that make one scene out of each other's way.
        self._unfinished = folder.with_name(f".{folder.name}.{os.getpid()}.unfinished")
        self._poses: list[Pose] = []

    def __enter__(self) -> "SequenceWriter":
        shutil.rmtree(self._unfinished, ignore_errors=True)
        for name in ("images", *self.depth_folders):
            (self._unfinished / name).mkdir(parents=True)
        return self

    def add(
        self, color: ColorImage, depths_mm: dict[str, DepthImage], T_world_camera: Pose
    ) -> None:
        """Append one frame: RGB colour, one depth map a depth folder, pose with OpenCV axes."""
        number, size = len(self._poses), (self.intrinsics.height, self.intrinsics.width)
        images = {"images/img": cv2.cvtColor(color, cv2.COLOR_RGB2BGR)}
        images |= {f"{name}/depth": depths_mm[name] for name in self.depth_folders}
        for prefix, image in images.items():
            if image.shape[:2] != size:
                raise DataError(
                    f"frame {number} is of shape {image.shape} but the camera {size}: write frames "
                    "of one size"
                )
            # The fastest compression: rooms are made often and read from a local disk.
            encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            encoded.tofile(self._unfinished / f"{prefix}{number}.png")
        self._poses.append(T_world_camera)

    def write_text(self, name: str, text: str) -> None:
        """Put a small text file beside the layout's own."""
        (self._unfinished / name).write_text(text, encoding="utf-8")

    def __exit__(self, exception_type: type[BaseException] | None, *_: object) -> None:
        try:
            if exception_type is None:
                self._finish()
        finally:
            shutil.rmtree(self._unfinished, ignore_errors=True)

    def _finish(self) -> None:
        if not self._poses:
            raise DataError(f"no frame was added to {self.folder}: a scene needs at least one")
        camera = self.intrinsics
        if _is_told_by_focal(camera):
            self.write_text("focal.txt", f"{float(camera.fx)!r}\n")
        else:
            # Programs that know only `focal.txt` then stop, instead of reading another camera.
            K = camera_matrix(camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
            self.write_text("intrinsics.txt", _text(K))
        poses = _text(swap_opengl_opencv(np.stack(self._poses)).reshape(-1, 4))
        self.write_text("poses.txt", poses)
        self.write_text("trainval_poses.txt", poses)
        try:
            self._unfinished.rename(self.folder)
        except OSError:
            # Another command may have finished the same scene meanwhile: then that one stands.
            if not self.folder.is_dir():
                raise


def _text(rows: Float[np.ndarray, "n m"]) -> str:
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.astype(np.float64).tolist())


def _is_told_by_focal(camera: Intrinsics) -> bool:
    """Square pixels, and a centred principal point."""
    told = Intrinsics.from_focal(camera.width, camera.height, camera.fx)
    return np.allclose(astuple(camera), astuple(told), rtol=0, atol=_SAME_CAMERA)


def convert_sequence(
    recording: Recording, out: Path, frames: slice = slice(None), progress: bool = False
) -> str:
    """Write a recording in the Neural RGB-D layout, and say what a user should know of it.

    Only a lens's distortion is removed from images; a camera that the layout cannot say goes to
    `intrinsics.txt`. Frames without a pose keep their number, with a NaN pose.
    Raises as `read_frames` does, and DataError if `out` exists; it appears when it is complete.
    """
    numbers = select_frames(recording, frames)
    camera, _, _ = decode(recording, numbers[:1])
    bar = ProgressBar("converting", len(numbers), progress)
    with bar, SequenceWriter(out, camera, ("depth",)) as writer:
        for start in range(0, len(numbers), _FRAMES_AT_ONCE):
            part = numbers[start : start + _FRAMES_AT_ONCE]
            _, colors, depths = decode(recording, part)
            for color, depth, T in zip(colors, depths, recording.T_world_camera[part], strict=True):
                writer.add(color, {"depth": depth}, T)
            bar.move_to(start + len(part))
    n_lost = int((~recording.has_pose[numbers]).sum())
    lost = f" ({n_lost} without a pose)" if n_lost else ""
    said = f"{out}: {len(numbers)} frames{lost} of {camera.width}x{camera.height}"
    said += f", read as {recording.format.label}"
    if _is_told_by_focal(camera):
        return said
    return (
        f"{said}\n  the camera (fx {camera.fx:.2f}, fy {camera.fy:.2f}, principal point "
        f"({camera.cx:.2f}, {camera.cy:.2f})) is more than focal.txt can say: it is in "
        "intrinsics.txt, which nbtrack reads and other programs do not know"
    )
