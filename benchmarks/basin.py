"""The basin of convergence: from which distance a tracker still finds the pose of a frame."""

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
"""Distances of the starts from the true pose, in cm and degrees: from the motion of a frame to what
a lost camera is off."""
RECOVERED_M, RECOVERED_DEG = 0.02, 1.0
"""A search recovers if it ends nearer to the true pose than both."""


def find_from_afar(
    scene: Scene,
    methods: Mapping[str | Method, int],
    preset: Preset,
    offsets: Sequence[tuple[int, int]] = OFFSETS,
    n_starts: int = 24,
    frames: str = "::10",
) -> pd.DataFrame:
    """Track single frames from starts that are off in random directions.

    Each start is turned by the offset's degrees about a random axis, and moved by its centimetres
    in a random direction. All methods have the same starts.

    Args:
        methods: the methods, and the steps that each may take.

    Returns:
        A row for each search: method, offset ("4 cm, 4°"), error_m, error_deg, recovered, and lost,
        the tracker's own verdict. Shares are `groupby(["method", "offset"])["recovered"].mean()`.
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
    """A twist (omega in rad, v in m) of given lengths, in directions that the seed decides."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    return torch.cat([radians(offset_deg) * directions[0], 0.01 * offset_cm * directions[1]])
