"""From files to arrays: recordings on disk as sequences in memory, whatever their format is.

Images have one size, depth is in mm along the optical axis, and a lens's distortion is taken out.
"""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int, Shaped, UInt8, UInt16
from PIL import Image

from nbtrack.core.arrays import DepthImage, Frames, Position
from nbtrack.core.camera import Intrinsics
from nbtrack.data.sequence import RgbdSequence
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged
from nbtrack.recordings.calibration import camera_matrix
from nbtrack.recordings.formats import IMAGE_SUFFIXES, Declaration
from nbtrack.recordings.recording import Recording, open_recording

_MAX_16_BITS = 65535  # also what cameras write for "farther than I can measure"
_SLICE = r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?"
# Beyond so many times the distance that nine in ten depths lie within, they are no measurement: of
# eleven rooms and two real recordings the farthest was 2.1 times as far (our choice).
FAR = 5.0


def parse_frames(text: str) -> slice:
    """A Python slice written `A:B:S` with S > 0; every part may be missing. Or raises DataError.

    >>> parse_frames("10:50:2"), parse_frames(":100")
    (slice(10, 50, 2), slice(None, 100, None))
    """
    match = re.fullmatch(_SLICE, text.replace(" ", ""))
    if not match:
        raise DataError(f"frames {text!r} is no slice: write A:B, or A:B:S with S above 0")
    return slice(*(int(part) if part else None for part in match.groups()))


def read_sequence(
    folder: Path | str, frames: slice = slice(None), **options: str | None
) -> RgbdSequence:
    """Read a recording; `options` are those of `open_recording`: format, depth folder, pose file.

    A Neural RGB-D scene also has depth in `depth` and `depth_with_noise`, and poses in
    `trainval_poses.txt` (BundleFusion's, in another world frame). Raises as `open_recording` and
    `read_frames` do.
    """
    return read_frames(open_recording(folder, **options), frames)


def read_frames(
    recording: Recording,
    frames: slice | Frames = slice(None),
    needs_poses: bool = True,
    origin: Position | None = None,
) -> RgbdSequence:
    """Frames of an opened recording: those of given numbers, or those of a slice.

    Of a slice frames without a pose are left out if `needs_poses`. Positions are relative to
    `origin` (m, the recording's world), by default the recording's own. Raises DataError if an
    image cannot be read, or no frame is left.
    """
    ids = select_frames(recording, frames, needs_poses) if isinstance(frames, slice) else frames
    camera, colors, depths_mm = decode(recording, ids)
    origin = recording.origin if origin is None else origin
    T_world_camera = recording.T_world_camera[ids]
    T_world_camera[:, :3, 3] -= origin
    return RgbdSequence(
        recording.name, camera, colors, depths_mm, T_world_camera=T_world_camera, frame_ids=ids,
        times=recording.times[ids], origin=origin,
        declared_unit=recording.declared.metres_per_unit or None,
    )  # fmt: skip


def select_frames(recording: Recording, frames: slice, needs_poses: bool = True) -> Frames:
    """Numbers of the frames of a slice; if `needs_poses`, only of those that have a pose.

    Raises DataError if there is none.
    """
    frame_ids = np.arange(len(recording))[frames]
    found = f"{len(frame_ids)} of the {len(recording)} frames in {recording.folder} are selected"
    if needs_poses:
        frame_ids = frame_ids[recording.has_pose[frame_ids]]
        found += f", and {len(frame_ids)} of these have a pose"
    if not len(frame_ids):
        choose = "choose others (--frames of map and track, scenes.track_frames of tables)"
        add = f"add poses ({recording.pose_file or ' or '.join(recording.format.poses)})"
        track = "or track in a map of the same place with --map-from, which needs none"
        raise DataError(f"{found}: {choose}, {add}, {track}")
    return frame_ids


def without_outliers(sequence: RgbdSequence) -> RgbdSequence:
    """The sequence without depths farther than `far_limit`; as it is, where there are none."""
    sample = sequence.depths_mm[:, ::4, ::4]  # every sixteenth pixel suffices for a quantile
    is_far = sequence.depths_mm > far_limit(sample[sample > 0])
    if not is_far.any():
        return sequence
    return replace(sequence, depths_mm=np.where(is_far, np.uint16(0), sequence.depths_mm))


def far_limit(depths: np.ndarray) -> float:
    """The distance beyond which measured depths are outliers, in their unit."""
    return FAR * float(np.quantile(depths, 0.9)) if len(depths) else np.inf


def decode(
    recording: Recording, frame_ids: Int[np.ndarray, "n"]
) -> tuple[Intrinsics, UInt8[np.ndarray, "n height width 3"], UInt16[np.ndarray, "n height width"]]:
    """The camera, and RGB colours and depths (mm along the axis) of some frames (at least one).

    Raises DataError if a file is damaged, of another kind or size, or holds depths over 65.535 m.
    """
    color_files = [recording.color_files[i] for i in frame_ids]
    depth_files = [recording.depth_files[i] for i in frame_ids]
    color = _read_image(color_files[0], is_color=True)
    depth = _read_depth(depth_files[0], recording)
    resize, note = _resizing(color, depth, recording)
    if note and note not in recording.notes:
        recording.notes.append(note)  # of the caller's recording, for reports of what was read
    sized_file = (depth_files if resize else color_files)[0]  # its size is wanted of all others
    height, width = (depth if resize else color).shape[:2]
    camera = recording.calibration.for_size(width, height, sized_file)
    maps = _undistortion(camera, recording.calibration.distortion)
    colors = np.empty((len(frame_ids), height, width, 3), np.uint8)
    depths = np.empty((len(frame_ids), height, width), np.uint16)

    def read(index: int) -> None:
        color = _read_image(color_files[index], is_color=True)
        depth = _read_depth(depth_files[index], recording)
        if resize:
            color = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
        _check(color_files[index], color, np.uint8, (height, width, 3), sized_file)
        _check(depth_files[index], depth, np.uint16, (height, width), sized_file)
        if maps:
            color = cv2.remap(color, *maps, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)  # no points between two surfaces
        depth[(depth == recording.declared.no_depth) | (depth == _MAX_16_BITS)] = 0
        depths[index] = _in_millimetres(depth, recording.declared, camera, depth_files[index])
        colors[index] = color

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding frees the GIL: a few suffice
        list(pool.map(read, range(len(frame_ids))))  # a list, so that errors are raised here
    return camera, colors, depths


def _read_image(path: Path, is_color: bool) -> Shaped[np.ndarray, "height width *channels"]:
    """A PNG or JPEG file's pixels as they are stored, colour as RGB of 8 bits.

    The orientation that a file gives to viewers does not count: depth images know none.
    """
    advice = "copy it again, or remove the frame's image, depth and pose"
    with naming_damaged(path, "PNG or JPEG", advice):
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            image.verify()  # the checksums of a PNG; reading finds what a JPEG lacks
        with Image.open(path) as image:
            is_8_bit = not image.mode.startswith("I")  # others are left for `_check` to refuse
            return np.array(image.convert("RGB") if is_color and is_8_bit else image)


def _read_depth(path: Path, recording: Recording) -> Shaped[np.ndarray, "height width *channels"]:
    """A depth map's values as they are stored, or as the format's own reader gives them."""
    if recording.format.read_depth and path.suffix.lower() not in IMAGE_SUFFIXES:
        return recording.format.read_depth(path, recording.calibration)
    return _read_image(path, is_color=False)


def _resizing(color: np.ndarray, depth: np.ndarray, recording: Recording) -> tuple[bool, str]:
    """Whether colour is to be given the size of depth, and a note.

    It is if its format says so, or if it is larger in the same proportions, as phones with LiDAR
    give it. The note tells of the second case and is empty otherwise. Raises DataError if the
    calibration then does not say which of both sizes it is for.
    """
    if recording.format.resize_color:
        return True, ""
    height, width = color.shape[:2]
    depth_height, depth_width = depth.shape[:2]
    factor = width / depth_width
    if factor <= 1 or abs(factor * depth_height - height) > 1:  # a pixel is rounding
        return False, ""
    sizes = f"{width}x{height} and {depth_width}x{depth_height}"
    camera = recording.calibration
    if not camera.size:
        doubt = f"{camera.source} does not say which of both it is for"
        advice = "write a JSON file with fx, fy, cx, cy and their width and height"
        raise DataError(f"colour and depth are {sizes}, and {doubt}: {advice}")
    return True, f"colour is made as small as depth: {sizes}"


def _check(path: Path, image: np.ndarray, dtype: type, shape: tuple[int, ...], sized: Path) -> None:
    """Raises DataError unless an image has this type and shape; `sized` is a file of that size."""
    if image.dtype != dtype or image.shape != shape:
        wanted = f"{dtype.__name__} of shape {shape}, for the size of {sized}"
        found = f"{path} is {image.dtype} of shape {image.shape}"
        raise DataError(f"{found}: it must be {wanted} (depth has 16 bits and one channel)")


def _in_millimetres(
    depth: np.ndarray, declared: Declaration, camera: Intrinsics, file: Path
) -> DepthImage:
    """Depth along the optical axis (mm) of a depth map's values, which mean what is declared.

    Raises DataError, which names `file`, for more than 65.535 m.
    """
    depth_mm = depth * (1000 / declared.depth_scale)
    if declared.depth_along == "ray":
        y, x = np.indices(depth.shape) + 0.5  # pixel centres
        squares = ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2
        depth_mm /= np.sqrt(1 + squares)
    depth_mm = depth_mm * (1 + declared.depth_error_per_m / 1000 * depth_mm)
    if depth_mm.max() > _MAX_16_BITS:
        found = f"{file} holds {depth_mm.max() / 1000:.4g} m"
        scale = f"{declared.depth_scale:g} depth values a metre"
        advice = "set depth_scale or no_depth in sequence.toml"
        raise DataError(f"{found} with {scale}: at most 65.535 m can be kept; {advice}")
    return np.rint(depth_mm).astype(np.uint16)


def _undistortion(camera: Intrinsics, distortion: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """For cv2.remap: where pixels of the camera without its lens lie in the image.

    Empty if the lens distorts nothing.
    """
    if not any(distortion):
        return ()
    # OpenCV counts pixel centres as whole numbers.
    K = camera_matrix(camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
    size = (camera.width, camera.height)
    # None: no rotation. The second K: the undistorted image keeps the camera matrix.
    return cv2.initUndistortRectifyMap(K, np.array(distortion), None, K, size, cv2.CV_32FC1)
