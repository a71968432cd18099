"""Recordings of all formats; those of phones join the table as a format of one's own does."""

from nbtrack.recordings import phones

__all__ = ["phones"]
