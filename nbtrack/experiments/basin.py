"""The basin of convergence: from how far off a tracker still finds the pose of a frame."""

from collections.abc import Sequence
from dataclasses import replace
from math import radians

import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.config import Preset
from nbtrack.core.device import suitable_threads
from nbtrack.core.geometry import rotation_angle
from nbtrack.core.settings import with_settings
from nbtrack.data import sequence as data
from nbtrack.data.pixels import PixelSampler
from nbtrack.experiments.beyond import ADAM_PLUS, BAKED, LM, Method
from nbtrack.experiments.cells import MapCell
from nbtrack.experiments.grid import run_tracks
from nbtrack.experiments.parallel import Execution, Job, Report, run_jobs
from nbtrack.experiments.results import field_to_track, obtain_map
from nbtrack.experiments.scenes import Scene
from nbtrack.tracking.metrics import LossDetection, score_detection
from nbtrack.tracking.registration import moved
from nbtrack.tracking.trackers import Tracker, tracker_class

OFFSETS = ((1, 1), (2, 2), (4, 4), (8, 6), (12, 9), (20, 15), (30, 20), (50, 30))
"""How far off the starts are: cm and degrees, from a frame's motion to a lost camera's."""
COMPARED = ((ADAM_PLUS, 79), (LM, 30), (BAKED, 30))
"""Methods and the steps they are allowed: Adam those of the paper at 2 Hz."""
RECOVERED_M, RECOVERED_DEG = 0.02, 1.0
"""A start has converged when its pose ends so near the truth."""

_FRAME_STRIDE = 10  # between two frames whose pose is sought


def find_from_afar(
    preset: Preset,
    scene: Scene,
    compared: Sequence[tuple[Method, int]] = COMPARED,
    offsets: Sequence[tuple[int, int]] = OFFSETS,
    n_starts: int = 24,
    execution: Execution | None = None,
) -> pd.DataFrame:
    """Where each tracker ends, from starts that are off in random directions; without restarts.

    Every method has the same frames and the same starts. Each start is turned by the offset's
    degrees about one random axis and moved by its centimetres along another. Methods go side by
    side; maps that are missing are made first.

    Returns:
        A row a search: method, steps (allowed), offset_cm, offset_deg, error_m, error_deg,
        called_lost (the tracker's own verdict; None where it gives none).
    """
    maps = [MapCell(scene, method.field_name, preset) for method, _ in compared]
    run_tracks([], lambda _: None, execution, maps)
    jobs = [
        Job(
            method.label, len(offsets) * n_starts, _searches_of,
            (preset, scene, method, steps, tuple(offsets), n_starts), float(steps),
        )
        for method, steps in compared
    ]  # fmt: skip
    return pd.DataFrame([row for rows in run_jobs(jobs, "searches", execution) for row in rows])


def share_recovered(searches: pd.DataFrame) -> pd.DataFrame:
    """Share of the starts that converged: a row a method, a column an offset ("4 cm, 4°").

    Args:
        searches: from `find_from_afar`.
    """
    is_found = (searches["error_m"] < RECOVERED_M) & (searches["error_deg"] < RECOVERED_DEG)
    offset = [
        f"{cm} cm, {deg}°"
        for cm, deg in zip(searches["offset_cm"], searches["offset_deg"], strict=True)
    ]
    table = searches.assign(found=is_found, offset=offset).pivot_table(
        index=["method", "steps"], columns="offset", values="found", sort=False
    )
    return table[list(dict.fromkeys(offset))]


def score_verdicts(searches: pd.DataFrame) -> dict[str, LossDetection]:
    """How well trackers that know when they are lost know it, over all searches, by method."""
    judged = searches.dropna(subset="called_lost")
    return {
        method: score_detection(
            rows["called_lost"].to_numpy(dtype=bool), rows["error_m"].to_numpy()
        )
        for method, rows in judged.groupby("method", sort=False)
    }


def _searches_of(
    preset: Preset,
    scene: Scene,
    method: Method,
    steps: int,
    offsets: tuple[tuple[int, int], ...],
    n_starts: int,
    report: Report,
) -> list[dict]:
    frames = data.read_sequence(scene.folder, slice(None, None, _FRAME_STRIDE))
    tracker = _tracker(with_settings(preset, *method.settings), scene, method, frames)
    rows: list[dict] = []
    with suitable_threads(preset.network_of(method.field_name).width):
        for offset_cm, offset_deg in offsets:
            for start in range(n_starts):
                twist = _offset(start, offset_cm, offset_deg)
                place = {"method": method.label, "steps": steps}
                place |= {"offset_cm": offset_cm, "offset_deg": offset_deg}
                found = _search(tracker, frames, start % len(frames), twist, steps)
                rows.append(place | found)
                report(len(rows), f"{offset_cm} cm")
    return rows


def _tracker(preset: Preset, scene: Scene, method: Method, frames: data.Sequence) -> Tracker:
    config = replace(preset.tracking_of(method.tracker_name), n_restarts=0)
    fitted = obtain_map(MapCell(scene, method.field_name, preset))
    field, _ = field_to_track(fitted.field, config)
    device = next(fitted.field.parameters()).device
    generator = torch.Generator(device).manual_seed(0)
    sampler = PixelSampler(frames, device)
    return tracker_class(method.tracker_name)(field, sampler, config, generator)


def _search(
    tracker: Tracker, frames: data.Sequence, index: int, twist: Float[Tensor, "6"], steps: int
) -> dict[str, float | bool | None]:
    """Seek the pose of one frame from a start that is off by a twist."""
    T_true = torch.from_numpy(frames.T_world_camera[index]).float()
    tracker.start_frame(index, moved(T_true, twist)[None].to(tracker.sampler.device))
    for _ in range(steps):
        if tracker.is_converged:
            break
        tracker.step()
    T_found = tracker.T_world_camera.cpu()
    return {
        "error_m": float((T_found[:3, 3] - T_true[:3, 3]).norm()),
        "error_deg": float(rotation_angle(T_true[:3, :3].T @ T_found[:3, :3]).rad2deg()),
        "called_lost": tracker.report().get("lost"),
    }


def _offset(seed: int, offset_cm: int, offset_deg: int) -> Float[Tensor, "6"]:
    """A twist (omega in rad, v in m) in directions that depend on the seed alone."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    return torch.cat([radians(offset_deg) * directions[0], 0.01 * offset_cm * directions[1]])
