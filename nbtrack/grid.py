"""All cells of a preset: scenes, their maps, the tracked runs, and the rows of both tables."""

from collections.abc import Callable, Sequence
from functools import partial

import pandas as pd
from tqdm import tqdm

from nbtrack.budget import paper_steps
from nbtrack.config import Preset, ScenesConfig
from nbtrack.errors import ConfigError, nearest_name
from nbtrack.experiments import MapCell, TrackCell, map_summary, obtain_map, obtain_track
from nbtrack.parallel import Job, Report, run_jobs
from nbtrack.scenes import Scene, find_scene, room_folder
from nbtrack.synthetic import ROOMS
from nbtrack.trackers import TRACKERS

BUDGETS = {"steps": "the paper's step counts", "clock": "wall clock"}
"""What ends a frame: as many steps as the paper's hardware had time for, or our own clock."""

Say = Callable[[str], None]


def prepare_scenes(preset: Preset, say: Say = tqdm.write) -> list[Scene]:
    """The preset's scenes; synthetic rooms that are not there yet are made, side by side.

    Raises:
        MissingError: a scene of the dataset is not below the data folder.
    """
    config = preset.scenes
    missing = [n for n in config.names if n in ROOMS and not room_folder(n, config).is_dir()]
    if missing and config.synthetic:
        say(f"making {len(missing)} of {len(config.names)} rooms: {', '.join(missing)}")
        jobs = [Job(name, config.n_frames, _make_scene, (name, config)) for name in missing]
        run_jobs(jobs, "rooms")
    return [find_scene(name, config) for name in config.names]


def map_cells(preset: Preset, field_name: str, scenes: Sequence[Scene]) -> list[MapCell]:
    """One map of every scene."""
    return [MapCell(scene, field_name, preset) for scene in scenes]


def track_cells(
    preset: Preset, tracker_name: str, scenes: Sequence[Scene], budget: str = "steps"
) -> list[TrackCell]:
    """One tracked run of every scene at every rate, all with the same kind of budget.

    Raises:
        ConfigError: the budget is neither "steps" nor "clock".
    """
    if budget not in BUDGETS:
        raise ConfigError(f"unknown budget {budget!r}: {nearest_name(budget, list(BUDGETS))}")
    tracker = TRACKERS[tracker_name]
    cell = partial(TrackCell, tracker_name=tracker_name, frames=preset.scenes.track_frames)
    return [
        cell(map_cell, rate_hz=rate_hz)
        if budget == "clock"
        else cell(map_cell, steps=paper_steps(tracker.paper_steps, rate_hz))
        for rate_hz in preset.tables.rates_hz
        for map_cell in map_cells(preset, tracker.field_name, scenes)
    ]


def run_maps(cells: Sequence[MapCell], say: Say = tqdm.write) -> pd.DataFrame:
    """Make the maps that are not cached, side by side; returns the scores of all of them."""
    missing = [cell for cell in cells if not cell.is_done]
    say(f"{len(cells) - len(missing)} of {len(cells)} maps are cached, {len(missing)} to make")
    jobs = [
        Job(
            f"{cell.scene.name} {cell.field_name}",
            cell.preset.mapping_of(cell.field_name).iterations, _make_map, (cell,),
        )
        for cell in missing
    ]  # fmt: skip
    run_jobs(jobs, "mapping")
    rows = {}
    for cell in cells:
        summary = map_summary(cell)
        rows[cell.scene.name] = {**summary["quality"], "seconds": summary["seconds"]}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("scene")


def run_tracks(cells: Sequence[TrackCell], say: Say = tqdm.write) -> list[dict]:
    """Make the runs that are not cached; returns the metrics of all of them, in order.

    Runs with a step budget go side by side. With the clock they go one after the other: a
    neighbour on the same machine would slow the clock's steps down.
    """
    run_maps(list({cell.map_cell.folder: cell.map_cell for cell in cells}.values()), say)
    missing = [cell for cell in cells if not cell.is_done]
    say(f"{len(cells) - len(missing)} of {len(cells)} runs are cached, {len(missing)} to make")
    jobs = [Job(cell.name, _frames_to_track(cell), _make_track, (cell,)) for cell in missing]
    by_clock = any(cell.rate_hz is not None for cell in missing)
    run_jobs(jobs, "tracking", workers=1 if by_clock else None)
    return [obtain_track(cell) for cell in cells]


def table_1_cells(preset: Preset, scenes: Sequence[Scene], budget: str = "steps") -> pd.DataFrame:
    """Long form of Table I: every registered tracker, every scene and rate. Runs what is missing.

    Columns: rate_hz, method, scene, ate_m and the other metrics.
    """
    rates_hz = [rate_hz for rate_hz in preset.tables.rates_hz for _ in scenes]
    planned = [
        (rate_hz, tracker.label, cell)
        for name, tracker in TRACKERS.items()
        for rate_hz, cell in zip(
            rates_hz, track_cells(preset, name, scenes, budget), strict=True
        )
    ]  # fmt: skip
    results = run_tracks([cell for _, _, cell in planned])
    rows = [
        {"rate_hz": rate_hz, "method": method, "ate_m": metrics["ate_rmse_m"], **metrics}
        for (rate_hz, method, _), metrics in zip(planned, results, strict=True)
    ]
    return pd.DataFrame(rows).drop(columns="config")


def _make_scene(name: str, config: ScenesConfig, report: Report) -> None:
    find_scene(name, config, progress=lambda done, total: report(done, "frames written"))


def _make_map(cell: MapCell, report: Report) -> None:
    obtain_map(cell, report=report)


def _make_track(cell: TrackCell, report: Report) -> None:
    obtain_track(cell, report=report)


def _frames_to_track(cell: TrackCell) -> int:
    return len(cell.map_cell.scene.frame_numbers(cell.frames)) - 1
