"""RGB-D sequences with known camera poses, and the Neural RGB-D layout on disk.

The layout (Azinovic et al. 2022), one folder a scene:

    images/img0.png ...             8-bit colour
    depth_filtered/depth0.png ...   uint16 millimetres along the optical axis, 0 = no measurement
    depth/, depth_with_noise/       the same, clean and noisy, where a scene has them
    focal.txt                       one number, pixels
    poses.txt, trainval_poses.txt   camera-to-world, four rows a frame, OpenGL camera axes

Frames are counted from 0 without padding, hence the natural sort.
"""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from tqdm.auto import tqdm

from nbtrack.camera import Intrinsics, swap_opengl_opencv
from nbtrack.errors import DataError, MissingError
from nbtrack.images import read_image

# Which depth to read when the caller does not say: filtered is what the dataset's own loader and
# most users of the dataset take; the others serve scenes that lack it.
DEPTH_FOLDERS = ("depth_filtered", "depth", "depth_with_noise")
MILLIMETRE = 1e-3
FRAMES_PER_SECOND = 30.0  # of the recordings; turns frame ids into time stamps


@dataclass(frozen=True)
class Sequence:
    """Posed RGB-D frames, kept as compactly as on disk (5 bytes a pixel).

    1,600 frames of 640x480 take 2.5 GB. Pixels become floating point only when sampled.
    """

    name: str
    intrinsics: Intrinsics
    colors: UInt8[np.ndarray, "frames height width 3"]  # RGB
    depths_mm: UInt16[np.ndarray, "frames height width"]  # z-depth, 0 = no measurement
    T_world_camera: Float[np.ndarray, "frames 4 4"]  # OpenCV camera axes
    frame_ids: Int[np.ndarray, "frames"]  # position in the folder's natural order
    excluded_frames: int = 0  # frames left out because their pose is NaN

    def __len__(self) -> int:
        return len(self.frame_ids)

    def __repr__(self) -> str:
        size = f"{self.intrinsics.width}x{self.intrinsics.height}"
        left_out = f", {self.excluded_frames} without pose" if self.excluded_frames else ""
        return f"Sequence({self.name!r}, {len(self)} frames of {size}{left_out})"

    def color(self, index: int) -> Float[np.ndarray, "height width 3"]:
        """Colour image in [0, 1]."""
        return self.colors[index].astype(np.float32) / 255

    def depth(self, index: int) -> Float[np.ndarray, "height width"]:
        """Z-depth image in metres, 0 where there is no measurement."""
        return self.depths_mm[index].astype(np.float32) * np.float32(MILLIMETRE)

    def select(self, indices: slice | Int[np.ndarray, "n"]) -> "Sequence":
        """The sequence of some of the frames, in the order given; slices copy nothing."""
        return Sequence(
            self.name, self.intrinsics, self.colors[indices], self.depths_mm[indices],
            self.T_world_camera[indices], self.frame_ids[indices], self.excluded_frames,
        )  # fmt: skip


def parse_frames(text: str) -> slice:
    """A Python slice written `A:B:S`; every part may be missing.

    Raises:
        DataError: the text is not a slice, or its step is not positive.

    >>> parse_frames("10:50:2"), parse_frames(":100")
    (slice(10, 50, 2), slice(None, 100, None))
    """
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
        if not 2 <= len(parts) <= 3:
            raise ValueError
        frames = slice(*parts)
    except ValueError:
        raise DataError(
            f"frames {text!r} is not a slice: write A:B or A:B:S, for example 0:100:2"
        ) from None
    if frames.step is not None and frames.step < 1:
        raise DataError(f"frames {text!r} steps by {frames.step}: a step is 1 or more")
    return frames


def read_sequence(
    folder: Path | str,
    frames: slice = slice(None),
    depth_folder: str | None = None,
    pose_file: str = "poses.txt",
    progress: bool = False,
) -> Sequence:
    """Read a scene folder in the Neural RGB-D layout.

    Args:
        frames: Python slice over the folder's frames in natural order.
        depth_folder: name of the depth folder; by default the first of `DEPTH_FOLDERS` there is.
        pose_file: `poses.txt` (ground truth) or `trainval_poses.txt` (the dataset's BundleFusion
            poses, in a frame of their own).
        progress: show a bar.

    Raises:
        MissingError: the folder or a part of it does not exist.
        DataError: a file is unreadable, counts or sizes disagree, or nothing is left to read.
    """
    folder = Path(folder)
    image_files, depth_files = list_frames(folder, depth_folder)
    poses = read_poses(folder / pose_file)
    if len(poses) != len(image_files):
        raise DataError(
            f"{folder / pose_file} has {len(poses)} poses but there are {len(image_files)} images: "
            "every frame needs four rows; write 'nan' rows for a frame without a pose"
        )
    selected = np.arange(len(image_files))[frames]
    if len(selected) == 0:
        raise DataError(
            f"frames {_slice_text(frames)} select nothing of the {len(image_files)} frames in "
            f"{folder}: choose a range within 0:{len(image_files)}"
        )
    frame_ids = _with_pose(selected, poses, folder / pose_file)
    _check_rotations(poses[frame_ids], frame_ids, folder / pose_file)
    colors, depths_mm = _read_images(
        [image_files[i] for i in frame_ids], [depth_files[i] for i in frame_ids], progress
    )
    height, width = depths_mm.shape[1:]
    intrinsics = Intrinsics.from_focal(width, height, read_focal(folder / "focal.txt"))
    return Sequence(
        folder.resolve().name, intrinsics, colors, depths_mm, swap_opengl_opencv(poses[frame_ids]),
        frame_ids, len(selected) - len(frame_ids),
    )  # fmt: skip


def list_frames(folder: Path, depth_folder: str | None = None) -> tuple[list[Path], list[Path]]:
    """Colour and depth files of a scene folder, paired, in natural order.

    Raises:
        MissingError: the folder, its images or the depth folder do not exist.
        DataError: images and depth maps differ in number or in the frame numbers of their names.
    """
    if not folder.is_dir():
        raise MissingError(
            f"no folder {folder}: give a folder with images/, depth_filtered/ (or depth/), "
            "focal.txt and poses.txt, or the name of a synthetic room"
        )
    image_files = _numbered_images(folder / "images")
    candidates = [depth_folder] if depth_folder else list(DEPTH_FOLDERS)
    found = [name for name in candidates if (folder / name).is_dir()]
    if not found:
        raise MissingError(f"no depth in {folder}: it needs a folder {' or '.join(candidates)}")
    depth_files = _numbered_images(folder / found[0])
    if len(image_files) != len(depth_files):
        raise DataError(
            f"{folder} has {len(image_files)} images but {len(depth_files)} depth maps in "
            f"{found[0]}/: every image needs one; remove or add the odd files"
        )
    for image, depth in zip(image_files, depth_files, strict=True):
        if _frame_number(image) != _frame_number(depth):
            raise DataError(
                f"{image} stands beside {depth}: the frame numbers in the names must agree"
            )
    return image_files, depth_files


def read_focal(path: Path) -> float:
    """Focal length (pixels) from `focal.txt`. Raises DataError unless it is a positive number."""
    text = _read_text(path).strip()
    try:
        focal = float(text)
    except ValueError:
        focal = float("nan")
    if not (np.isfinite(focal) and focal > 0):
        raise DataError(
            f"{path} holds {text[:40]!r}: it must be one positive number, "
            "the focal length in pixels"
        )
    return focal


def read_poses(path: Path) -> Float[np.ndarray, "frames 4 4"]:
    """Camera-to-world matrices as they stand in the file (OpenGL camera axes, NaN kept).

    Raises:
        DataError: a row has not four numbers, or the rows do not divide into blocks of four.
    """
    rows = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 4:
            raise DataError(
                f"{path} line {number} is {line[:60]!r}: every row needs four numbers "
                "(camera-to-world, four rows a frame)"
            )
        rows.append(row)
    if len(rows) == 0 or len(rows) % 4:
        raise DataError(f"{path} has {len(rows)} rows: it needs four for every frame")
    return np.array(rows, dtype=np.float64).reshape(-1, 4, 4)


def _read_images(
    image_files: list[Path], depth_files: list[Path], progress: bool
) -> tuple[UInt8[np.ndarray, "n height width 3"], UInt16[np.ndarray, "n height width"]]:
    height, width = read_image(image_files[0], cv2.IMREAD_COLOR).shape[:2]
    colors = np.empty((len(image_files), height, width, 3), np.uint8)
    depths_mm = np.empty((len(image_files), height, width), np.uint16)

    def read(index: int) -> None:
        color = read_image(image_files[index], cv2.IMREAD_COLOR)
        depth = read_image(depth_files[index], cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise DataError(
                f"{depth_files[index]} is {depth.dtype} of shape {depth.shape}: "
                "depth is a 16-bit image of one channel in millimetres"
            )
        for path, image in ((image_files[index], color), (depth_files[index], depth)):
            if image.shape[:2] != (height, width):
                raise DataError(
                    f"{path} is {image.shape[1]}x{image.shape[0]} but {image_files[0]} is "
                    f"{width}x{height}: all images and depth maps need one size; resize them first"
                )
        colors[index], depths_mm[index] = cv2.cvtColor(color, cv2.COLOR_BGR2RGB), depth

    # Decoding releases the interpreter lock, so a few threads suffice.
    with ThreadPoolExecutor(max_workers=4) as pool:
        jobs = pool.map(read, range(len(image_files)))
        bar = tqdm(jobs, "reading frames", len(image_files), unit="frame", disable=not progress)
        for _ in bar:  # raises what a thread raised
            pass
    return colors, depths_mm


def _numbered_images(folder: Path) -> list[Path]:
    files = []
    if folder.is_dir():
        files = [p for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg", ".jpeg")]
    if not files:
        raise MissingError(f"no images in {folder}: it needs files like img0.png, img1.png, ...")
    return sorted(files, key=lambda path: [int(n) for n in re.findall(r"\d+", path.stem)])


def _frame_number(path: Path) -> int | None:
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def _read_text(path: Path) -> str:
    if not path.is_file():
        raise MissingError(f"no file {path}: the Neural RGB-D layout needs it")
    return path.read_text(encoding="utf-8", errors="replace")


def _slice_text(frames: slice) -> str:
    parts = (frames.start, frames.stop, frames.step)
    return ":".join("" if part is None else str(part) for part in parts)


def _with_pose(
    selected: Int[np.ndarray, "n"], poses: Float[np.ndarray, "frames 4 4"], path: Path
) -> Int[np.ndarray, "kept"]:
    """The selected frames whose pose is not NaN: at least one, else DataError."""
    frame_ids = selected[np.isfinite(poses[selected]).all(axis=(1, 2))]
    if len(frame_ids) == 0:
        raise DataError(
            f"all {len(selected)} selected poses in {path} are NaN: at least one frame needs a "
            "pose; choose other frames or another pose file"
        )
    return frame_ids


def _check_rotations(
    T: Float[np.ndarray, "n 4 4"], frame_ids: Int[np.ndarray, "n"], path: Path
) -> None:
    rotation = T[:, :3, :3]
    deviation = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    deviation = np.maximum(deviation, np.abs(np.linalg.det(rotation) - 1))
    worst = int(deviation.argmax())
    if deviation[worst] > 1e-2:
        raise DataError(
            f"{path} frame {frame_ids[worst]} is no rigid transform (its rotation is off by "
            f"{deviation[worst]:.3g}): rows must be [R | t] with a right-handed rotation R"
        )
