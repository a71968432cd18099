"""The images of a recording, from files to arrays. Each file is read once and decoded once.

All arrays have one size, and the distortion of the lens is taken out of them.
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

_MAX_16_BITS = 65535  # as a depth value, cameras mean by it "farther than I can measure"
# At most so many bytes are held of files that were read for a digest and are not decoded yet.
_MAX_BYTES = 1_000_000_000
Pixels = Shaped[np.ndarray, "height width *channels"]
Depths = UInt16[np.ndarray, "n height width"]
Decoded = tuple[UInt8[np.ndarray, "n height width 3"], Depths]
"""RGB colours, and depth values in the unit of the files, 0 where none is measured."""


@lru_cache(maxsize=1)
def images_of(recording: Recording) -> "Images":
    """The images of a recording; a second call for the same recording returns the same object.

    Only those of the last recording are held: 1,600 frames of 640x480 take 2.5 GB, and those of
    several recordings may not fit into memory.
    """
    return Images(recording)


class Images:
    """The images of a recording, read when they are asked for and held in memory until `forget`.

    All must have the size of the frame that is read first.
    """

    def __init__(self, recording: Recording) -> None:
        """Begin with nothing read."""
        self.recording = recording
        self._digests: dict[Path, str] = {}  # SHA-256 of files that were read
        self._contents: dict[Path, bytes] = {}  # of files that were read and not yet decoded
        self._bytes_left = _MAX_BYTES  # how many more bytes `_contents` may hold
        self._first: dict[int, tuple[Pixels, Pixels]] = {}  # decoded to know the size, not yet used
        self._camera: Intrinsics | None = None  # known from the first image on, see `camera_of`
        self.forget()

    def forget(self) -> None:
        """Free the arrays of all frames, as after each part of a long recording."""
        self._ids = np.empty(0, int)  # numbers of the frames in `_arrays`, in rising order
        self._arrays: Decoded | tuple[()] = ()

    def contents(self) -> tuple[list[tuple[str, str, str]], str, Declaration]:
        """Values that change when a recording does, for the keys of the cache.

        Returns the folder, name and digest of every image; a digest of times, poses and camera; and
        the declaration. They do not depend on where the recording lies.
        """
        recording = self.recording
        files = recording.color_files + recording.depth_files
        for file in files:
            if file not in self._digests:
                content = self._content(file)  # stores the digest
                if len(content) < self._bytes_left:  # then it is decoded without another read
                    self._contents[file] = content
                    self._bytes_left -= len(content)
        images = [(file.parent.name, file.name, self._digests[file]) for file in files]
        digest = hashlib.sha256(repr(replace(recording.calibration, source=Path())).encode())
        digest.update(recording.times.tobytes() + recording.file_poses.tobytes())
        return images, digest.hexdigest(), recording.declared

    def arrays_of(self, ids: Frames) -> Decoded:
        """Colours and depths of the frames with these numbers (at least one).

        They stay in memory for the next call. If they lie there in even steps, as the frames of a
        slice usually do, the returned arrays are views of that memory; if not, they are copies.
        Raises DataError if a file is damaged, or is of another kind or size.
        """
        camera = self.camera_of(ids[0])
        all_ids = np.union1d(self._ids, ids)  # frames that are held, and those asked for
        if len(all_ids) > len(self._ids):
            shape = len(all_ids), camera.height, camera.width
            colors, depths = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint16)
            is_held = np.isin(all_ids, self._ids)
            if self._arrays:
                colors[is_held], depths[is_held] = self._arrays
            missing = np.flatnonzero(~is_held)  # places in the new arrays
            with ThreadPoolExecutor(4) as pool:  # decoding frees the GIL: a few suffice
                decoded = pool.map(self._decoded, all_ids[missing].tolist())
                for place, frame in zip(missing, decoded, strict=True):
                    colors[place], depths[place] = frame
            self._ids, self._arrays = all_ids, (colors, depths)
        places = np.searchsorted(self._ids, ids)
        steps = np.unique(np.diff(places)) if len(places) > 1 else [1]
        if len(steps) == 1 and steps[0] > 0:  # a slice gives a view, and an array of places a copy
            places = slice(places[0], places[-1] + 1, steps[0])
        colors, depths = self._arrays
        return colors[places], depths[places]

    def camera_of(self, first: int) -> Intrinsics:
        """The camera of all images, without its lens.

        The first call decodes the frame with the number `first` to know the size of the images.
        Raises DataError if one of its files is damaged or does not fit the calibration.
        """
        if self._camera:
            return self._camera
        recording = self.recording
        color, depth = self._pixels(first)
        self._first[first] = color, depth
        self._resize, note = _resizing(color, depth, recording)
        if note and note not in recording.notes:
            recording.notes.append(note)  # reports on the recording print its notes
        file = (recording.depth_files if self._resize else recording.color_files)[first]
        height, width = (depth if self._resize else color).shape[:2]
        self._camera = recording.calibration.for_size(width, height, file)
        # The place of each pixel in the distorted image; empty without distortion.
        self._maps = _undistortion(self._camera, recording.calibration.distortion)
        return self._camera

    def _decoded(self, index: int) -> tuple[Pixels, Pixels]:
        """Colour and depth of a frame in the camera's size, without the lens's distortion.

        Depth is in the unit of the files, and 0 where none is measured. `camera_of` must have been
        called: it sets what all images are made to fit.
        """
        recording, shape = self.recording, (self._camera.height, self._camera.width)
        color, depth = self._first.pop(index, None) or self._pixels(index)
        if self._resize:  # OpenCV takes the width first
            color = cv2.resize(color, shape[::-1], interpolation=cv2.INTER_AREA)
        _check(recording.color_files[index], color, np.uint8, (*shape, 3))
        _check(recording.depth_files[index], depth, np.uint16, shape)
        if self._maps:
            color = cv2.remap(color, *self._maps, cv2.INTER_LINEAR)
            # An interpolated depth would be a point between two surfaces.
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST)
        is_unmeasured = np.isin(depth, [*recording.declared.no_depth, _MAX_16_BITS])
        return color, np.where(is_unmeasured, 0, depth)

    def in_millimetres(self, depths: Depths, ids: Frames) -> Depths:
        """Depths (mm along the optical axis) of the frames `ids`, from the values in their files.

        Values that are millimetres along the axis are returned as they are. Raises DataError for a
        depth of more than 65.535 m.
        """
        declared = self.recording.declared
        meaning = declared.depth_scale, declared.depth_along, declared.depth_error_per_m
        if meaning == (1000, "axis", 0):
            return depths
        camera = self.camera_of(ids[0])
        y, x = np.indices(depths.shape[1:]) + 0.5  # pixel centres
        squares = ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2
        # The length of a pixel's ray up to a z-depth of 1.
        slant = np.sqrt(1 + squares) if declared.depth_along == "ray" else 1.0
        depths_mm = np.empty_like(depths)
        for place, index in enumerate(ids):
            depth_mm = depths[place] * (1000 / declared.depth_scale) / slant
            # The true depth is m + depth_error_per_m * m² for a measured m; here in millimetres.
            depth_mm *= 1 + declared.depth_error_per_m / 1000 * depth_mm
            if depth_mm.max() > _MAX_16_BITS:
                found = f"{self.recording.depth_files[index]} holds {depth_mm.max() / 1000:.4g} m"
                scale = f"{declared.depth_scale:g} depth values a metre"
                limit = "at most 65.535 m can be kept; set depth_scale or no_depth in sequence.toml"
                raise DataError(f"{found} with {scale}: {limit}")
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
        """The pixels of a PNG or JPEG file as they are stored, colour as RGB of 8 bits.

        A photograph may ask viewers to turn it. It is not turned here, because its depth image
        cannot ask for that.
        """
        advice = "copy it again, or remove the frame's image, depth and pose"
        with naming_damaged(path, "PNG or JPEG", advice):
            content = io.BytesIO(self._content(path))
            with Image.open(content, formats=("PNG", "JPEG")) as image:
                image.verify()  # checksums, which decoding does not look at
            with Image.open(content) as image:
                is_8_bit = not image.mode.startswith("I")  # `_check` refuses colour of other types
                return np.array(image.convert("RGB") if is_color and is_8_bit else image)

    def _content(self, path: Path) -> bytes:
        """The bytes of a file, which is opened nowhere else; its digest is stored on the way.

        Bytes that `contents` left in memory are used once and freed.
        """
        content = self._contents.pop(path, None)
        if content is None:
            content = path.read_bytes()
            self._digests[path] = hashlib.sha256(content).hexdigest()
        return content


def _resizing(color: np.ndarray, depth: np.ndarray, recording: Recording) -> tuple[bool, str]:
    """Whether colour images are resized to the size of depth images, and a note for the user.

    They are resized if the format says so, or if they are larger in the same proportions, as phones
    with LiDAR write them. In the second case the note says so; otherwise it is empty. Raises
    DataError in the second case if the calibration does not say for which of the sizes it is.
    """
    if recording.format.resize_color:
        return True, ""
    height, width = color.shape[:2]
    depth_height, depth_width = depth.shape[:2]
    factor = width / depth_width
    if factor <= 1 or abs(factor * depth_height - height) > 1:  # sides are rounded to whole pixels
        return False, ""
    sizes = f"{width}x{height} and {depth_width}x{depth_height}"
    if not recording.calibration.size:
        doubt = f"{recording.calibration.source} does not say which of both it is for"
        raise DataError(f"colour and depth are {sizes}, and {doubt}: write JSON with width, height")
    return True, f"colour is made as small as depth: {sizes}"


def _check(path: Path, image: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
    """Raises DataError unless the image of the file `path` has this type and shape."""
    if image.dtype != dtype or image.shape != shape:
        wanted = f"{dtype.__name__} of shape {shape}, the size of the frame that was read first"
        found = f"{path} is {image.dtype} of shape {image.shape}"
        raise DataError(f"{found}: it must be {wanted} (depth has 16 bits and one channel)")


def _undistortion(camera: Intrinsics, distortion: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Maps for `cv2.remap` that take a lens's distortion (OpenCV's coefficients) out of an image.

    They hold the column and the row in the distorted image of each pixel of the undistorted one.
    Empty if all coefficients are 0.
    """
    if not any(distortion):
        return ()
    # For OpenCV the centres of pixels have whole coordinates.
    K = camera_matrix(camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5)
    size = (camera.width, camera.height)
    # None: no rotation. The second K: the undistorted image keeps the camera matrix.
    return cv2.initUndistortRectifyMap(K, np.array(distortion), None, K, size, cv2.CV_32FC1)
