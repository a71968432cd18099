"""Decode image files, and refuse those that are damaged."""

import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from nbtrack.core.errors import DataError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK_OVERHEAD = 12  # bytes of a PNG chunk beside its content: length, type, checksum
_JPEG_END = b"\xff\xd9"
_JPEG_TAIL = 1024  # bytes within which the end marker must come: some cameras append notes


def read_image(path: Path, flags: int) -> Shaped[np.ndarray, "height width *channels"]:
    """Decoded PNG or JPEG file, as OpenCV gives it with `flags`.

    Depending on its version OpenCV fills the missing part of a damaged file with whatever it
    has, or complains on standard error. Hence the file is checked first, which takes a fortieth
    of the time that decoding does.

    Raises:
        DataError: the file is cut short, damaged or not an image.
    """
    content = np.fromfile(path, dtype=np.uint8)
    image = cv2.imdecode(content, flags) if _is_complete(content) else None
    if image is None:
        raise DataError(
            f"{path} is damaged or not a complete PNG or JPEG ({len(content)} bytes): copy it "
            "again, or remove the frame's image, depth and pose"
        )
    return image


def _is_complete(content: UInt8[np.ndarray, "bytes"]) -> bool:
    if content[:8].tobytes() == _PNG_SIGNATURE:
        return _png_is_intact(memoryview(content))
    # Compressed JPEG data never holds the end marker's two bytes.
    return _JPEG_END in content[-_JPEG_TAIL:].tobytes()


def _png_is_intact(content: memoryview) -> bool:
    """Whether all chunks up to the closing one are there and their checksums agree."""
    start = len(_PNG_SIGNATURE)
    while start + _CHUNK_OVERHEAD <= len(content):
        end = start + _CHUNK_OVERHEAD + int.from_bytes(content[start : start + 4], "big")
        checksum = int.from_bytes(content[end - 4 : end], "big")
        if end > len(content) or zlib.crc32(content[start + 4 : end - 4]) != checksum:
            return False
        if content[start + 4 : start + 8] == b"IEND":
            return True
        start = end
    return False
