"""The `tables` command: fill the grid, write the tables, or tell where a number comes from."""

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from tqdm import tqdm

from nbtrack.core.config import Preset
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.errors import ConfigError, NbtrackError, nearest_name
from nbtrack.core.files import write_text_atomic
from nbtrack.core.paths import PAPER_TABLES
from nbtrack.core.settings import changed_settings
from nbtrack.experiments.bench import default_pixels, obtain_steps
from nbtrack.experiments.beyond import plan_table_3
from nbtrack.experiments.explain import explain_run, find_cells
from nbtrack.experiments.grid import BUDGETS, plan_table_1, prepare_scenes, table_1_results
from nbtrack.experiments.parallel import Execution
from nbtrack.tables.comparison import beside_published, write_comparisons
from nbtrack.tables.latex import TableNotes, write_table_3, write_tables
from nbtrack.tables.layout import (
    average_over_seeds,
    deviations_1,
    deviations_2,
    error_texts,
    step_texts,
    table_1,
    table_2,
)

# What a cell's row tells beside its place; none of it depends on how fast the machine was.
_CELL_COLUMNS = (
    "rate_hz", "method", "scene", "seed", "ate_m", "ate_rmse_aligned_m", "rotation_rmse_deg",
    "max_error_m", "frames", "lost_frames", "steps_per_frame", "run", "failure",
)  # fmt: skip


def tables_command(
    preset: Preset,
    budget: str = "steps",
    seeds: int = 1,
    trackers: tuple[str, ...] = (),
    execution: Execution | None = None,
    measure_again: bool = False,
    out: Path | None = None,
) -> None:
    """Fill both tables of a preset and write them as CSV and LaTeX.

    Raises:
        NbtrackError: some cells failed; the tables are written all the same, with gaps.
    """
    budgets = _budgets(budget)
    _check_seeds(seeds)
    execution = execution or Execution(keep_going=True)
    # A bad name is told before a room is made.
    plan_table_1(preset, [], budgets[0], seeds, trackers)
    scenes = prepare_scenes(preset, _tell)
    results_of = {
        kind: table_1_results(plan_table_1(preset, scenes, kind, seeds, trackers), _tell, execution)
        for kind in budgets
    }
    cells_2 = obtain_steps(preset, scenes[0].read(slice(0, 1)), choose_device(), measure_again)
    for kind, results in results_of.items():
        _write(_folder(preset, kind, budgets, out), preset, kind, results, cells_2)
    _raise_failures(list(results_of.values()))


def beyond_command(
    preset: Preset,
    budget: str = "steps",
    seeds: int = 1,
    execution: Execution | None = None,
    out: Path | None = None,
) -> None:
    """Fill Table III of a preset and write it as CSV and LaTeX.

    Raises:
        NbtrackError: some cells failed; the table is written all the same, with gaps.
    """
    budgets = _budgets(budget)
    _check_seeds(seeds)
    execution = execution or Execution(keep_going=True)
    scenes = prepare_scenes(preset, _tell)
    all_results = []
    for kind in budgets:
        results = table_1_results(plan_table_3(preset, scenes, kind, seeds=seeds), _tell, execution)
        all_results.append(results)
        cells = average_over_seeds(results)
        folder = _folder(preset, kind, budgets, out)
        paths = write_table_3(folder, cells, _notes(preset, kind))
        paths.append(_write_cells(folder / "table_3_cells.csv", results))
        print(f"Table III: ATE (m), {_notes(preset, kind)}")
        print(error_texts(table_1(cells), deviations_1(cells)).to_string())
        print("\n".join(str(path) for path in paths))
    _raise_failures(all_results)


def explain_command(
    preset: Preset,
    budget: str,
    seeds: int,
    trackers: tuple[str, ...],
    row: str,
    column: str,
    beyond: bool = False,
) -> None:
    """Print where one cell of Table I (or III) comes from, and the command that makes it again."""
    (kind,) = _budgets(budget) if budget != "both" else ("steps",)
    _check_seeds(seeds)
    scenes = prepare_scenes(preset, _tell, make=False)
    if beyond:
        cells = plan_table_3(preset, scenes, kind, seeds=seeds)
    else:
        cells = plan_table_1(preset, scenes, kind, seeds, trackers)
    for cell in find_cells(cells, row, column):
        print(explain_run(cell.run))


def _budgets(budget: str) -> tuple[str, ...]:
    allowed = {**{name: (name,) for name in BUDGETS}, "both": tuple(BUDGETS)}
    if budget not in allowed:
        raise ConfigError(f"unknown budget {budget!r}: {nearest_name(budget, [*allowed])}")
    return allowed[budget]


def _check_seeds(seeds: int) -> None:
    if seeds < 1:
        raise ConfigError(f"--seeds {seeds}: it must be 1 or more; 3 gives a mean and a spread")


def _write(
    folder: Path, preset: Preset, budget: str, results: pd.DataFrame, cells_2: pd.DataFrame
) -> None:
    cells_1 = average_over_seeds(results)
    notes = _notes(preset, budget)
    paths = write_tables(folder, cells_1, cells_2, notes, default_pixels(preset))
    paths += write_comparisons(folder, cells_1, cells_2)
    paths.append(_write_cells(folder / "table_1_cells.csv", results))
    where = f", on {notes.device}" if budget == "clock" else ""
    print(f"Table I: ATE (m), {BUDGETS[budget]}{where}")
    print(error_texts(table_1(cells_1), deviations_1(cells_1)).to_string())
    print("Table I beside the paper's")
    print(beside_published(cells_1).to_string(float_format="%.3f", na_rep="–"))
    print(f"Table II: steps, on {notes.device}, {torch.get_num_threads()} threads")
    print(step_texts(table_2(cells_2), deviations_2(cells_2)).to_string())
    print("\n".join(str(path) for path in paths))


def _folder(preset: Preset, kind: str, budgets: tuple[str, ...], out: Path | None) -> Path:
    """Where the tables of one kind of budget go."""
    name = preset.name if kind == "steps" else f"{preset.name}_clock"
    return out / name if out and len(budgets) > 1 else out or PAPER_TABLES / name


def _notes(preset: Preset, budget: str) -> TableNotes:
    # Which scenes there are the columns tell.
    changed = [text for text in changed_settings(preset) if not text.startswith("scenes.names")]
    return TableNotes(preset.name, BUDGETS[budget], device_name(choose_device()), tuple(changed))


def _write_cells(path: Path, results: pd.DataFrame) -> Path:
    told = results[[name for name in _CELL_COLUMNS if name in results]]
    write_text_atomic(path, told.to_csv(index=False, lineterminator="\n"))
    return path


def _raise_failures(all_results: Sequence[pd.DataFrame]) -> None:
    failures = [
        failure
        for results in all_results
        for failure in results.loc[results["failure"] != "", ["run", "failure"]].values.tolist()
    ]
    if failures:
        run, reason = failures[0]
        raise NbtrackError(
            f"{len(failures)} cells of the table failed and are empty, the first of them {run}: "
            f"{reason}; mend the cause and run the same command again, the rest is kept"
        )


def _tell(text: str) -> None:
    """To standard error: it is news, not a result."""
    tqdm.write(text, file=sys.stderr)
