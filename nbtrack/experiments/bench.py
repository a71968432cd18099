"""The commands that compute the paper's tables: `tables`, and `bench` for Table II alone."""

import os
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from nbtrack import tables
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.data.frame import Frame
from nbtrack.experiments.grid import Execution, map_scene, track_scenes
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_1, TABLE_3
from nbtrack.experiments.presets import PRESETS, Preset, load_preset
from nbtrack.experiments.runs import prepare
from nbtrack.experiments.scenes import Scene, open_scene, open_scenes
from nbtrack.latex import Wording, label_of
from nbtrack.machinery.device import advise_on_memory, choose_device, device_name
from nbtrack.machinery.errors import ConfigError, NbtrackError
from nbtrack.machinery.files import runs_folder
from nbtrack.machinery.progress import ProgressBar, tell
from nbtrack.machinery.settings import changed_settings
from nbtrack.recordings.reading import read_frames
from nbtrack.synthetic import ROOMS
from nbtrack.tracking import ClockBudget, StepBudget, Tracker, make_tracker
from nbtrack.tracking.methods import Methods, find_methods

_REPETITIONS = 3  # a cell of Table II is the mean over so many times that a frame is tracked
# The columns of results that are written with the tables; none depends on the machine's speed.
_CELL_COLUMNS = (
    "rate_hz", "method", "n_pixels", "scene", "seed", "ate_m", "ate_rmse_aligned_m",
    "rotation_rmse_deg", "max_error_m", "frames", "lost_frames", "steps_per_frame", "run",
    "failure",
)  # fmt: skip


def tables_command(options: Namespace) -> None:
    """Compute the tables of a preset, print them, and write them as CSV and LaTeX.

    Raises NbtrackError at the end if runs failed, whose cells are then empty.
    """
    preset = load_preset(options.preset, options.config, options.settings)
    if options.scenes:
        preset = preset.with_values({"scenes.names": options.scenes.split(",")})
    usual = TABLE_3 if options.beyond else TABLE_1
    methods = find_methods(options.method.split(",") if options.method else usual)
    # The following lines check the options, before a room is made.
    execution = Execution(options.workers, options.dask, keep_going=True)
    label = label_of(options.label) if options.label else options.label
    if label != options.label:
        tell(f"nbtrack: LaTeX has no label {options.label!r}: it is {label!r} in the tables")
    wording = Wording(options.caption, label, dict(map(_label_of, preset.scenes.labels)))
    prepare(options.out)
    results = _fill_tables(options, preset, methods, execution, wording)
    if failures := [failure for failure in results["failure"] if failure]:
        found = f"{len(failures)} cells of the table failed and are empty"
        raise NbtrackError(f"{found}, the first because {failures[0]}; mend it and run again")


def _fill_tables(
    options: Namespace, preset: Preset, methods: Methods, execution: Execution, wording: Wording
) -> pd.DataFrame:
    """Make the runs that are missing, print and write the tables; returns a row for each run.

    `wording` holds the user's caption, label and names of scenes for the LaTeX tables.
    """
    clock = options.budget == "clock"
    scenes = open_scenes(preset)
    rates = RATES_3_HZ if options.beyond else None  # None: the preset's
    results = track_scenes(
        scenes, methods, preset, rates, clock=clock, seeds=range(options.seeds), execution=execution
    )
    shown = results.drop(columns="still_ate_m", errors="ignore") if options.no_still else results
    folder = options.out or runs_folder() / f"tables/{preset.name}{'_clock' if clock else ''}"
    note = f"{camera_motion(preset, results)}; {_note(preset, clock)}"
    print(f"Table {'III: ATE (mm)' if options.beyond else 'I: ATE (m)'}, {note}")
    if options.beyond:
        print(tables.style_table_1(tables.naming_points(shown), unit="mm"))
        paths = tables.write_table_3(folder, shown, note, wording)
    else:
        print(tables.style_table_1(shown))
        print("Table I beside the paper's")
        print(tables.beside_published(shown).to_string(float_format="%.3f", na_rep="–"))
        # A step costs the same in all scenes, so Table II needs only one: the first scene in which
        # no run failed. Its budgets are always by the clock.
        failed = {*results.loc[results["failure"] != "", "scene"]}
        complete = next((scene for scene in scenes if scene.name not in failed), scenes[0])
        steps = _table_2(preset, complete, methods)
        pixels, by_clock = default_pixels(preset, methods), _note(preset, clock=True)
        paths = tables.write_tables(folder, shown, steps, note, pixels, by_clock, wording)
    cells = folder / f"table_{3 if options.beyond else 1}_cells.csv"
    # With all digits, because benchmarks/documents.py computes tables from such files.
    paths.append(tables.write_csv(cells, results.filter(_CELL_COLUMNS), float_format=None))
    print("\n".join(map(str, paths)))
    return results


def _label_of(text: str) -> tuple[str, str]:
    """The scene's name in our tables and its label in LaTeX, from a text `NAME=LABEL`.

    Raises ConfigError for another text.
    """
    name, equals, label = str(text).partition("=")
    if not equals:
        raise ConfigError(f"scenes.labels has {text!r}: write 'NAME=LABEL', as 'office=Office'")
    return DATASET_SCENES.get(name, name), label


def bench_command(options: Namespace) -> None:
    """Measure Table II; print it, and write it as CSV."""
    # Networks have the paper's sizes by default: with small ones the time of a step is overhead.
    name = options.preset or os.environ.get("NBTRACK_PRESET") or "synthetic"
    # A step costs the same whatever the images and the weights of the map are. So the room has the
    # fewest images that are allowed, and the map is hardly trained.
    quick = ("scenes.n_frames=2", "mapping.imap.iterations=1", "mapping.neus.iterations=1")
    preset = load_preset(name, options.config, [*options.settings, *quick])
    prepare(options.out)
    steps = _table_2(preset, open_scene(preset.scenes.names[0], preset))  # prints the table
    folder = options.out or runs_folder() / "bench" / preset.name
    print(tables.write_csv(folder / "table_2.csv", steps))


def _table_2(preset: Preset, scene: Scene, methods: Methods = TABLE_1) -> pd.DataFrame:
    """Measure Table II and print it; returns the rows of `measure_steps`."""
    steps = measure_steps(preset, scene, methods)
    machine = f"{device_name(choose_device())}, {torch.get_num_threads()} threads"
    print(f"Table II: steps, {preset.name} networks, on {machine}")
    print(tables.style_table_2(steps, default_pixels=default_pixels(preset, methods)))
    return steps


def measure_steps(preset: Preset, scene: Scene, methods: Methods = TABLE_1) -> pd.DataFrame:
    """Count the steps of the trackers of some methods within time budgets, as in Table II.

    Each tracker is measured with every n (pixels) that the preset lists for it. It tracks the
    scene's first frame that has a pose, in the field of the first method that has the tracker. The
    scene's map is made if it is not cached.

    Returns a row for each cell: tracker ("VR", "SDF", ...), n_pixels, budget_ms, steps and
    steps_std (mean and population std over repetitions), and converged (whether every search ended
    before the budget did). Source: paper, Table II and evaluation protocol.
    """
    method_of = {}
    for method in find_methods(methods):
        method_of.setdefault(method.tracker, method)
    pixels, usual = preset.tables.pixels, preset.tables.pixels["sdf"]
    plan = [(method, n) for method in method_of.values() for n in pixels.get(method.tracker, usual)]
    frame = read_frames(scene.recording, np.flatnonzero(scene.recording.has_pose)[:1])[0]
    columns = ["tracker", "n_pixels", "budget_ms", "steps", "steps_std", "converged"]
    rows = []
    with ProgressBar("Table II", len(plan)) as bar:
        for done, (method, n_pixels) in enumerate(plan):
            name = method.tracker
            bar.move_to(done, f"{name}={n_pixels}")
            with_method = preset.with_method(method.settings)
            settings = replace(with_method.tracking_of(name), n_pixels=n_pixels)
            with advise_on_memory(f"tables.pixels.{name}={n_pixels}"):
                field = map_scene(scene, method.field, with_method).field
                # `_steps_within` replaces the budget.
                tracker = make_tracker(name, field, frame.T_world_camera, StepBudget(1), settings)
                for budget_ms in preset.tables.budgets_ms:
                    counts, converged = _steps_within(tracker, frame, budget_ms)
                    mean, std = float(np.mean(counts)), float(np.std(counts))
                    rows.append((name.upper(), n_pixels, budget_ms, mean, std, converged))
        bar.move_to(len(plan))
    return pd.DataFrame(rows, columns=columns)


def _steps_within(tracker: Tracker, frame: Frame, budget_ms: float) -> tuple[list[int], bool]:
    """Track a frame several times from its true pose; returns the steps of each time.

    Also returns whether the tracker converged each time: it ended although one more step would have
    fitted into the budget. The first time, in which it allocates and compiles, is left out.
    """
    tracker.budget = ClockBudget(1000 / budget_ms)  # Hz
    counts, seconds_with_one_more = [], []
    for _ in range(1 + _REPETITIONS):
        tracker.restart(frame.T_world_camera)
        estimate = tracker.track(frame)
        counts.append(estimate.steps)
        seconds_with_one_more.append(estimate.seconds * (1 + 1 / max(estimate.steps, 1)))
    return counts[1:], 1000 * max(seconds_with_one_more[1:]) < budget_ms


def default_pixels(preset: Preset, methods: Methods = TABLE_1) -> dict[str, int]:
    """The n (pixels) of Table I, by the trackers' labels in Table II.

    It is the n of the first method that has the tracker.
    """
    pixels = {}
    for method in find_methods(methods):
        settings = preset.with_method(method.settings).tracking_of(method.tracker)
        pixels.setdefault(method.tracker.upper(), settings.n_pixels)
    return pixels


def camera_motion(preset: Preset, results: pd.DataFrame) -> str:
    """A text for captions: how the camera moves, and how far a frame (mm), the mean over runs."""
    are_rooms = set(preset.scenes.names) <= set(ROOMS)
    kind = f"{preset.scenes.motion} motion" if are_rooms else "motion of the recordings"
    if "path_m" not in results:
        return f"Camera: {kind}"
    motion_mm = 1e3 * (results["path_m"] / results["frames"]).mean()
    return f"Camera: {kind}, {motion_mm:.1f} mm a frame on average"


def _note(preset: Preset, clock: bool) -> str:
    """A sentence on how the numbers were measured: preset, changed settings, budget, device."""
    budget = "wall clock" if clock else preset.step_counts
    return f"Preset: {described(preset)}; budget: {budget}; device: {device_name(choose_device())}."


def described(preset: Preset) -> str:
    """A text for captions: the preset's name, and the settings that differ from the preset's.

    Settings that the table itself shows are left out.
    """
    changed = changed_settings(preset.settings, PRESETS[preset.name].settings)
    # The table's columns have the names of scenes, and the rows of Table II the numbers of pixels.
    shown = ("scenes.names", "scenes.labels", "tables.pixels")
    changed = [text for text in changed if not text.startswith(shown)]
    return f"{preset.name}, with {', '.join(changed)}" if changed else preset.name
