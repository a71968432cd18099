"""Recordings of all formats; those of phones join the table as a format of one's own does."""

from nbtrack.recordings import polycam, record3d

__all__ = ["polycam", "record3d"]
