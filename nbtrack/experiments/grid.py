"""All cells of a preset: scenes, their maps, the tracked runs, and the rows of Table I."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from nbtrack.core.config import Preset, ScenesConfig
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.errors import ConfigError, DataError, MissingError, NbtrackError, nearest_name
from nbtrack.data.sequence import list_frames
from nbtrack.experiments.cells import MapCell, TrackCell
from nbtrack.experiments.parallel import Execution, Job, Report, run_jobs
from nbtrack.experiments.results import map_summary, obtain_map, obtain_track
from nbtrack.experiments.scenes import DATASET_SCENES, Scene, find_scene, room_folder
from nbtrack.synthetic import ROOMS
from nbtrack.tables.layout import average_over_seeds
from nbtrack.tracking.budget import paper_steps
from nbtrack.tracking.trackers import paper_trackers, tracker_class

BUDGETS = {"steps": "the paper's step counts", "clock": "wall clock"}
"""What ends a frame: as many steps as the paper's hardware had time for, or our own clock."""

_FEW_PIXELS = 500_000  # rendered in a second or two

Say = Callable[[str], None]


@dataclass(frozen=True)
class TableCell:
    """A tracked run and its place in Table I."""

    rate_hz: float
    method: str
    run: TrackCell


def prepare_scenes(preset: Preset, say: Say = tqdm.write, make: bool = True) -> list[Scene]:
    """The preset's scenes that are there; synthetic rooms that are not are made, side by side.

    Scenes that lack a folder, or whose folder is damaged, are named at once, and the others
    returned.

    Args:
        make: make rooms; else one that is not there counts as missing.

    Raises:
        ConfigError: no name is given, or one is given twice or unknown.
        MissingError, DataError: no scene is there, or none is whole; that of the first.
    """
    config = preset.scenes
    _check_names(config)
    to_make = [n for n in config.names if n in ROOMS and not room_folder(n, config).is_dir()]
    if to_make and config.synthetic and make:
        say(f"making {len(to_make)} of {len(config.names)} rooms: {', '.join(to_make)}")
        jobs = [Job(name, config.n_frames, _make_scene, (name, config)) for name in to_make]
        # Small rooms are made sooner than processes start.
        pixels = len(to_make) * config.n_frames * config.width**2 * 3 // 4
        workers = 1 if pixels < _FEW_PIXELS else os.cpu_count()
        run_jobs(jobs, "rooms", Execution(workers))
    scenes, missing = [], []
    for name in config.names:
        try:
            if name in to_make and not make:
                raise MissingError(f"room {name} has not been made: run without --explain first")
            scene = find_scene(name, config)
            list_frames(scene.folder)  # so that a damaged folder is told here
            scenes.append(scene)
        except (MissingError, DataError) as error:
            missing.append((name, error))
    if missing and not scenes:
        raise missing[0][1]
    if missing:
        names = ", ".join(name for name, _ in missing)
        say(f"missing, and left out: {names} ({missing[0][1]})")
    return scenes


def _check_names(config: ScenesConfig) -> None:
    known = [*ROOMS, *DATASET_SCENES]
    if not config.names:
        raise ConfigError(f"no scene is named: give some of {', '.join(known)}")
    for name in config.names:
        if name not in known and not Path(name).is_dir():
            raise ConfigError(
                f"unknown scene {name!r}, and no such folder: {nearest_name(name, known)}"
            )
    columns = [Path(name).resolve().name for name in config.names]
    if len(set(columns)) < len(columns):
        raise ConfigError(f"scenes {', '.join(config.names)}: two have one name; give each once")


def map_cells(
    preset: Preset, field_name: str, scenes: Sequence[Scene], seed: int = 0
) -> list[MapCell]:
    """One map of every scene."""
    return [MapCell(scene, field_name, preset, seed=seed) for scene in scenes]


def track_cells(
    preset: Preset,
    tracker_name: str,
    scenes: Sequence[Scene],
    budget: str = "steps",
    seed: int = 0,
) -> list[TrackCell]:
    """One tracked run of every scene at every rate, all with the same kind of budget.

    A seed is that of the map and of the run in it: its spread is that of the whole method.

    Raises:
        ConfigError: the tracker is unknown, or the budget is neither "steps" nor "clock".
    """
    if budget not in BUDGETS:
        raise ConfigError(f"unknown budget {budget!r}: {nearest_name(budget, list(BUDGETS))}")
    tracker = tracker_class(tracker_name)
    cell = partial(
        TrackCell, tracker_name=tracker_name, frames=preset.scenes.track_frames, seed=seed
    )
    return [
        cell(map_cell, rate_hz=rate_hz)
        if budget == "clock"
        else cell(map_cell, steps=paper_steps(tracker.paper_steps, rate_hz))
        for rate_hz in preset.tables.rates_hz
        for map_cell in map_cells(preset, tracker.field_name, scenes, seed)
    ]


def plan_table_1(
    preset: Preset,
    scenes: Sequence[Scene],
    budget: str = "steps",
    seeds: int = 1,
    trackers: Sequence[str] | None = None,
) -> list[TableCell]:
    """Every cell of Table I, in the order of its rows: tracker, rate, scene, seed."""
    rates_hz = [rate_hz for rate_hz in preset.tables.rates_hz for _ in scenes]
    return [
        TableCell(rate_hz, tracker_class(name).label, run)
        for name in dict.fromkeys(trackers or paper_trackers())
        for seed in range(seeds)
        for rate_hz, run in zip(
            rates_hz, track_cells(preset, name, scenes, budget, seed), strict=True
        )
    ]  # fmt: skip


def run_maps(
    cells: Sequence[MapCell], say: Say = tqdm.write, execution: Execution | None = None
) -> pd.DataFrame:
    """Make the maps that are not cached, side by side; returns the scores of all of them."""
    missing = [cell for cell in cells if not cell.is_done]
    say(f"{len(cells) - len(missing)} of {len(cells)} maps are cached, {len(missing)} to make")
    jobs = [_map_job(cell) for cell in missing]
    run_jobs(jobs, "mapping", execution)
    rows = {}
    for cell in cells:
        summary = map_summary(cell)
        rows[cell.scene.name] = {**summary["quality"], "seconds": summary["seconds"]}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("scene")


def run_tracks(
    cells: Sequence[TrackCell],
    say: Say = tqdm.write,
    execution: Execution | None = None,
    maps: Sequence[MapCell] = (),
) -> list[Any]:
    """Make the runs that are not cached, and their maps; returns the metrics of all, in order.

    Runs with a step budget go side by side, each as soon as its map is there. With the clock they
    go one after the other on this machine, when everything else is done: a neighbour would slow
    the clock's steps down.

    Args:
        maps: further maps to make in the same go.

    Returns:
        Metrics; with `execution.keep_going`, in the place of a run that failed, its error.
    """
    execution = execution or Execution()
    missing = [cell for cell in cells if not cell.is_done]
    wanted = [*maps, *(cell.map_cell for cell in missing)]
    to_map = {cell.folder: cell for cell in wanted if not cell.is_done}
    news = f"{len(cells) - len(missing)} of {len(cells)} runs are cached"
    if missing or to_map:
        where = execution.cluster or device_name(choose_device())
        news += f", {len(missing)} runs and {len(to_map)} maps to make on {where}"
    say(news)
    by_clock = [cell for cell in missing if cell.rate_hz is not None]
    others = [cell for cell in missing if cell.rate_hz is None]
    jobs = _jobs_by_scene(list(to_map.values()), others)
    done = run_jobs(jobs, "grid", execution)
    failed = {
        job.name: result
        for job, result in zip(jobs, done, strict=True)
        if isinstance(result, NbtrackError)
    }
    failed |= _run_by_clock([c for c in by_clock if c.map_cell.is_done], execution, say)
    return [_outcome(cell, failed) for cell in cells]


def table_1_results(
    cells: Sequence[TableCell], say: Say = tqdm.write, execution: Execution | None = None
) -> pd.DataFrame:
    """Table I in long form, a row for every seed; runs what is missing.

    Columns: rate_hz, method, scene, seed, ate_m (NaN where the run failed), failure (why), run
    (the name of its folder) and the other metrics.
    """
    results = run_tracks([cell.run for cell in cells], say, execution)
    rows = []
    for cell, result in zip(cells, results, strict=True):
        failed = isinstance(result, NbtrackError)
        metrics = {} if failed else {k: v for k, v in result.items() if k != "config"}
        rows.append(
            {
                "rate_hz": cell.rate_hz, "method": cell.method, "scene": cell.run.scene_name,
                "seed": cell.run.seed, "ate_m": metrics.get("ate_rmse_m", float("nan")),
                "failure": str(result) if failed else "", "run": cell.run.folder.name, **metrics,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def table_1_cells(
    preset: Preset, scenes: Sequence[Scene], budget: str = "steps", seeds: int = 1
) -> pd.DataFrame:
    """Table I in long form, averaged over seeds, for the paper's trackers; runs what is missing."""
    return average_over_seeds(table_1_results(plan_table_1(preset, scenes, budget, seeds)))


def _jobs_by_scene(maps: list[MapCell], runs: list[TrackCell]) -> list[Job]:
    """Maps before the runs in them, one scene after the other, so that a scene is soon complete."""
    jobs = [(cell.scene.name, 0, _map_job(cell)) for cell in maps]
    made = {cell.folder.name for cell in maps}
    for cell in runs:
        needs = tuple({cell.map_cell.folder.name} & made)
        job = Job(
            cell.folder.name, cell.n_frames, _make_track, (cell,), cell.evaluations, needs,
            cell.name,
        )  # fmt: skip
        jobs.append((cell.scene_name, 1, job))
    scenes = list(dict.fromkeys(scene for scene, _, _ in jobs))
    ordered = sorted(jobs, key=lambda item: (scenes.index(item[0]), item[1]))
    return list({job.name: job for _, _, job in ordered}.values())


def _map_job(cell: MapCell) -> Job:
    iterations = cell.preset.mapping_of(cell.field_name).iterations
    return Job(cell.folder.name, iterations, _make_map, (cell,), cell.evaluations, label=cell.name)


def _run_by_clock(
    cells: list[TrackCell], execution: Execution, say: Say
) -> dict[str, NbtrackError]:
    if not cells:
        return {}
    say("by the clock: one run after the other, here, so that none slows another down")
    jobs = [
        Job(
            cell.folder.name, cell.n_frames, _make_track, (cell,),
            cell.n_frames / float(cell.rate_hz or 1), label=cell.name,
        )
        for cell in cells
    ]  # fmt: skip
    results = run_jobs(jobs, "by the clock", replace(execution, workers=1, cluster=None))
    return {
        job.name: result
        for job, result in zip(jobs, results, strict=True)
        if isinstance(result, NbtrackError)
    }


def _outcome(cell: TrackCell, failed: dict[str, NbtrackError]) -> Any:
    for name in (cell.folder.name, cell.map_cell.folder.name):
        if name in failed:
            return failed[name]
    return cell.metrics()


def _make_scene(name: str, config: ScenesConfig, report: Report) -> None:
    find_scene(name, config, progress=lambda done, total: report(done, "frames written"))


def _make_map(cell: MapCell, report: Report) -> None:
    obtain_map(cell, report=report)


def _make_track(cell: TrackCell, report: Report) -> None:
    obtain_track(cell, report=report)
