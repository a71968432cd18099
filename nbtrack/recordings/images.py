"""Images of a recording, from files to arrays: each file is read once and decoded once.

Images have one size, and a lens's distortion is taken out.
"""

import hashlib
import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8, UInt16
from PIL import Image

from nbtrack.core.arrays import Frames
from nbtrack.core.camera import Intrinsics
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged
from nbtrack.recordings.calibration import camera_matrix
from nbtrack.recordings.formats import IMAGE_SUFFIXES, Declaration
from nbtrack.recordings.recording import Recording

_MAX_16_BITS = 65535  # also what cameras write for "farther than I can measure"
_MAX_BYTES = 1_000_000_000  # of files that were read for a digest and are not decoded yet
Pixels = Shaped[np.ndarray, "height width *channels"]
Depths = UInt16[np.ndarray, "n height width"]
Decoded = tuple[UInt8[np.ndarray, "n height width 3"], Depths]
"""RGB colours, and depth values as they are in the files; 0: not measured."""


@lru_cache(maxsize=1)
def images_of(recording: Recording) -> "Images":
    """The images of a recording, shared by all that read it until another one is read.

    1,600 frames of 640x480 take 2.5 GB: those of several recordings need not fit into memory.
    """
    return Images(recording)


class Images:
    """What was read of the images of a recording; all have the size of the first frame read."""

    def __init__(self, recording: Recording) -> None:
        """Begin with nothing read."""
        self.recording = recording
        self._digests: dict[Path, str] = {}
        self._contents: dict[Path, bytes] = {}  # of files that were read and not yet decoded
        self._bytes_left = _MAX_BYTES
        self._first: dict[int, tuple[Pixels, Pixels]] = {}  # decoded to know the size, not yet used
        self._camera: Intrinsics | None = None
        self.forget()

    def forget(self) -> None:
        """Free the frames that are kept, as in one pass over a long recording."""
        self._ids = np.empty(0, int)  # of the frames that are kept, in order
        self._kept: Decoded | tuple[()] = ()

    def contents(self) -> tuple[list[tuple[str, str, str]], str, Declaration]:
        """What changes when a recording does: the folder, name and digest of every image, a digest
        of times, poses and camera, and the declaration. Where the recording lies does not count."""
        recording = self.recording
        files = recording.color_files + recording.depth_files
        for file in files:
            if file not in self._digests:
                content = self._content(file)
                if len(content) < self._bytes_left:
                    self._contents[file] = content
                    self._bytes_left -= len(content)
        images = [(file.parent.name, file.name, self._digests[file]) for file in files]
        digest = hashlib.sha256(repr(replace(recording.calibration, source=Path())).encode())
        digest.update(recording.times.tobytes() + recording.file_poses.tobytes())
        return images, digest.hexdigest(), recording.declared

    def kept(self, ids: Frames) -> Decoded:
        """Colours and depths of some frames (at least one), which are kept for the next call.

        The arrays are views of the kept ones where the frames' numbers rise evenly, as in a slice.
        Raises DataError if a file is damaged, or of another kind or size.
        """
        camera = self.camera_of(ids[0])
        all_ids = np.union1d(self._ids, ids)
        if len(all_ids) > len(self._ids):
            shape = len(all_ids), camera.height, camera.width
            colors, depths = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint16)
            is_kept = np.isin(all_ids, self._ids)
            # Not strict: at first nothing is kept, and `_kept` is empty.
            for array, before in zip((colors, depths), self._kept, strict=False):
                array[is_kept] = before
            missing = np.flatnonzero(~is_kept)
            with ThreadPoolExecutor(4) as pool:  # decoding frees the GIL: a few suffice
                decoded = pool.map(self._decoded, all_ids[missing].tolist())
                for place, frame in zip(missing, decoded, strict=True):
                    colors[place], depths[place] = frame
            self._ids, self._kept = all_ids, (colors, depths)
        places = np.searchsorted(self._ids, ids)
        steps = np.unique(np.diff(places)) if len(places) > 1 else [1]
        if len(steps) == 1 and steps[0] > 0:
            places = slice(places[0], places[-1] + 1, steps[0])
        colors, depths = self._kept
        return colors[places], depths[places]

    def camera_of(self, first: int) -> Intrinsics:
        """The camera of all images. The first call decodes the frame `first` to know their size.

        Raises DataError as `kept` does.
        """
        if self._camera:
            return self._camera
        recording = self.recording
        color, depth = self._pixels(first)
        self._first[first] = color, depth
        self._resize, note = _resizing(color, depth, recording)
        if note and note not in recording.notes:
            recording.notes.append(note)  # of the caller's recording, for reports of what was read
        # The file whose image has the size that all must have; messages name it.
        self._sized = (recording.depth_files if self._resize else recording.color_files)[first]
        height, width = (depth if self._resize else color).shape[:2]
        self._camera = recording.calibration.for_size(width, height, self._sized)
        # Where each pixel lies in the distorted image; empty without distortion.
        self._maps = _undistortion(self._camera, recording.calibration.distortion)
        return self._camera

    def _decoded(self, index: int) -> tuple[Pixels, Pixels]:
        """A frame of the camera's size, without its lens; depth is 0 where it is not measured."""
        recording, shape = self.recording, (self._camera.height, self._camera.width)
        color, depth = self._first.pop(index, None) or self._pixels(index)
        if self._resize:
            color = cv2.resize(color, shape[::-1], interpolation=cv2.INTER_AREA)
        _check(recording.color_files[index], color, np.uint8, (*shape, 3), self._sized)
        _check(recording.depth_files[index], depth, np.uint16, shape, self._sized)
        if self._maps:
            color = cv2.remap(color, *self._maps, cv2.INTER_LINEAR)
            # Not interpolated, which would make points between two surfaces.
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST)
        is_none = (depth == recording.declared.no_depth) | (depth == _MAX_16_BITS)
        return color, np.where(is_none, 0, depth)

    def in_millimetres(self, depths: Depths, ids: Frames) -> Depths:
        """Depths (mm along the optical axis) from the stored ones of frames with these numbers.

        Where the stored values are millimetres along the axis, they are returned as they are.
        Raises DataError for more than 65.535 m.
        """
        declared = self.recording.declared
        meaning = declared.depth_scale, declared.depth_along, declared.depth_error_per_m
        if meaning == (1000, "axis", 0):
            return depths
        camera = self.camera_of(ids[0])
        y, x = np.indices(depths.shape[1:]) + 0.5  # pixel centres
        squares = ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2
        slant = np.sqrt(1 + squares) if declared.depth_along == "ray" else 1.0
        depths_mm = np.empty_like(depths)
        for place, index in enumerate(ids):
            depth_mm = depths[place] * (1000 / declared.depth_scale) / slant
            depth_mm *= 1 + declared.depth_error_per_m / 1000 * depth_mm
            if depth_mm.max() > _MAX_16_BITS:
                found = f"{self.recording.depth_files[index]} holds {depth_mm.max() / 1000:.4g} m"
                limit = "at most 65.535 m can be kept; set depth_scale or no_depth in sequence.toml"
                raise DataError(
                    f"{found} with {declared.depth_scale:g} depth values a metre: {limit}"
                )
            depths_mm[place] = np.rint(depth_mm)
        return depths_mm

    def _pixels(self, index: int) -> tuple[Pixels, Pixels]:
        """Colour and depth values of a frame as they are stored, of any size."""
        recording = self.recording
        file = recording.depth_files[index]
        color = self._read_image(recording.color_files[index], is_color=True)
        if recording.format.read_depth and file.suffix.lower() not in IMAGE_SUFFIXES:
            content = self._content(file)
            return color, recording.format.read_depth(content, file, recording.calibration)
        return color, self._read_image(file, is_color=False)

    def _read_image(self, path: Path, is_color: bool) -> Pixels:
        """A PNG or JPEG file's pixels as they are stored, colour as RGB of 8 bits.

        The orientation that a file gives to viewers does not count: depth images know none.
        """
        advice = "copy it again, or remove the frame's image, depth and pose"
        with naming_damaged(path, "PNG or JPEG", advice):
            content = io.BytesIO(self._content(path))
            with Image.open(content, formats=("PNG", "JPEG")) as image:
                image.verify()  # checksums, which decoding does not look at
            with Image.open(content) as image:
                is_8_bit = not image.mode.startswith("I")  # others are left for `_check` to refuse
                return np.array(image.convert("RGB") if is_color and is_8_bit else image)

    def _content(self, path: Path) -> bytes:
        """What is in a file, which is opened here and nowhere else."""
        content = self._contents.pop(path, None)
        if content is None:
            content = path.read_bytes()
            self._digests[path] = hashlib.sha256(content).hexdigest()
        return content


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
        doubt = f"{camera.source} does not say which of both it is for: write width and height too"
        raise DataError(f"colour and depth are {sizes}, and {doubt}, into a JSON file")
    return True, f"colour is made as small as depth: {sizes}"


def _check(path: Path, image: np.ndarray, dtype: type, shape: tuple[int, ...], sized: Path) -> None:
    """Raises DataError unless an image has this type and shape; `sized` is a file of that size."""
    if image.dtype != dtype or image.shape != shape:
        wanted = f"{dtype.__name__} of shape {shape}, for the size of {sized}"
        found = f"{path} is {image.dtype} of shape {image.shape}"
        raise DataError(f"{found}: it must be {wanted} (depth has 16 bits and one channel)")


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
