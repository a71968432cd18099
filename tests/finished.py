"""Commands whose small results (`finished` in conftest) tests spoil, export or use again."""

from pathlib import Path

import pytest

SETTINGS = (
    "scenes.n_frames=6", "scenes.width=32", "network.neus.width=16", "mapping.neus.iterations=30",
    "mapping.neus.n_rays=32", "mapping.neus.holdout_every=0", "mapping.neus.learning_rate=3e-3",
    "tracking.sdf.n_pixels=16", "scenes.track_frames=:",
)  # fmt: skip
SET = [word for setting in SETTINGS for word in ("--set", setting)]
MAP = ["map", "living_room", "--field", "neus", "--out", "map", *SET]
TRACK = ["track", "living_room", "--tracker", "sdf", "--steps", "2", "--out", "run", *SET]
GIVEN = [*TRACK, "--map-from"]
OWN = [*TRACK, "--field", "neus"]


def isolate(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Work in a folder, with a cache there."""
    patch.setenv("NBTRACK_RUNS", str(folder / "runs"))
    patch.chdir(folder)
