"""Table III: the paper's methods beside those that go beyond it, and what each ingredient adds."""

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from nbtrack.core.config import Preset
from nbtrack.core.settings import with_settings
from nbtrack.experiments.ablations import beginning_of, error_of_first
from nbtrack.experiments.cells import MapCell, TrackCell
from nbtrack.experiments.grid import TableCell, run_tracks, table_1_results
from nbtrack.experiments.parallel import Execution
from nbtrack.experiments.results import map_summary
from nbtrack.experiments.scenes import Scene
from nbtrack.tracking.budget import paper_steps
from nbtrack.tracking.trackers import tracker_class


@dataclass(frozen=True)
class Method:
    """A row of Table III: a tracker in a field, with settings of its own."""

    label: str
    field_name: str
    tracker_name: str
    settings: tuple[str, ...] = ()  # key=value, over those of the preset


BAKED = Method("NeuS+ baked (LM)", "neus_plus", "lm", ("tracking.lm.bake_voxel=0.04",))
LM = Method("NeuS+ with SDF (LM)", "neus_plus", "lm")
ADAM_PLUS = Method("NeuS+ with SDF (Adam)", "neus_plus", "sdf")
METHODS = (
    Method("iMAP with VR", "imap", "vr"),
    Method("NeuS with VR", "neus", "vr_neus"),
    Method("NeuS with SDF (Adam)", "neus", "sdf"),
    ADAM_PLUS,
    LM,
    BAKED,
    Method("ICP", "points", "icp"),
)
"""The rows of Table III. A further method is a further entry."""
PAPERS_METHODS = (METHODS[0].label, METHODS[2].label)
"""Those that the paper's Table I compares."""

RATES_HZ = (30.0, 10.0, 5.0, 2.0)
"""The paper's rates, and that of the camera itself."""

INGREDIENTS = (
    ("everything", LM.field_name, ()),
    ("without colour", LM.field_name, ("tracking.lm.lambda_intensity=0",)),
    ("with narrow scales throughout", LM.field_name, ("tracking.lm.anneal=false",)),
    ("with f in place of f/|∇f|", LM.field_name, ("tracking.lm.divide_by_slope=false",)),
    ("from the previous pose", LM.field_name, ('tracking.lm.motion_model="previous_pose"',)),
    (
        "from constant velocity", LM.field_name,
        ('tracking.lm.motion_model="constant_velocity"',),
    ),
    ("with four times the points", LM.field_name, ("tracking.lm.n_pixels=2048",)),
    ("in NeuS+ without rendering", LM.field_name, ("mapping.neus_plus.lambda_rendering=0",)),
    ("in NeuS, as in the paper", "neus", ()),
)  # fmt: skip
"""What LM is made of: name, field and settings; each row differs from the first in one thing."""
MOST_STEPS = 30.0
"""Steps a frame that LM may take where no rate is set; it stops when it has converged."""


def plan_table_3(
    preset: Preset,
    scenes: Sequence[Scene],
    budget: str = "steps",
    methods: Sequence[Method] = METHODS,
    seeds: int = 1,
    n_frames: int | None = None,
) -> list[TableCell]:
    """Every cell of Table III: method, rate, scene, seed.

    With step counts every tracker on distances has those that the paper measured for SDF, every
    renderer those for VR; some stop sooner. Rows and rates that are in Table I are the same runs.

    Args:
        n_frames: runs that are not in Table I end after so many frames.
    """
    return [
        TableCell(
            rate_hz, method.label,
            _track_cell(preset, scene, method, budget, rate_hz, seed, n_frames),
        )
        for method in methods
        for seed in range(seeds)
        for rate_hz in RATES_HZ
        for scene in scenes
    ]  # fmt: skip


def table_3_results(
    preset: Preset,
    scenes: Sequence[Scene],
    budget: str = "steps",
    methods: Sequence[Method] = METHODS,
    execution: Execution | None = None,
    n_frames: int | None = None,
) -> pd.DataFrame:
    """Table III in long form, as `grid.table_1_results` gives Table I; runs what is missing.

    Args:
        n_frames: only so many frames are scored, in every row. Runs of Table I are not made anew
            for it: a run's beginning does not depend on what follows.
    """
    cells = plan_table_3(preset, scenes, budget, methods, n_frames=n_frames)
    results = table_1_results(cells, execution=execution)
    if n_frames is None:
        return results
    return results.assign(ate_m=[error_of_first(cell.run, n_frames) for cell in cells])


def speed_and_accuracy(results: pd.DataFrame, rate_hz: float | int = 10) -> pd.DataFrame:
    """Milliseconds a frame and ATE (cm) of each method at one rate, means over scenes.

    Args:
        results: from `table_3_results` with step counts: by the clock all take the whole frame.

    Returns:
        Columns method, ms_per_frame, ate_cm, steps.
    """
    block = results[results["rate_hz"] == rate_hz]
    means = block.groupby("method", sort=False).agg(
        ms_per_frame=("seconds_per_frame", "mean"), ate_cm=("ate_m", "mean"),
        steps=("steps_per_frame", "mean"),
    )  # fmt: skip
    return (means * [1000, 100, 1]).reset_index()


def what_each_ingredient_adds(
    preset: Preset,
    scenes: Sequence[Scene],
    strides: Sequence[int] = (1, 8),
    execution: Execution | None = None,
) -> pd.DataFrame:
    """LM with one thing changed at a time, with every frame and with most of them left out.

    Returns:
        Columns ingredient, scene, stride (every so many frames are tracked), ate_m, lost_frames,
        steps_per_frame.
    """
    plans = [
        (ingredient, scene, stride, _ablated(preset, scene, field_name, settings, stride))
        for ingredient, field_name, settings in INGREDIENTS
        for scene in scenes
        for stride in strides
    ]
    metrics = run_tracks([cell for *_, cell in plans], execution=execution)
    return pd.DataFrame(
        {
            "ingredient": ingredient, "scene": scene.name, "stride": stride,
            "ate_m": found["ate_rmse_m"], "lost_frames": found["lost_frames"],
            "steps_per_frame": found["steps_per_frame"],
        }
        for (ingredient, scene, stride, _), found in zip(plans, metrics, strict=True)
    )  # fmt: skip


def map_errors(preset: Preset, scenes: Sequence[Scene]) -> pd.DataFrame:
    """Seconds of mapping and errors of the distance (cm) of NeuS and NeuS+, made and finished.

    Returns:
        Columns field, scene, seconds, near_cm (within 5 cm of surfaces), free_cm (elsewhere).
    """
    rows = []
    for field_name in ("neus", "neus_plus"):
        for scene in scenes:
            summary = map_summary(MapCell(scene, field_name, preset))
            quality = summary["quality"]
            rows.append(
                {
                    "field": field_name, "scene": scene.name, "seconds": summary["seconds"],
                    "near_cm": 100 * quality["sdf_near_m"], "free_cm": 100 * quality["sdf_free_m"],
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def _track_cell(
    preset: Preset,
    scene: Scene,
    method: Method,
    budget: str,
    rate_hz: float,
    seed: int,
    n_frames: int | None,
) -> TrackCell:
    preset = with_settings(preset, *method.settings)
    is_in_table_1 = method.label in PAPERS_METHODS and rate_hz in preset.tables.rates_hz
    frames = beginning_of(preset, None if is_in_table_1 else n_frames)
    steps = paper_steps(tracker_class(method.tracker_name).paper_steps, rate_hz)
    return TrackCell(
        MapCell(scene, method.field_name, preset, seed=seed), method.tracker_name,
        **({"rate_hz": rate_hz} if budget == "clock" else {"steps": steps}),
        frames=frames, seed=seed,
    )  # fmt: skip


def _ablated(
    preset: Preset, scene: Scene, field_name: str, settings: tuple[str, ...], stride: int
) -> TrackCell:
    map_cell = MapCell(scene, field_name, with_settings(preset, *settings))
    return TrackCell(map_cell, LM.tracker_name, steps=MOST_STEPS, frames=f"::{stride}")
