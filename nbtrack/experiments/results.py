"""Maps and tracked runs of scenes, from the cache or made now, as DataFrames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from nbtrack.core.errors import MissingError, NbtrackError
from nbtrack.core.files import read_json, runs_folder
from nbtrack.core.progress import tell
from nbtrack.core.settings import with_settings
from nbtrack.experiments.cells import MapCell
from nbtrack.experiments.grid import Execution, run_cells
from nbtrack.experiments.methods import Method, find_methods
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.runs import METRICS_FILE, TrackCell
from nbtrack.experiments.scenes import Scene
from nbtrack.mapping.files import Map
from nbtrack.tracking.trajectories import read_tum

BUDGETS = {"steps": "the paper's step counts", "clock": "wall clock"}
"""What ends a frame: as many steps as the paper's hardware had time for, or our own clock."""


def map_scene(scene: Scene, field: str, preset: Preset, seed: int = 0, frames: str = ":") -> Map:
    """The map of a scene, from the cache or made now."""
    cell = MapCell(scene, field, preset, frames, seed)
    if not cell.is_done:
        run_cells([cell], f"mapping {cell.name}")
    return cell.map()


def map_scenes(
    scenes: Sequence[Scene],
    fields: Sequence[str],
    preset: Preset,
    seeds: int = 1,
    execution: Execution | None = None,
) -> pd.DataFrame:
    """Scores of the maps of some scenes; those that are not cached are made, side by side.

    Returns:
        A row a map: field, scene, seed, seconds, and the scores, `SCORES`.
    """
    cells = [
        MapCell(scene, field, preset, seed=seed)
        for field in fields
        for seed in range(seeds)
        for scene in scenes
    ]
    made = run_cells(cells, "mapping", execution)
    return pd.DataFrame(
        {"field": cell.field, "scene": cell.scene.name, "seed": cell.seed}
        | {"seconds": found["seconds"], **found["quality"]}
        for cell, found in zip(cells, made, strict=True)
    )


def track_scenes(
    scenes: Sequence[Scene],
    methods: Sequence[str | Method],
    preset: Preset,
    rates_hz: Sequence[float | int] | None = None,
    steps: float | int | None = None,
    clock: bool = False,
    frames: str | None = None,
    seeds: int = 1,
    execution: Execution | None = None,
) -> pd.DataFrame:
    """Track some scenes with some methods; maps and runs that are not cached are made first.

    Args:
        rates_hz: by default the preset's; each frame has the steps of the paper's hardware.
        steps, clock: so many steps a frame instead, or 1/rate seconds by this machine's clock.
        frames: the slice to track; by default the preset's.
        seeds: of map and run together: their spread is that of the whole method.

    Returns:
        A row a run: rate_hz, steps, method, scene, seed, ate_m (NaN where it failed), failure
        (why), run (its name) and the other metrics.
    """
    plan = []
    for method in find_methods(methods):
        changed = with_settings(preset, *method.settings)
        for seed in range(seeds):
            for rate_hz in [None] if steps else rates_hz or preset.tables.rates_hz:
                n_steps = steps or (None if clock else method.paper_steps(rate_hz))
                for scene in scenes:
                    cell = TrackCell(
                        MapCell(scene, method.field, changed, seed=seed), method.tracker, n_steps,
                        rate_hz if clock else None, frames or preset.scenes.track_frames, seed,
                    )  # fmt: skip
                    plan.append((rate_hz, method, cell))
    found = _run([cell for *_, cell in plan], clock, execution or Execution())
    return pd.DataFrame(
        {"rate_hz": rate_hz, "steps": cell.steps, "method": method.label, **_told(cell, result)}
        for (rate_hz, method, cell), result in zip(plan, found, strict=True)
    )


def _run(cells: Sequence[TrackCell], clock: bool, execution: Execution) -> list[Any]:
    """Side by side; by the clock one after the other, here: a neighbour would slow a clock down."""
    n_done = sum(cell.is_done for cell in cells)
    if 0 < n_done < len(cells):
        tell(f"{n_done} of {len(cells)} runs are cached")
    if clock:
        run_cells([cell.map_cell for cell in cells if not cell.is_done], "mapping", execution)
        execution = replace(execution, workers=1, dask=None)
    return run_cells(cells, "by the clock" if clock else "tracking", execution)


def _told(cell: TrackCell, result: dict[str, Any] | NbtrackError) -> dict[str, Any]:
    place = {"scene": cell.scene.name, "seed": cell.seed, "run": cell.folder.name}
    if isinstance(result, NbtrackError):
        return place | {"ate_m": float("nan"), "failure": str(result)}
    metrics = {k: v for k, v in result.items() if k not in (*place, "config", "versions")}
    return place | {"ate_m": result["ate_rmse_m"], "failure": ""} | metrics


@dataclass(frozen=True)
class Run:
    """A finished run, as it is kept."""

    # Camera to world, OpenCV axes; of the tracked frames, without the given first one.
    T_estimated: Float[np.ndarray, "frames 4 4"]
    T_true: Float[np.ndarray, "frames 4 4"]
    frames: pd.DataFrame  # steps, seconds, loss and errors of each frame, the first included
    metrics: dict[str, Any]


def read_run(name: str | Path) -> Run:
    """A run by its name in the column `run`, or by its folder.

    Raises:
        MissingError: there is no such finished run.
    """
    folder = Path(name) if Path(name).is_dir() else runs_folder() / "tracks" / name
    if not (folder / METRICS_FILE).is_file():
        raise MissingError(f"no finished run {name}: give a name in column `run`, or a folder")
    return Run(
        read_tum(folder / "trajectory.txt")[1],
        read_tum(folder / "groundtruth.txt")[1],
        pd.read_csv(folder / "frames.csv"),
        read_json(folder / METRICS_FILE),
    )
