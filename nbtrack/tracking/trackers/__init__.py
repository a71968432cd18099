"""Trackers. A module in this folder that registers a tracker makes it known everywhere."""

import importlib
import pkgutil

from nbtrack.tracking.trackers.base import (
    TRACKERS,
    AdamTracker,
    Tracker,
    paper_trackers,
    tracker_class,
)

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

_ordered = sorted(TRACKERS.items(), key=lambda item: (item[1].table_order, item[0]))
TRACKERS.clear()
TRACKERS.update(_ordered)

__all__ = ["TRACKERS", "AdamTracker", "Tracker", "paper_trackers", "tracker_class"]
