"""Recordings of all formats."""
