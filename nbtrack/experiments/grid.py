"""Map and track scenes by many methods; results are DataFrames, and what is cached is reused."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nbtrack.experiments.jobs import Execution, run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.runs import read_trajectory
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob, reach_warnings
from nbtrack.machinery.errors import ConfigError, NbtrackError, typed
from nbtrack.machinery.files import absolute, runs_folder
from nbtrack.machinery.progress import tell
from nbtrack.mapping.files import Map
from nbtrack.tracking import make_budget
from nbtrack.tracking.methods import Method, Methods, find_methods
from nbtrack.tracking.trajectories import Trajectory


@typed
def map_scene(scene: Scene, field: str, preset: Preset, seed: int = 0) -> Map:
    """The map of a scene, from the cache, or made now if it is not there."""
    job = MapJob.of(scene, field, preset, seed=seed)
    run_jobs([job])
    return job.map()


@typed
def map_scenes(scenes: Sequence[Scene], fields: Sequence[str], preset: Preset) -> pd.DataFrame:
    """Map scenes in fields; maps that are not cached are made.

    Returns a row for each map: field, scene, seed, seconds, and the scores of `quality.SCORES`.
    Raises ConfigError if scenes or fields are no lists.
    """
    jobs = [MapJob.of(scene, field, preset) for field, scene in product(fields, scenes)]
    rows = []
    for job, record in zip(jobs, run_jobs(jobs), strict=True):
        row = {"field": job.field, "scene": job.scene.name, "seed": job.seed}
        rows.append({**row, "seconds": record["seconds"], **record["quality"]})
    return pd.DataFrame(rows)


@typed
def track_scenes(
    scenes: Sequence[Scene],
    methods: Methods,
    preset: Preset,
    rates_hz: Sequence[float | int] | None = None,
    steps: float | int | None = None,
    clock: bool = False,
    frames: str | None = None,
    seeds: Sequence[int] = (0,),
    execution: Execution | None = None,
    tracked: Sequence[Scene] | None = None,
) -> pd.DataFrame:
    """Track scenes with methods; maps and runs that are not cached are made.

    Args:
        rates_hz: by default the preset's. A frame gets as many steps as on the paper's hardware.
        steps, clock: a number of steps for each frame instead; or 1/rate seconds by the clock.
        frames: the slice of frames to track; by default the preset's.
        seeds: each is the seed of a map and of the run in it.
        tracked: recordings to track instead of the mapped ones, of the same rooms in this order.

    Returns a row for each run: rate_hz, steps, method, n_pixels, scene, seed, run (its name), the
    metrics, ate_m (NaN if unknown), failure. Raises ConfigError, and what `run_jobs` raises.
    """
    pairs = _pairs(scenes, scenes if tracked is None else tracked)
    rates = _rates(preset.tables.rates_hz, rates_hz, steps, clock)
    frames = preset.scenes.track_frames if frames is None else str(frames)
    jobs, rows = [], []
    for method, seed, rate_hz, (scene, seen) in product(find_methods(methods), seeds, rates, pairs):
        tracker, with_method = method.tracker, preset.with_method(method.settings)
        settings = with_method.tracking_of(tracker)
        n_steps, clock_hz = _budget(method, rate_hz, steps, clock)
        make_budget(n_steps, clock_hz)  # raises for a wrong number, before anything is made
        map_job = MapJob.of(scene, method.field, with_method, seed=seed)  # makes the seed an int
        job = TrackJob(map_job, seen, tracker, settings, n_steps, clock_hz, frames, map_job.seed)
        jobs.append(job)
        row = {"rate_hz": rate_hz, "steps": n_steps, "method": method.label, "scene": scene.name}
        rows.append(row | {"seed": seed, "run": job.folder.name, "n_pixels": settings.n_pixels})
    return pd.DataFrame(map(_row_of, rows, _run(jobs, execution)))


def _pairs(scenes: Sequence[Scene], tracked: Sequence[Scene]) -> list[tuple[Scene, Scene]]:
    """Pairs of a mapped scene and the one that is tracked in its map. ConfigError if one lacks."""
    if len(tracked) != len(scenes):
        raise ConfigError(f"{len(tracked)} tracked for {len(scenes)} scenes: give one for each")
    return [*zip(scenes, tracked, strict=True)]


def _rates(usual_hz: Sequence, rates_hz: Sequence | None, steps: Any, clock: bool) -> list:
    """The rates (Hz) to track at, as Python's numbers: by default the usual ones.

    With given steps there is no rate, and the list is [None]. Raises ConfigError if steps are given
    together with rates or with the clock.
    """
    if steps is None:
        return np.asarray(usual_hz if rates_hz is None else rates_hz).tolist()
    if rates_hz is not None or clock:
        raise ConfigError(f"steps={steps} beside rates_hz={rates_hz}, clock={clock}: leave one out")
    return [None]


def _budget(method: Method, rate_hz: float | None, steps: Any, clock: bool) -> tuple[Any, Any]:
    """The steps for each frame, and the rate (Hz) by the clock; one of the two is None.

    Without given steps and by no clock, the steps are those of the paper's hardware at the rate.
    """
    if steps is not None:
        return np.asarray(steps).item(), None  # a number of numpy becomes Python's
    if clock:
        return None, rate_hz
    return method.paper_steps(rate_hz), None


def _row_of(row: dict[str, Any], result: dict[str, Any] | NbtrackError) -> dict[str, Any]:
    """A row of the results with the metrics of its run, or with the reason why the run failed.

    Values in the row win over metrics of the same name: the row names the scene that was mapped,
    the metrics name the one that was tracked.
    """
    if isinstance(result, NbtrackError):
        return {**row, "failure": str(result), "ate_m": float("nan")}
    # Nested metrics, such as the run's settings, fit into no column.
    metrics = {name: value for name, value in result.items() if not isinstance(value, dict)}
    return {**metrics, **row, "failure": "", "ate_m": metrics.get("ate_rmse_m", float("nan"))}


def _run(jobs: Sequence[TrackJob], execution: Execution | None) -> list[Any]:
    """Run jobs after a check of their frames, and warnings; returns their results."""
    missing = [job for job in jobs if not job.is_done]
    for job in missing:
        job.scene.select(job.frames, needs_poses=False)  # raises before anything is mapped
    for warning in reach_warnings(missing):
        tell(f"nbtrack: warning: {warning}")
    return run_jobs(jobs, execution)


def read_run(name: str | Path) -> Trajectory:
    """Read a finished run, given by its folder or by its name in the column `run` of results.

    Raises MissingError if there is none, and DataError if its files are damaged.
    """
    folder = absolute(name)
    return read_trajectory(folder if folder.is_dir() else runs_folder() / "tracks" / name)
