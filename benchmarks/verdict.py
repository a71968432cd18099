"""Fit the coefficients of `nbtrack/beyond/verdict.py`: the probability that a pose of LM is wrong.

    python benchmarks/verdict.py RECORDING

The data are poses of LM in corrected maps of the two rooms for tuning and of a recording. Frames
are tracked on the mapped path and on another one, slow and fast; searched for from wrong starts;
shown to the map of another room; and tracked in a map of the first part of the path.
Prints intercept and coefficients, and both kinds of mistakes at some thresholds. It takes minutes.
"""

import sys
from collections.abc import Iterator
from itertools import product
from math import radians
from unittest import mock

import numpy as np
import pandas as pd
import torch
from motions import HAND_HELD
from scipy.optimize import minimize

from nbtrack import METHODS, load_preset, make_tracker, map_scene, open_scene, open_scenes
from nbtrack.beyond import verdict
from nbtrack.beyond.lm import LmSettings
from nbtrack.beyond.lm_solver import retract
from nbtrack.beyond.verdict import WRONG_DEG, WRONG_M, features
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments.jobs import run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.fields import Field
from nbtrack.machinery.settings import with_settings
from nbtrack.tracking import StepBudget, track_sequence
from nbtrack.tracking.metrics import pose_errors

STIFFNESS = 1e-3  # weight of the squared coefficients in the loss
GROWS = (False, False, True, True)  # whether the log odds of a wrong pose grow with each feature
OFFSETS = ((10, 8), (20, 15), (50, 40), (150, 90))  # cm, degrees


def main() -> None:
    """Collect poses of LM, fit the coefficients, and print them."""
    torch.set_num_threads(1)
    tuning = "scenes.names=['bedroom', 'kitchen_nook']"
    preset, second = (
        load_preset("smoke", settings=[tuning, *HAND_HELD, f"scenes.seed={n}"]) for n in (0, 1)
    )
    scenes = [*open_scenes(preset), *(open_scene(folder, preset) for folder in sys.argv[1:])]
    method = METHODS["corrected"]
    changed = with_settings(preset, *method.settings)
    fields = [map_scene(scene, method.field, changed).field for scene in scenes]
    parts = [part_of(scene, method.field, changed) for scene in scenes]
    paths = [[scene] for scene in scenes]
    for place, other in zip(paths, open_scenes(second), strict=False):
        place.append(other)
    print_fit(pd.concat([*collected(fields, paths), *in_parts(parts, scenes)]))


def collected(fields: list[Field], paths: list[list[Scene]]) -> Iterator[pd.DataFrame]:
    """Reports of LM and errors of its poses, in maps of whole paths.

    `paths[i]` are the scenes that are tracked in the map `fields[i]`.
    """
    for (place, field), n_pixels in product(enumerate(fields), (512, 2048)):
        for scene, frames in product(paths[place], ("::2", "::4", "::8")):
            found = tracked(field, scene.read(frames), n_pixels)
            yield found.assign(kind="tracked", place=place)
        for scene, (cm, degrees), steps in product(paths[place], OFFSETS, (4, 60)):
            found = searched(field, scene.read("::8"), cm, degrees, n_pixels, steps)
            yield found.assign(place=place)
        stranger = paths[(place + 1) % len(paths)][0].read("::8")
        found = searched(field, stranger, 20, 15, n_pixels, 60)
        yield found.assign(place=place, kind="stranger", translation_error_m=10.0)


def part_of(scene: Scene, field: str, preset: Preset) -> Field:
    """A map of a scene's first frames: a third of a recording, a quarter of a room's path."""
    frames = ":60" if scene.room else ":40"
    job = MapJob.of(scene, field, preset, frames)
    run_jobs([job])
    return job.map().field


def in_parts(parts: list[Field], scenes: list[Scene]) -> Iterator[pd.DataFrame]:
    """Reports and errors of frames that leave what was mapped, tracked and searched for."""
    for (place, field), n_pixels in product(enumerate(parts), (512, 2048)):
        for frames in ("::2", "::4", "::8") if scenes[place].room else (":", "::2", "::4"):
            sequence = scenes[place].read(frames)
            found = tracked(field, sequence, n_pixels)
            yield found.assign(kind="part", place=place)
            found = searched(field, sequence, 10, 8, n_pixels, 60)
            yield found.assign(kind="part", place=place)


def settings(n_pixels: int) -> LmSettings:
    """Settings of LM without restarts, which would leave few wrong poses to learn from."""
    return LmSettings(n_pixels=n_pixels, n_restarts=0)


def tracked(field: Field, sequence: RgbdSequence, n_pixels: int) -> pd.DataFrame:
    """Reports and errors of a sequence that is tracked from its first pose."""
    how = sequence.T_world_camera[0], StepBudget(30), settings(n_pixels)
    return track_sequence(make_tracker("lm", field, *how), sequence).frames


def searched(field, sequence, cm, degrees, n_pixels, steps) -> pd.DataFrame:
    """Reports and errors of frames that are searched for from starts that are off.

    The starts are off by `cm` and `degrees`. If they are far off, the tracker is told that the
    frame before was lost.
    """
    rows = []
    tracker = make_tracker("lm", field, np.eye(4), StepBudget(steps), settings(n_pixels))
    for number in range(len(sequence)):
        frame = sequence[number]
        tracker.restart(retract(frame.T_world_camera, twist(number, cm, degrees)))
        tracker.was_lost = cm > 20
        found = tracker.track(frame)
        (off_m,), (off_deg,) = pose_errors(found.T_world_camera[None], frame.T_world_camera[None])
        told = {"translation_error_m": off_m, "rotation_error_deg": off_deg, "kind": f"{cm} cm"}
        rows.append(found.report | told)
    return pd.DataFrame(rows)


def twist(seed: int, offset_cm: int, offset_deg: int) -> np.ndarray:
    """A twist (omega in rad, v in m) of given lengths, in directions that the seed decides."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    omega, v = radians(offset_deg) * directions[0], 0.01 * offset_cm * directions[1]
    return torch.cat([omega, v]).double().numpy()


def print_fit(rows: pd.DataFrame) -> None:
    """Fit a logistic regression with a weak penalty and print it; all places have equal weight."""
    rows = rows[rows["position_std_m"].notna()].reset_index(drop=True)
    is_wrong = (rows["translation_error_m"] > WRONG_M) | (rows["rotation_error_deg"] > WRONG_DEG)
    sign, x = np.where(is_wrong, 1.0, -1.0), np.stack([features(r) for _, r in rows.iterrows()])
    design = np.column_stack([np.ones(len(x)), x])
    weight = 1 / rows.groupby("place")["place"].transform("size").to_numpy()

    def loss(beta):
        return weight @ np.logaddexp(0, -sign * (design @ beta)) + STIFFNESS * beta[1:] @ beta[1:]

    bounds = [(None, None), *((0, None) if up else (None, 0) for up in GROWS)]
    beta = minimize(loss, np.zeros(design.shape[1]), bounds=bounds).x
    print("intercept and coefficients", beta.round(2).tolist())
    with mock.patch.multiple(verdict, _INTERCEPT=beta[0], _COEFFICIENTS=beta[1:]):
        probability = rows.apply(verdict.p_lost, axis=1).to_numpy()
    for threshold in (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7):
        lost = probability > threshold
        print(
            f"{threshold}: {(is_wrong & ~lost).sum()} of {is_wrong.sum()} wrong ones missed, "
            f"{(~is_wrong & lost).sum()} of {lost.sum()} called lost in vain"
        )


if __name__ == "__main__":
    main()
