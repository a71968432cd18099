"""Experiments: methods, presets, jobs, and the commands that run them.

Here what goes beyond the paper is registered, and so are installed packages that have an entry
point of the group `nbtrack`: a module that adds to FIELDS, TRACKERS or METHODS when imported.
"""

from importlib.metadata import entry_points

import nbtrack.beyond  # registers its fields and trackers

for plugin in entry_points(group="nbtrack"):
    plugin.load()
