"""Cells made or found: maps and tracked runs are computed once, and kept on disk."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float

from nbtrack.core.config import TrackingConfig, as_dict
from nbtrack.core.device import advise_on_memory, choose_device, device_name
from nbtrack.core.device_lock import alone_on, beside_others_on
from nbtrack.core.files import (
    json_bytes,
    read_json,
    write_json_atomic,
    write_text_atomic,
    write_together,
)
from nbtrack.core.provenance import versions
from nbtrack.data.sequence import RgbdSequence, parse_frames
from nbtrack.experiments.cells import (
    METRICS_FILE,
    RUN_FILE,
    GivenMap,
    MapCell,
    TrackCell,
    cell_lock,
)
from nbtrack.experiments.parallel import Report, quiet
from nbtrack.fields import Field
from nbtrack.fields.grid import bake_field
from nbtrack.mapping.files import MAP_FILE, SUMMARY_FILE
from nbtrack.mapping.fit import FittedMap, load_map, map_sequence, split_holdout
from nbtrack.mapping.fits import frame_fit, usual_fit, warn_of_misfit
from nbtrack.mapping.quality import score_map
from nbtrack.mapping.seen_volume import seen_volume
from nbtrack.tracking.metrics import score_detection, trajectory_metrics
from nbtrack.tracking.sequence import TrackedSequence, track_sequence
from nbtrack.tracking.trajectories import read_tum, tum_text


def obtain_map(
    cell: MapCell | GivenMap, device: torch.device | None = None, report: Report = quiet
) -> FittedMap:
    """The cell's map from the cache; where it is missing or unfinished, made or resumed first."""
    device = device or choose_device()
    if isinstance(cell, GivenMap):
        stored = cell.stored
        return FittedMap(stored.field.to(device), pd.DataFrame(), float(stored.made["seconds"]))
    network = cell.preset.network_of(cell.field_name)
    config = cell.preset.mapping_of(cell.field_name)
    if not cell.is_done:
        with cell_lock(cell.folder, lambda status: report(0, status)):
            if not cell.is_done:
                return _make_map(cell, device, report)
    report(config.iterations, "from cache")
    return load_map(cell.folder / MAP_FILE, cell.field_name, network, device)


def map_summary(cell: MapCell) -> dict[str, Any]:
    """What is kept beside a finished map: config, quality, seconds, device, versions."""
    return read_json(cell.folder / SUMMARY_FILE)


def obtain_track(
    cell: TrackCell, device: torch.device | None = None, report: Report = quiet
) -> dict[str, Any]:
    """The cell's metrics from the cache, or of a run made now. The map is obtained first."""
    device = device or choose_device()
    if not cell.is_done:
        with cell_lock(cell.folder, lambda status: report(0, status)):
            if not cell.is_done:
                run_track(cell, cell.folder, device, report)
    metrics = cell.metrics()
    report(cell.n_frames, "done")
    return metrics


def run_track(
    cell: TrackCell, folder: Path, device: torch.device, report: Report = quiet
) -> dict[str, Any]:
    """Track now, whatever the cache holds, write the run's files to a folder; return its metrics.

    A killed run is taken up where its last checkpoint stands. By the clock the run waits until it
    is alone on its device, and keeps other runs waiting.

    `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without the first one,
    whose pose was given: so public tools report the error of the paper's formula. `frames.csv`
    has a row for each frame, `metrics.json` everything else.

    Raises:
        DataError: a given map does not fit the first frame at its given pose.
    """
    fitted = obtain_map(cell.map_cell, device)
    config = cell.map_cell.preset.tracking_of(cell.tracker_name)
    with advise_on_memory(f"frames {cell.frames} of {cell.scene_name}"):
        sequence = cell.map_cell.scene.read(parse_frames(cell.frames))
    map_note = _note_on_given(cell.map_cell, sequence)
    field, baking = field_to_track(fitted.field, config)
    checkpoint = cell.folder / RUN_FILE
    occupied = alone_on if cell.rate_hz is not None else beside_others_on
    with occupied(device, lambda status: report(0, status)):
        tracked = track_sequence(
            cell.tracker_name, field, sequence, cell.budget(device), config, cell.seed,
            device, checkpoint, lambda done, error: report(done, f"off by {100 * error:.1f} cm"),
        )  # fmt: skip
    frame_ids = tracked.frames["frame_id"].to_numpy()[1:]
    metrics = _metrics(cell, tracked, fitted, device) | baking | map_note
    # The metrics come last: where they stand, the run is complete.
    write_together(folder, {
        "trajectory.txt": tum_text(frame_ids, tracked.T_estimated[1:]).encode(),
        "groundtruth.txt": tum_text(frame_ids, tracked.T_true[1:]).encode(),
        "frames.csv": tracked.frames.to_csv(index=False).encode(),
        METRICS_FILE: json_bytes(metrics),
    })  # fmt: skip
    checkpoint.unlink(missing_ok=True)
    return metrics


def field_to_track(field: Field, config: TrackingConfig) -> tuple[Field, dict[str, float | int]]:
    """The field that a tracker asks: the map itself, or its copy on a grid; and what that took."""
    if not config.bake_voxel:
        return field, {}
    start = time.perf_counter()
    baked = bake_field(field, config.bake_voxel)
    return baked, {"bake_seconds": time.perf_counter() - start, "grid_bytes": baked.n_bytes}


def read_poses(
    cell: TrackCell,
) -> tuple[Float[np.ndarray, "frames 4 4"], Float[np.ndarray, "frames 4 4"]]:
    """Estimated and true camera-to-world poses (OpenCV axes) of a finished run's tracked frames."""
    estimated, true = (
        read_tum(cell.folder / name)[1] for name in ("trajectory.txt", "groundtruth.txt")
    )
    return estimated, true


def read_frames(cell: TrackCell) -> pd.DataFrame:
    """Steps, seconds, loss and errors of each frame of a finished run."""
    return pd.read_csv(cell.folder / "frames.csv")


def _note_on_given(cell: MapCell | GivenMap, sequence: RgbdSequence) -> dict[str, Any]:
    """Where a given map comes from, and a warning where it fits the first frame badly.

    A scene's own map is made from its own poses, so that there is nothing to check.
    """
    if not isinstance(cell, GivenMap):
        return {}
    stored, warning = cell.stored, None
    if stored.usual_fit is not None:
        found = frame_fit(stored.field, stored.seen, sequence, 0)
        frame = f"frame {sequence.frame_ids[0]} of {sequence.name}"
        map_name = f"the map of {stored.made['scene']}"
        warning = warn_of_misfit(found, stored.usual_fit, map_name, frame)
    return {"map_from": stored.made, "map_warning": warning}


def _metrics(
    cell: TrackCell, tracked: TrackedSequence, fitted: FittedMap, device: torch.device
) -> dict[str, Any]:
    metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true).to_dict()
    rows = tracked.frames.iloc[1:]
    if "lost" in rows:
        called_lost = rows["lost"].to_numpy(dtype=bool)
        errors = rows["translation_error_m"].to_numpy()
        metrics |= score_detection(called_lost, errors).to_dict()
    steps = int(rows["steps"].sum())
    return {
        **metrics,
        "frames_without_depth": int(rows["without_depth"].sum()),
        "steps_per_frame": steps / len(rows),
        "seconds_per_step": float(rows["seconds"].sum()) / max(steps, 1),
        "seconds_per_frame": float(rows["seconds"].mean()),
        "map_seconds": fitted.seconds,
        "device": device_name(device),
        "device_type": device.type,
        "threads": torch.get_num_threads(),
        "scene": cell.scene_name,
        "field": cell.map_cell.field_name,
        "tracker": cell.tracker_name,
        "budget": str(cell.budget(device)),
        "seed": cell.seed,
        "key": cell.key,
        "versions": versions(),
        "config": {
            "preset": as_dict(cell.map_cell.preset),
            "map_frames": cell.map_cell.frames,
            "map_seed": cell.map_cell.seed,
            "frames": cell.frames,
            "steps": cell.steps,
            "rate_hz": cell.rate_hz,
        },
    }


def _make_map(cell: MapCell, device: torch.device, report: Report) -> FittedMap:
    config = cell.preset.mapping_of(cell.field_name)
    setting = f"frames {cell.frames} of {cell.scene.name}"
    waits = beside_others_on(device, lambda status: report(0, status))
    with advise_on_memory(setting), waits:
        sequence = cell.scene.read(parse_frames(cell.frames))
        fitted = map_sequence(
            cell.field_name, sequence, cell.preset.network_of(cell.field_name), config, cell.seed,
            device, checkpoint=cell.folder / MAP_FILE,
            on_iteration=lambda done, losses: report(done, _losses_text(losses)),
        )  # fmt: skip
        mapped, held_out = split_holdout(len(sequence), config.holdout_every)
        quality = score_map(fitted.field, sequence, mapped, held_out, cell.scene.room)
        seen = seen_volume(sequence, mapped, fitted.field.bounds)
        fit = usual_fit(fitted.field, seen, sequence, mapped)
    write_text_atomic(cell.folder / "history.csv", fitted.history.to_csv(float_format="%.6g"))
    summary = {
        "quality": quality.to_dict(),
        "usual_fit": fit and fit.to_dict(),
        "seen": seen.to_dict(),
        "camera": asdict(sequence.intrinsics),
        "seconds": fitted.seconds,
        "scene": cell.scene.name,
        "field": cell.field_name,
        "frames": cell.frames,
        "mapped_frames": len(mapped),
        "held_out_frames": len(held_out),
        "seed": cell.seed,
        "key": cell.key,
        "device": device_name(device),
        "threads": torch.get_num_threads(),
        "versions": versions(),
        "config": as_dict(cell.preset),
    }
    # The summary comes last: where it stands, the map is complete.
    write_json_atomic(cell.folder / SUMMARY_FILE, summary)
    return fitted


def _losses_text(losses: dict[str, float]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in losses.items())
