"""Maps and tracked runs as cached cells: found on disk, or computed and kept there."""

import json
import platform
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float

import nbtrack
from nbtrack.budget import Budget, ClockBudget, StepBudget
from nbtrack.config import Preset, as_dict, fingerprint
from nbtrack.data import Sequence, parse_frames
from nbtrack.device import choose_device, device_name, synchronize
from nbtrack.map_quality import score_map
from nbtrack.mapping import FittedMap, load_map, map_sequence, split_holdout
from nbtrack.metrics import trajectory_metrics
from nbtrack.parallel import Report
from nbtrack.paths import runs_folder
from nbtrack.scenes import Scene
from nbtrack.storage import write_json_atomic, write_text_atomic
from nbtrack.tracking import TrackedSequence, track_sequence
from nbtrack.trajectories import read_tum, write_tum

# Part of every cell's key. Raised whenever a change of the code changes results.
RESULTS_VERSION = 1
MAP_FILE, SUMMARY_FILE, METRICS_FILE = "map.pt", "map.json", "metrics.json"


def _quiet(done: int, status: str) -> None:
    """A report that nobody reads."""


@dataclass(frozen=True)
class MapCell:
    """One map: a field fitted to some frames of a scene."""

    scene: Scene
    field_name: str
    preset: Preset
    frames: str = ":"
    seed: int = 0
    out: Path | None = None  # where to keep it instead of in the cache

    @property
    def key(self) -> str:
        """Changes with everything that the map depends on."""
        network = self.preset.network_of(self.field_name)
        mapping = self.preset.mapping_of(self.field_name)
        data = self.scene.fingerprint()
        return fingerprint(
            RESULTS_VERSION, data, self.field_name, network, mapping, self.frames, self.seed
        )

    @property
    def folder(self) -> Path:
        """Where the map is kept."""
        name = f"{self.scene.name}-{self.field_name}"
        return self.out or runs_folder() / "maps" / f"{name}-{self.key}"

    @property
    def is_done(self) -> bool:
        """Whether the map is finished and scored."""
        return (self.folder / SUMMARY_FILE).is_file()


@dataclass(frozen=True)
class TrackCell:
    """One tracked run in a map, under one budget: so many steps a frame, or a rate by the clock."""

    map_cell: MapCell
    tracker_name: str
    steps: float | None = None
    rate_hz: float | None = None
    frames: str = ":"
    seed: int = 0

    @property
    def key(self) -> str:
        """Changes with everything that the run depends on."""
        config = self.map_cell.preset.tracking_of(self.tracker_name)
        return fingerprint(
            self.map_cell.key, self.tracker_name, config, self.steps, self.rate_hz, self.frames,
            self.seed,
        )  # fmt: skip

    @property
    def scene_name(self) -> str:
        """The tracked scene."""
        return self.map_cell.scene.name

    @property
    def name(self) -> str:
        """A readable name: scene, tracker and budget."""
        budget = f"{self.rate_hz:g}hz" if self.rate_hz else f"{self.steps:g}steps"
        return f"{self.scene_name}-{self.tracker_name}-{budget}"

    @property
    def folder(self) -> Path:
        """Where the run's files are kept."""
        return runs_folder() / "tracks" / f"{self.name}-{self.key}"

    @property
    def is_done(self) -> bool:
        """Whether the run is finished."""
        return (self.folder / METRICS_FILE).is_file()

    def budget(self, device: torch.device) -> Budget:
        """A fresh budget: each run needs its own."""
        return make_budget(self.steps, self.rate_hz, device)


def make_budget(
    steps: float | None, rate_hz: float | None, device: torch.device | None = None
) -> Budget:
    """A budget by the clock of a device if there is a rate (Hz), else of so many steps a frame.

    Raises:
        ConfigError: the number is not above zero.
    """
    if rate_hz is None:
        return StepBudget(steps)
    wait = partial(synchronize, device) if device else None
    return ClockBudget(rate_hz, synchronize=wait)


def obtain_map(
    cell: MapCell, device: torch.device | None = None, report: Report = _quiet
) -> FittedMap:
    """The cell's map from the cache; where it is missing or unfinished, made or resumed first."""
    device = device or choose_device()
    network = cell.preset.network_of(cell.field_name)
    config = cell.preset.mapping_of(cell.field_name)
    if cell.is_done:
        report(config.iterations, "from cache")
        return load_map(cell.folder / MAP_FILE, cell.field_name, network, device)
    sequence = cell.scene.read(parse_frames(cell.frames))
    fitted = map_sequence(
        cell.field_name, sequence, network, config, cell.seed, device,
        checkpoint=cell.folder / MAP_FILE,
        on_iteration=lambda done, losses: report(done, _losses_text(losses)),
    )  # fmt: skip
    _write_map_summary(cell, fitted, sequence, device)
    return fitted


def map_summary(cell: MapCell) -> dict[str, Any]:
    """What is kept beside a finished map: config, quality, seconds, device, versions."""
    return json.loads((cell.folder / SUMMARY_FILE).read_text(encoding="utf-8"))


def obtain_track(
    cell: TrackCell, device: torch.device | None = None, report: Report = _quiet
) -> dict[str, Any]:
    """The cell's metrics from the cache, or of a run made now. The map is obtained first."""
    device = device or choose_device()
    if not cell.is_done:
        run_track(cell, cell.folder, device, report)
    metrics = json.loads((cell.folder / METRICS_FILE).read_text(encoding="utf-8"))
    report(metrics["frames"], "done")
    return metrics


def run_track(
    cell: TrackCell, folder: Path, device: torch.device, report: Report = _quiet
) -> dict[str, Any]:
    """Track now, whatever the cache holds, write the run's files to a folder; return its metrics.

    `trajectory.txt` and `groundtruth.txt` (TUM) hold the tracked frames, without the first one,
    whose pose was given: so public tools report the error of the paper's formula. `frames.csv`
    has a row for each frame, `metrics.json` everything else.
    """
    fitted = obtain_map(cell.map_cell, device)
    config = cell.map_cell.preset.tracking_of(cell.tracker_name)
    tracked = track_sequence(
        cell.tracker_name, fitted.field, cell.map_cell.scene.read(parse_frames(cell.frames)),
        cell.budget(device), config, cell.seed, device,
        on_frame=lambda done, error: report(done, f"off by {100 * error:.1f} cm"),
    )  # fmt: skip
    frame_ids = tracked.frames["frame_id"].to_numpy()[1:]
    write_tum(folder / "trajectory.txt", frame_ids, tracked.T_estimated[1:])
    write_tum(folder / "groundtruth.txt", frame_ids, tracked.T_true[1:])
    write_text_atomic(folder / "frames.csv", tracked.frames.to_csv(index=False))
    metrics = _metrics(cell, tracked, fitted, device)
    # The metrics come last: where they stand, the run is complete.
    write_json_atomic(folder / METRICS_FILE, metrics)
    return metrics


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


def _metrics(
    cell: TrackCell, tracked: TrackedSequence, fitted: FittedMap, device: torch.device
) -> dict[str, Any]:
    metrics = trajectory_metrics(tracked.T_estimated, tracked.T_true).to_dict()
    rows = tracked.frames.iloc[1:]
    steps = int(rows["steps"].sum())
    return {
        **metrics,
        "steps_per_frame": steps / len(rows),
        "seconds_per_step": float(rows["seconds"].sum()) / max(steps, 1),
        "seconds_per_frame": float(rows["seconds"].mean()),
        "map_seconds": fitted.seconds,
        "device": device_name(device),
        "scene": cell.map_cell.scene.name,
        "field": cell.map_cell.field_name,
        "tracker": cell.tracker_name,
        "budget": str(cell.budget(device)),
        "seed": cell.seed,
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


def _write_map_summary(
    cell: MapCell, fitted: FittedMap, sequence: Sequence, device: torch.device
) -> None:
    config = cell.preset.mapping_of(cell.field_name)
    mapped, held_out = split_holdout(len(sequence), config.holdout_every)
    quality = score_map(
        fitted.field, sequence.select(mapped), sequence.select(held_out), cell.scene.room
    )
    write_text_atomic(cell.folder / "history.csv", fitted.history.to_csv(float_format="%.6g"))
    summary = {
        "quality": quality.to_dict(),
        "seconds": fitted.seconds,
        "scene": cell.scene.name,
        "field": cell.field_name,
        "frames": cell.frames,
        "mapped_frames": len(mapped),
        "held_out_frames": len(held_out),
        "seed": cell.seed,
        "device": device_name(device),
        "versions": versions(),
        "config": as_dict(cell.preset),
    }
    # The summary comes last: where it stands, the map is complete.
    write_json_atomic(cell.folder / SUMMARY_FILE, summary)


def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return {
        "nbtrack": nbtrack.__version__,
        "results": str(RESULTS_VERSION),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def _losses_text(losses: dict[str, float]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in losses.items())
