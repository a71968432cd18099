"""RGB-D camera tracking in neural scene representations: a reproducible paper package."""

import importlib
from typing import Any

__version__ = "0.1.0"

# Loaded when they are first used, so that `--help` needs no torch.
_MODULES = {
    "data.frame": ["Frame"],
    "recordings.reading": ["read_sequence"],
    "tracking.methods": ["METHODS", "Method"],
    "experiments.presets": ["claim", "load_preset"],
    "experiments.grid": ["map_scene", "map_scenes", "read_run", "track_scenes"],
    "experiments.scenes": ["open_scene", "open_scenes"],
    "fields": ["FIELDS", "Field", "LearnedField"],
    "mapping.files": ["Map", "read_map", "write_map"],
    "tracking": ["TRACKERS", "AdamTracker", "Tracker", "make_tracker"],
}
_FACE = {name: module for module, names in _MODULES.items() for name in names}
__all__ = [*_FACE]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _FACE:
        raise AttributeError(f"module 'nbtrack' has no attribute {name!r}")
    return getattr(importlib.import_module(f"nbtrack.{_FACE[name]}"), name)
