"""Readers of recordings. A module in this folder that registers a format makes it known to all."""

import importlib
import pkgutil

from nbtrack.data.readers.base import (
    FORMATS,
    Format,
    Request,
    find_format,
    open_recording,
    register,
)
from nbtrack.data.readers.decoding import Decoded, decode, ray_lengths
from nbtrack.data.readers.recording import Recording

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "FORMATS",
    "Decoded",
    "Format",
    "Recording",
    "Request",
    "decode",
    "find_format",
    "open_recording",
    "ray_lengths",
    "register",
]
