"""The basin of convergence: from how far off a tracker still finds the pose of a frame."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import radians

import numpy as np
import pandas as pd
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nbtrack import Method, make_tracker, map_scene
from nbtrack.beyond.lm_solver import retract
from nbtrack.experiments.methods import find_methods
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.settings import with_settings
from nbtrack.tracking import StepBudget

OFFSETS = ((1, 1), (2, 2), (4, 4), (8, 6), (12, 9), (20, 15), (30, 20), (50, 30))
"""How far off the starts are: cm and degrees, from a frame's motion to a lost camera's."""
RECOVERED_M, RECOVERED_DEG = 0.02, 1.0
"""A start is recovered when its pose ends so near the truth."""


def find_from_afar(
    scene: Scene,
    methods: Mapping[str | Method, int],
    preset: Preset,
    offsets: Sequence[tuple[int, int]] = OFFSETS,
    n_starts: int = 24,
    frames: str = "::10",
) -> pd.DataFrame:
    """Where each tracker ends, from starts that are off in random directions.

    Each start is turned by the offset's degrees about one random axis and moved by its centimetres
    along another, the same for every method.

    Args:
        methods: with the steps that each is allowed.

    Returns:
        A row a search: method, offset ("4 cm, 4°"), error_m, error_deg, recovered, and lost, the
        tracker's own verdict. Shares are `groupby(["method", "offset"])["recovered"].mean()`.
    """
    rows, sequence = [], scene.read(frames)
    searches = [(offset, start) for offset in offsets for start in range(n_starts)]
    for method, steps in zip(find_methods([*methods]), methods.values(), strict=True):
        changed = with_settings(preset, *method.settings)
        settings = changed.tracking_of(method.tracker)
        if method.tracker == "lm":  # one descent from each start
            settings = replace(settings, n_restarts=0)
        field, T_first = map_scene(scene, method.field, changed).field, sequence.T_world_camera[0]
        tracker = make_tracker(method.tracker, field, T_first, StepBudget(steps), settings)
        with ProgressBar(f"searches, {method.label}", len(searches)) as bar:
            for done, ((cm, degrees), start) in enumerate(searches, start=1):
                frame = sequence[start % len(sequence)]
                offset = twist(start, cm, degrees).double().numpy()
                tracker.restart(retract(frame.T_world_camera, offset))
                found = tracker.track(frame)
                off = np.linalg.inv(frame.T_world_camera) @ found.T_world_camera
                error_m = float(np.linalg.norm(off[:3, 3]))
                error_deg = float(np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()))
                is_near = error_m < RECOVERED_M and error_deg < RECOVERED_DEG
                name = f"{cm} cm, {degrees}°"
                rows.append((method.label, name, error_m, error_deg, is_near, found.lost))
                bar.move_to(done)
    columns = ["method", "offset", "error_m", "error_deg", "recovered", "lost"]
    return pd.DataFrame(rows, columns=columns)


def twist(seed: int, offset_cm: int, offset_deg: int) -> Tensor:
    """A twist (omega in rad, v in m) in directions that depend on the seed alone."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    return torch.cat([radians(offset_deg) * directions[0], 0.01 * offset_cm * directions[1]])
