"""Maps and tracked runs of scenes, from the cache or made now, as DataFrames."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from nbtrack.core.errors import NbtrackError
from nbtrack.core.files import runs_folder
from nbtrack.core.progress import tell
from nbtrack.core.settings import with_settings
from nbtrack.experiments.grid import Execution, run_jobs
from nbtrack.experiments.jobs import MapJob, TrackJob
from nbtrack.experiments.methods import Methods, find_methods
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.mapping.files import Map
from nbtrack.tracking.trajectories import Trajectory, read_trajectory


def map_scene(scene: Scene, field: str, preset: Preset, seed: int = 0) -> Map:
    """The map of a scene, from the cache or made now."""
    job = MapJob(scene, field, preset, seed=seed)
    run_jobs([job], f"mapping {job.name}")
    return job.map()


def map_scenes(
    scenes: Sequence[Scene],
    fields: Sequence[str],
    preset: Preset,
    seeds: int = 1,
    execution: Execution | None = None,
) -> pd.DataFrame:
    """Scores of the maps of some scenes; those that are not cached are made, side by side.

    A row is a map: field, scene, seed, seconds, and the scores, `SCORES`.
    """
    places = [*product(fields, range(seeds), scenes)]
    jobs = [MapJob(scene, field, preset, seed=seed) for field, seed, scene in places]
    records = run_jobs(jobs, "mapping", execution)
    return pd.DataFrame(
        {"field": field, "scene": scene.name, "seed": seed}
        | {"seconds": record["seconds"], **record["quality"]}
        for (field, seed, scene), record in zip(places, records, strict=True)
    )


def track_scenes(
    scenes: Sequence[Scene],
    methods: Methods,
    preset: Preset,
    rates_hz: Sequence[float | int] | None = None,
    steps: float | int | None = None,
    clock: bool = False,
    frames: str | None = None,
    seeds: int | Sequence[int] = 1,
    execution: Execution | None = None,
    tracked: Sequence[Scene] | None = None,
) -> pd.DataFrame:
    """Track some scenes with some methods; maps and runs that are not cached are made first.

    Args:
        rates_hz: by default the preset's; each frame has the steps of the paper's hardware.
        steps, clock: so many steps a frame instead, or 1/rate seconds by this machine's clock.
        frames: the slice to track; by default the preset's.
        seeds: of map and run together, so many or these: their spread is that of the method.
        tracked: other recordings of the same rooms, in the same order, which no map has seen.

    Returns a row a run: rate_hz, steps, method, n_pixels, scene, seed, run (its name), ate_m (NaN
    where it failed), failure (why) and the other metrics.
    """
    execution, rates = execution or Execution(), [None] if steps else rates_hz
    seeds = range(seeds) if isinstance(seeds, int) else seeds
    # By the clock, how far a run comes depends on its threads.
    n_threads = execution.threads or (torch.get_num_threads() if clock else None)
    options = {"frames": frames or preset.scenes.track_frames, "n_threads": n_threads}
    pairs, jobs, rows = list(zip(scenes, tracked or scenes, strict=True)), [], []
    grid = product(find_methods(methods), seeds, rates or preset.tables.rates_hz, pairs)
    for method, seed, rate_hz, (scene, seen) in grid:
        map_job = MapJob(scene, method.field, with_settings(preset, *method.settings), seed=seed)
        n_steps = steps or (None if clock else method.paper_steps(rate_hz))
        budget = n_steps, rate_hz if clock else None
        jobs.append(TrackJob(map_job, seen, method.tracker, *budget, seed=seed, **options))
        row = {"rate_hz": rate_hz, "steps": n_steps, "method": method.label, "scene": scene.name}
        rows.append({**row, "seed": seed, "run": jobs[-1].folder.name})
    outcomes = _run(jobs, clock, execution)
    return pd.DataFrame(map(_row_of, rows, jobs, outcomes))


def _run(jobs: Sequence[TrackJob], clock: bool, execution: Execution) -> list[Any]:
    """Side by side; by the clock one after the other, here: a neighbour would slow a clock down."""
    n_done = sum(job.is_done for job in jobs)
    if 0 < n_done < len(jobs):
        tell(f"{n_done} of {len(jobs)} runs are cached")
    if clock:
        run_jobs([job.needs for job in jobs if not job.is_done], "mapping", execution)
        execution = replace(execution, workers=1, dask=None)
    return run_jobs(jobs, "by the clock" if clock else "tracking", execution)


def _row_of(
    row: dict[str, Any], job: TrackJob, result: dict[str, Any] | NbtrackError
) -> dict[str, Any]:
    """A whole row. Its scene is the mapped one; metrics name the one that was tracked."""
    row |= {"n_pixels": job.settings.n_pixels, "failure": "", "ate_m": float("nan")}
    if isinstance(result, NbtrackError):
        return row | {"failure": str(result)}
    metrics = {k: v for k, v in result.items() if k not in ("config", "versions")}
    return {**metrics, **row, "ate_m": result["ate_rmse_m"]}


def read_run(name: str | Path) -> Trajectory:
    """A run by its name in the column `run`, or by its folder; MissingError if there is none."""
    return read_trajectory(Path(name) if Path(name).is_dir() else runs_folder() / "tracks" / name)
