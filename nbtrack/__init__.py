"""RGB-D camera tracking in neural scene representations: a reproducible paper package."""

import importlib
from typing import Any

__version__ = "0.1.0"

# Loaded when they are first used, so that `--help` needs no torch.
_FACE = {
    "Frame": "data.frame",
    "METHODS": "experiments.methods",
    "Method": "experiments.methods",
    "load_preset": "experiments.presets",
    "make_tracker": "tracking",
    "map_scene": "experiments.results",
    "map_scenes": "experiments.results",
    "open_scene": "experiments.scenes",
    "open_scenes": "experiments.scenes",
    "read_map": "mapping.files",
    "read_run": "experiments.results",
    "read_sequence": "data.sequence",
    "track_scenes": "experiments.results",
}
__all__ = [*_FACE]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _FACE:
        raise AttributeError(f"module 'nbtrack' has no attribute {name!r}")
    return getattr(importlib.import_module(f"nbtrack.{_FACE[name]}"), name)
