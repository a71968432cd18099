"""The paper's open questions as small grids, each a table in long form, cached as all cells are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import log

import numpy as np
import pandas as pd

from nbtrack.core.config import Preset
from nbtrack.core.settings import with_settings
from nbtrack.data.sequence import parse_frames
from nbtrack.experiments.cells import MapCell, TrackCell
from nbtrack.experiments.grid import TableCell, plan_table_1, run_maps, run_tracks
from nbtrack.experiments.results import map_summary, read_poses
from nbtrack.experiments.scenes import Scene
from nbtrack.tables.claims import iteration_ratio
from nbtrack.tracking.budget import paper_steps
from nbtrack.tracking.metrics import translation_errors
from nbtrack.tracking.trackers import tracker_class

RATE_FACTORS = (1.0, 2.0, 4.0)
"""What both of the paper's learning rates are multiplied by."""
ITERATION_SHARES = (0.125, 0.35, 1.0)
"""Shares of a preset's mapping iterations; each is a map of its own, its learning rate too."""
COMPARED_STARTS = ("previous_pose", "constant_velocity")
"""Where a frame's search starts: models that give one answer, as the paper's trackers need."""
COMPARED_FRAMES = 60
"""Frames over which volume rendering is compared in both maps: it is slow."""


def run_all(preset: Preset, scenes: Sequence[Scene]) -> None:
    """Make every map and run that the functions below ask for by default, in one go."""
    fastest, slowest = max(preset.tables.rates_hz), min(preset.tables.rates_hz)
    runs = [
        *_plan_reach(preset, scenes[0], ("vr", "sdf"), RATE_FACTORS)[1],
        *_plan_starts(preset, scenes, fastest, ("vr", "sdf"))[1],
        *(cell.run for cell in _plan_both_maps(preset, scenes, slowest, COMPARED_FRAMES)),
    ]
    curves = _plan_curves(preset, scenes[0], ITERATION_SHARES)
    run_tracks(runs, maps=[cell for _, _, cell in curves])


def vr_in_both_maps(
    preset: Preset,
    scenes: Sequence[Scene],
    rate_hz: float | int = 2,
    n_frames: int | None = COMPARED_FRAMES,
) -> pd.DataFrame:
    """A block of Table I with a third row: volume rendering in the map that SDF tracking uses.

    In one map only the way of tracking differs; with one tracker only the map.

    Args:
        n_frames: only so many frames are tracked and scored. The runs of Table I are not made
            anew for it: a run's beginning does not depend on what follows.

    Returns:
        Columns rate_hz, method, scene, ate_m.
    """
    cells = _plan_both_maps(preset, scenes, rate_hz, n_frames)
    run_tracks([cell.run for cell in cells])
    rows = [
        (cell.rate_hz, cell.method, cell.run.scene_name, error_of_first(cell.run, n_frames))
        for cell in cells
    ]
    return pd.DataFrame(rows, columns=["rate_hz", "method", "scene", "ate_m"])


def learning_rate_and_steps(
    preset: Preset,
    scene: Scene,
    trackers: Sequence[str] = ("vr", "sdf"),
    factors: Sequence[float] = RATE_FACTORS,
) -> pd.DataFrame:
    """ATE with more steps a frame, and with larger steps instead, in one scene.

    "More steps" are those of the paper's hardware at the preset's rates with the paper's learning
    rates; "larger steps" are those of the fastest rate with the learning rates times a factor.

    Returns:
        Columns method, how, steps, factor, reach_mm (by how much Adam can move the position along
        an axis in one frame: steps times learning rate), ate_m.
    """
    rows, cells = _plan_reach(preset, scene, trackers, factors)
    table = pd.DataFrame(rows, columns=["method", "how", "steps", "factor", "reach_mm"])
    return table.assign(ate_m=_errors(cells))


def start_of_the_search(
    preset: Preset,
    scenes: Sequence[Scene],
    rate_hz: float | int = 10,
    trackers: Sequence[str] = ("vr", "sdf"),
) -> pd.DataFrame:
    """A block of Table I for each motion model: where a frame's search starts.

    Returns:
        Columns rate_hz, method (tracker and motion model), tracker, motion_model, scene, ate_m.
    """
    rows, cells = _plan_starts(preset, scenes, rate_hz, trackers)
    return pd.DataFrame(rows).assign(ate_m=_errors(cells))


def quality_over_time(
    preset: Preset, scene: Scene, shares: Sequence[float] = ITERATION_SHARES
) -> pd.DataFrame:
    """Error of held-out depth against mapping time, for both fields of the paper.

    Every point is a map made with that many iterations from start to end, so that each has the
    learning rates of a finished map. Columns: field, iterations, seconds, depth_l1_m.
    """
    rows = _plan_curves(preset, scene, shares)
    run_maps([cell for _, _, cell in rows])
    summaries = [map_summary(cell) for _, _, cell in rows]
    return pd.DataFrame(
        {
            "field": [name for name, _, _ in rows],
            "iterations": [iterations for _, iterations, _ in rows],
            "seconds": [summary["seconds"] for summary in summaries],
            "depth_l1_m": [summary["quality"]["depth_l1_m"] for summary in summaries],
        }
    )


@dataclass(frozen=True)
class TimeToQuality:
    """NeuS against iMAP: the same work, and the same result."""

    per_iteration: float  # seconds of a NeuS iteration over those of iMAP, for as many samples
    depth_l1_m: float  # the best error of held-out depth that both reach
    to_equal_quality: float  # seconds of NeuS over those of iMAP until there


def compare_times(curves: pd.DataFrame, preset: Preset) -> TimeToQuality:
    """How much longer NeuS takes than iMAP, for equal work and to the best error that both reach.

    Between two measured maps the error is taken to fall along a straight line on logarithmic axes.

    Args:
        curves: from `quality_over_time` with this preset.
    """
    fields = {
        name: curves[curves["field"] == name].sort_values("seconds") for name in ("imap", "neus")
    }
    whole = {name: table["seconds"].iloc[-1:].tolist() for name, table in fields.items()}
    target = max(float(table["depth_l1_m"].min()) for table in fields.values())
    seconds = {name: _seconds_to(table, target) for name, table in fields.items()}
    return TimeToQuality(iteration_ratio(preset, whole), target, seconds["neus"] / seconds["imap"])


def _plan_both_maps(
    preset: Preset, scenes: Sequence[Scene], rate_hz: float | int, n_frames: int | None
) -> list[TableCell]:
    block = replace(preset, tables=replace(preset.tables, rates_hz=(float(rate_hz),)))
    beginning = replace(preset.scenes, track_frames=beginning_of(preset, n_frames))
    return [
        *plan_table_1(block, scenes, trackers=("vr", "sdf")),
        *plan_table_1(replace(block, scenes=beginning), scenes, trackers=("vr_neus",)),
    ]


def _plan_reach(
    preset: Preset, scene: Scene, trackers: Sequence[str], factors: Sequence[float]
) -> tuple[list[tuple], list[TrackCell]]:
    fastest = max(preset.tables.rates_hz)
    plans = [(rate_hz, 1.0, "more steps") for rate_hz in preset.tables.rates_hz]
    plans += [(fastest, factor, "larger steps") for factor in factors]
    rows, cells = [], []
    for name in trackers:
        tracker = tracker_class(name)
        for rate_hz, factor, how in plans:
            changed = _with_rates(preset, name, factor)
            map_cell = MapCell(scene, tracker.field_name, changed)
            steps = paper_steps(tracker.paper_steps, rate_hz)
            cells.append(TrackCell(map_cell, name, steps=steps, frames=preset.scenes.track_frames))
            reach_mm = 1000 * steps * changed.tracking_of(name).position_rate
            rows.append((tracker.label, how, steps, factor, reach_mm))
    return rows, cells


def _plan_starts(
    preset: Preset, scenes: Sequence[Scene], rate_hz: float | int, trackers: Sequence[str]
) -> tuple[list[dict], list[TrackCell]]:
    block = replace(preset, tables=replace(preset.tables, rates_hz=(float(rate_hz),)))
    rows, cells = [], []
    for name in trackers:
        for model in COMPARED_STARTS:
            changed = with_settings(block, f"tracking.{name}.motion_model={model}")
            for cell in plan_table_1(changed, scenes, trackers=(name,)):
                cells.append(cell.run)
                rows.append(
                    {
                        "rate_hz": rate_hz,
                        "method": f"{cell.method}, {model.replace('_', ' ')}",
                        "tracker": cell.method, "motion_model": model,
                        "scene": cell.run.scene_name,
                    }
                )  # fmt: skip
    return rows, cells


def _plan_curves(
    preset: Preset, scene: Scene, shares: Sequence[float]
) -> list[tuple[str, int, MapCell]]:
    rows = []
    for name in ("imap", "neus"):
        for share in shares:
            iterations = max(1, round(share * preset.mapping_of(name).iterations))
            changed = with_settings(preset, f"mapping.{name}.iterations={iterations}")
            rows.append((name, iterations, MapCell(scene, name, changed)))
    return rows


def _seconds_to(curve: pd.DataFrame, target: float) -> float:
    """Seconds at which a falling curve first reaches an error, interpolated in logarithms."""
    points = list(zip(curve["seconds"], curve["depth_l1_m"], strict=True))
    if points[0][1] <= target:
        return float(points[0][0])
    for (t0, e0), (t1, e1) in pairwise(points):
        if e1 <= target:
            share = _log_share(e0, e1, target)
            return float(t0 * (t1 / t0) ** share)
    raise AssertionError("the target is a value that both curves reach")


def _log_share(start: float, end: float, between: float) -> float:
    return log(start / between) / log(start / end)


def _with_rates(preset: Preset, tracker_name: str, factor: float) -> Preset:
    config = preset.tracking_of(tracker_name)
    return with_settings(
        preset,
        f"tracking.{tracker_name}.position_rate={factor * config.position_rate!r}",
        f"tracking.{tracker_name}.orientation_rate={factor * config.orientation_rate!r}",
    )


def _errors(cells: Sequence[TrackCell]) -> list[float]:
    return [metrics["ate_rmse_m"] for metrics in run_tracks(cells)]


def beginning_of(preset: Preset, n_frames: int | None) -> str:
    """The tracked frames of a preset, or the first so many of them, as a slice."""
    tracked = preset.scenes.track_frames
    if n_frames is None:
        return tracked
    frames = parse_frames(tracked)
    start, step = frames.start or 0, frames.step or 1
    stop = start + n_frames * step
    return f"{start}:{stop if frames.stop is None else min(stop, frames.stop)}:{step}"


def error_of_first(cell: TrackCell, n_frames: int | None) -> float:
    """ATE (m) over the first frames of a finished run; the given first one is not counted."""
    estimated, true = read_poses(cell)
    stop = None if n_frames is None else n_frames - 1
    return float(np.sqrt((translation_errors(estimated[:stop], true[:stop]) ** 2).mean()))
