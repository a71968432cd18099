"""From image files to arrays: one size, depth in mm along the optical axis, no distortion."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from tqdm.auto import tqdm

from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import DataError, MissingError
from nbtrack.data.images import read_image
from nbtrack.data.readers.recording import Recording
from nbtrack.data.readers.text_files import is_file

MILLIMETRES = 1000.0  # a metre
_FARTHEST_MM = 65535  # what 16 bits hold


@dataclass(frozen=True, eq=False)
class Decoded:
    """Pixels of some frames, and their camera."""

    intrinsics: Intrinsics
    colors: UInt8[np.ndarray, "n height width 3"]  # RGB
    depths: UInt16[np.ndarray, "n height width"]  # mm along the axis, or as in the files


def decode(
    recording: Recording,
    frame_ids: Int[np.ndarray, "n"],
    progress: bool = False,
    as_in_files: bool = False,
) -> Decoded:
    """Read the images of some frames (at least one).

    Lenses are corrected where the calibration has distortion; depth is then looked up with the
    nearest pixel, because interpolation would invent points between a table and the wall behind.

    Args:
        as_in_files: leave depth in the files' own unit and direction; 0 is still no measurement.

    Raises:
        MissingError: a file is not there.
        DataError: a file is damaged or of another kind or size, or holds depths beyond 65.535 m.
    """
    first = _read(recording.depth_files[frame_ids[0]], cv2.IMREAD_UNCHANGED)
    height, width = first.shape[:2]
    first_file = recording.depth_files[frame_ids[0]]
    # The first image names the size, as the one that people look at.
    if not recording.resize_color:
        first_file = recording.color_files[frame_ids[0]]
        height, width = _read(first_file, cv2.IMREAD_COLOR).shape[:2]
    intrinsics = recording.calibration.for_size(width, height, first_file)
    lens = _Lens(intrinsics, recording.calibration.distortion)
    lengths = ray_lengths(intrinsics)
    colors = np.empty((len(frame_ids), height, width, 3), np.uint8)
    depths = np.empty((len(frame_ids), height, width), np.uint16)

    def read(index: int) -> None:
        color_file = recording.color_files[frame_ids[index]]
        depth_file = recording.depth_files[frame_ids[index]]
        color = _read(color_file, cv2.IMREAD_COLOR)
        depth = _read_depth(depth_file)
        if recording.resize_color:
            color = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
        for path, image in ((color_file, color), (depth_file, depth)):
            if image.shape[:2] != (height, width):
                raise DataError(
                    f"{path} is {image.shape[1]}x{image.shape[0]} but {first_file} is "
                    f"{width}x{height}: all images and depth maps need one size; resize them first"
                )
        color, depth = lens.straighten(color, depth)
        if recording.declared.no_depth is not None:
            depth = np.where(depth == recording.declared.no_depth, np.uint16(0), depth)
        if not as_in_files:
            depth = _in_millimetres(depth, recording, lengths, depth_file)
        colors[index], depths[index] = cv2.cvtColor(color, cv2.COLOR_BGR2RGB), depth

    # Decoding releases the interpreter lock, so a few threads suffice.
    with ThreadPoolExecutor(max_workers=4) as pool:
        jobs = pool.map(read, range(len(frame_ids)))
        bar = tqdm(jobs, "reading frames", len(frame_ids), unit="frame", disable=not progress)
        for _ in bar:  # raises what a thread raised
            pass
    return Decoded(intrinsics, colors, depths)


def _read_depth(path: Path) -> UInt16[np.ndarray, "height width"]:
    """Depth as the file holds it. Raises DataError if it is no 16-bit image of one channel."""
    depth = _read(path, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise DataError(
            f"{path} is {depth.dtype} of shape {depth.shape}: depth is a 16-bit image of "
            "one channel; write it as a 16-bit PNG"
        )
    return depth


def ray_lengths(intrinsics: Intrinsics) -> Float[np.ndarray, "height width"]:
    """Length of every pixel's ray up to z = 1: distance along the ray over it is z-depth."""
    x = (np.arange(intrinsics.width) + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) + 0.5 - intrinsics.cy) / intrinsics.fy
    return np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)


def _in_millimetres(
    depth: UInt16[np.ndarray, "height width"],
    recording: Recording,
    lengths: Float[np.ndarray, "height width"],
    file: Path,
) -> UInt16[np.ndarray, "height width"]:
    scale, along = recording.declared.depth_scale, recording.declared.depth_along
    if scale == MILLIMETRES and along == "axis":
        return depth
    depth_mm = depth * (MILLIMETRES / scale)
    if along == "ray":
        depth_mm = depth_mm / lengths
    if depth_mm.max() > _FARTHEST_MM:
        raise DataError(
            f"{file} holds {depth_mm.max() / MILLIMETRES:.4g} m with {scale:g} depth values a "
            "metre: at most 65.535 m can be kept; set depth_scale or no_depth in sequence.toml"
        )
    return np.rint(depth_mm).astype(np.uint16)


class _Lens:
    """Takes the lens's distortion out of images; does nothing for a lens without."""

    def __init__(self, intrinsics: Intrinsics, distortion: tuple[float, ...]) -> None:
        self.maps = None
        if any(distortion):
            # OpenCV counts pixel centres as whole numbers.
            K = np.array([
                [intrinsics.fx, 0, intrinsics.cx - 0.5], [0, intrinsics.fy, intrinsics.cy - 0.5],
                [0, 0, 1],
            ])  # fmt: skip
            size = (intrinsics.width, intrinsics.height)
            self.maps = cv2.initUndistortRectifyMap(
                K, np.array(distortion), None, K, size, cv2.CV_32FC1
            )

    def straighten(
        self,
        color: UInt8[np.ndarray, "height width 3"],
        depth: UInt16[np.ndarray, "height width"],
    ) -> tuple[UInt8[np.ndarray, "height width 3"], UInt16[np.ndarray, "height width"]]:
        """Both images as a pinhole camera would have them."""
        if self.maps is None:
            return color, depth
        return (
            cv2.remap(color, *self.maps, cv2.INTER_LINEAR),
            cv2.remap(depth, *self.maps, cv2.INTER_NEAREST),
        )


def _read(path: Path, flags: int) -> np.ndarray:
    if not is_file(path):
        raise MissingError(f"no file {path}: a frame needs it; add it or remove the frame")
    return read_image(path, flags)
