"""Write a sequence in the Neural RGB-D layout, frame by frame."""

import os
import shutil
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from nbtrack.core.camera import Intrinsics, swap_opengl_opencv
from nbtrack.core.errors import DataError
from nbtrack.data.readers.calibration import as_text
from nbtrack.data.readers.neural_rgbd import DEPTH_FOLDERS, FOCAL_FILE, INTRINSICS_FILE

_SAME_CAMERA = 1e-6  # pixels: rounding, not another camera


def layout_holds(camera: Intrinsics) -> bool:
    """Whether one focal length says it all: square pixels, and a centred principal point."""
    own = (camera.fx, camera.fy, camera.cx, camera.cy)
    told = (camera.fx, camera.fx, camera.width / 2, camera.height / 2)
    return max(abs(a - b) for a, b in zip(own, told, strict=True)) < _SAME_CAMERA


class SequenceWriter:
    """Context manager that collects frames in a hidden folder and puts it in place at the end.

    A run that is killed, or ends with an exception, leaves no half-written scene behind.

        with SequenceWriter(folder, intrinsics) as writer:
            writer.add(color, {"depth": depth_mm}, T_world_camera)

    Raises:
        DataError: the folder exists already, a frame has another size than the intrinsics, or
            no frame was added.
    """

    def __init__(
        self, folder: Path, intrinsics: Intrinsics, depth_folders: tuple[str, ...] = DEPTH_FOLDERS
    ) -> None:
        if folder.exists():
            raise DataError(f"{folder} exists: choose another folder or remove it first")
        self.folder = folder
        self.intrinsics = intrinsics
        self.depth_folders = depth_folders
        # A sibling, so that the final rename stays within one file system.
        # The process id keeps two commands that make one scene out of each other's way.
        self._unfinished = folder.with_name(f".{folder.name}.{os.getpid()}.unfinished")
        self._poses: list[Float[np.ndarray, "4 4"]] = []

    def __enter__(self) -> "SequenceWriter":
        shutil.rmtree(self._unfinished, ignore_errors=True)
        for name in ("images", *self.depth_folders):
            (self._unfinished / name).mkdir(parents=True)
        return self

    def add(
        self,
        color: UInt8[np.ndarray, "height width 3"],
        depths_mm: dict[str, UInt16[np.ndarray, "height width"]],
        T_world_camera: Float[np.ndarray, "4 4"],
    ) -> None:
        """Append one frame: RGB colour, one depth map a depth folder, pose with OpenCV axes."""
        number = len(self._poses)
        images = {"images/img": cv2.cvtColor(color, cv2.COLOR_RGB2BGR)}
        images |= {f"{name}/depth": depths_mm[name] for name in self.depth_folders}
        for prefix, image in images.items():
            if image.shape[:2] != (self.intrinsics.height, self.intrinsics.width):
                raise DataError(
                    f"frame {number} is {image.shape[1]}x{image.shape[0]} but the camera "
                    f"{self.intrinsics.width}x{self.intrinsics.height}: write frames of one size"
                )
            # The fastest compression: rooms are made often and read from a local disk.
            encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            encoded.tofile(self._unfinished / f"{prefix}{number}.png")
        self._poses.append(T_world_camera)

    def write_text(self, name: str, text: str) -> None:
        """Put a small text file beside the layout's own."""
        (self._unfinished / name).write_text(text, encoding="utf-8")

    def _write_camera(self) -> None:
        """`focal.txt` where the layout can say it; else a camera matrix, and no focal length.

        Without `focal.txt` programs that know only the layout stop, instead of reading a camera
        that is not this one.
        """
        camera = self.intrinsics
        if layout_holds(camera):
            self.write_text(FOCAL_FILE, f"{float(camera.fx)!r}\n")
        else:
            self.write_text(INTRINSICS_FILE, as_text(camera))

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exception_type is not None:
            shutil.rmtree(self._unfinished, ignore_errors=True)
            return
        if not self._poses:
            shutil.rmtree(self._unfinished, ignore_errors=True)
            raise DataError(f"no frame was added to {self.folder}: a scene needs at least one")
        poses = swap_opengl_opencv(np.stack(self._poses)).reshape(-1, 4)
        rows = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in poses)
        self._write_camera()
        self.write_text("poses.txt", rows)
        self.write_text("trainval_poses.txt", rows)
        try:
            self._unfinished.rename(self.folder)
        except OSError:
            shutil.rmtree(self._unfinished, ignore_errors=True)
            # Another command may have finished the same scene meanwhile: then that one stands.
            if not self.folder.is_dir():
                raise
