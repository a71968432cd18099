"""What the commands `tables` and `bench` do and print."""

import os
from argparse import Namespace

import pandas as pd
import torch

from nbtrack.core.device import choose_device, device_name
from nbtrack.core.errors import ConfigError, NbtrackError
from nbtrack.core.files import runs_folder, tables_folder, write_atomic
from nbtrack.core.settings import changed_settings
from nbtrack.experiments.bench import default_pixels, measure_step_times, measure_steps
from nbtrack.experiments.commands import preset_of
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_1, TABLE_3, find_methods
from nbtrack.experiments.presets import PRESETS, Preset
from nbtrack.experiments.results import track_scenes
from nbtrack.experiments.scenes import open_scene, open_scenes
from nbtrack.tables import (
    beside_published,
    naming_points,
    style_table_1,
    style_table_2,
    write_table_3,
    write_tables,
)

# What a run's row tells beside its place; none of it depends on how fast the machine was.
_CELL_COLUMNS = (
    "rate_hz", "method", "n_pixels", "scene", "seed", "ate_m", "ate_rmse_aligned_m",
    "rotation_rmse_deg", "max_error_m", "frames", "lost_frames", "steps_per_frame", "run",
    "failure",
)  # fmt: skip


def tables_command(options: Namespace) -> None:
    """Fill the tables of a preset and write them as CSV and LaTeX.

    Raises:
        NbtrackError: some cells failed; the tables are written all the same, with gaps.
    """
    names = [f"scenes.names={_words(options.scenes)}"] if options.scenes else []
    preset = preset_of(options, *names)
    if options.beyond and options.trackers:
        raise ConfigError("--beyond has rows of its own: leave --trackers out")
    methods = _words(options.trackers) or (TABLE_3 if options.beyond else TABLE_1)
    find_methods(methods)  # a bad name is told before a room is made
    execution = Execution(options.workers, options.threads, options.dask, keep_going=True)
    scenes, clock = open_scenes(preset), options.budget == "clock"
    results = track_scenes(
        scenes, methods, preset, RATES_3_HZ if options.beyond else None, clock=clock,
        seeds=options.seeds, execution=execution,
    )  # fmt: skip
    folder = options.out or tables_folder() / (preset.name + "_clock" * clock)
    number, note = "III" if options.beyond else "I", _note(preset, clock)
    print(f"Table {number}: ATE (m), {note}")
    print(style_table_1(naming_points(results) if options.beyond else results))
    if options.beyond:
        paths = write_table_3(folder, results, note)
    else:
        steps = measure_steps(preset, scenes[0].read(":1"), methods)
        pixels = default_pixels(preset, methods)
        print("Table I beside the paper's")
        print(beside_published(results).to_string(float_format="%.3f", na_rep="–"))
        print(f"Table II: steps, on {_machine()}")
        print(style_table_2(steps, default_pixels=pixels))
        paths = write_tables(folder, results, steps, note, pixels)
    paths.append(folder / f"table_{len(number)}_cells.csv")
    cells = results[[name for name in _CELL_COLUMNS if name in results]]
    write_atomic(paths[-1], cells.to_csv(index=False, lineterminator="\n"))
    print("\n".join(str(path) for path in paths))
    _check_complete(results)


def _check_complete(results: pd.DataFrame) -> None:
    failed = results[results["failure"] != ""]
    if len(failed):
        raise NbtrackError(
            f"{len(failed)} cells of the table failed and are empty, the first of them "
            f"{failed['run'].iloc[0]}: {failed['failure'].iloc[0]}; mend the cause and run the "
            "same command again, the rest is kept"
        )


def bench_command(options: Namespace) -> None:
    """Measure and print Table II and step times; write them as CSV."""
    # The paper's sizes unless something else is asked for: small networks measure bookkeeping.
    if "NBTRACK_PRESET" not in os.environ:
        options.preset = options.preset or "synthetic"
    preset = preset_of(options, "scenes.n_frames=2")  # one image is enough
    sequence = open_scene(preset.scenes.names[0], preset).read(":1")
    out = options.out or runs_folder() / "bench" / preset.name
    print(f"{preset.name} networks, on {_machine()}")
    times = measure_step_times(preset, sequence)
    print(times.to_string(index=False, float_format="%.4g"))
    steps = measure_steps(preset, sequence)
    print("Table II: steps within a budget")
    print(style_table_2(steps, default_pixels=default_pixels(preset)))
    for name, table in (("step_times", times), ("table_2", steps)):
        text = table.to_csv(index=False, float_format="%.6g", lineterminator="\n")
        write_atomic(out / f"{name}.csv", text)
    print(f"written to {out}")


def _note(preset: Preset, clock: bool) -> str:
    """How the numbers came about, in a sentence. Which scenes there are the columns tell."""
    changed = changed_settings(preset, PRESETS[preset.name])
    changed = [setting for setting in changed if not setting.startswith("scenes.names")]
    told = f"{preset.name}, with {', '.join(changed)}" if changed else preset.name
    budget = "wall clock" if clock else "the paper's step counts"
    return f"Preset: {told}; budget: {budget}; device: {device_name(choose_device())}."


def _machine() -> str:
    return f"{device_name(choose_device())}, {torch.get_num_threads()} threads"


def _words(text: str | None) -> list[str]:
    """The parts of a list with commas."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]
