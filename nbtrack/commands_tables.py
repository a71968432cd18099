"""The `tables` command: fill the grid, write both tables, or tell where a number comes from."""

import sys
from pathlib import Path

import pandas as pd
import torch
from tqdm import tqdm

from nbtrack.bench import default_pixels, obtain_steps
from nbtrack.comparison import beside_published, write_comparisons
from nbtrack.config import Preset
from nbtrack.device import choose_device, device_name
from nbtrack.errors import ConfigError, NbtrackError, nearest_name
from nbtrack.explain import explain_run, find_cells
from nbtrack.grid import BUDGETS, plan_table_1, prepare_scenes, table_1_results
from nbtrack.latex import TableNotes, write_tables
from nbtrack.parallel import Execution
from nbtrack.paths import PAPER_TABLES
from nbtrack.settings import changed_settings
from nbtrack.storage import write_text_atomic
from nbtrack.tables import (
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
        kind: table_1_results(
            plan_table_1(preset, scenes, kind, seeds, trackers), _tell, execution
        )
        for kind in budgets
    }
    cells_2 = obtain_steps(preset, scenes[0].read(slice(0, 1)), choose_device(), measure_again)
    failures = []
    for kind, results in results_of.items():
        name = preset.name if kind == "steps" else f"{preset.name}_clock"
        folder = out / name if out and len(budgets) > 1 else out or PAPER_TABLES / name
        _write(folder, preset, kind, results, cells_2)
        failures += results.loc[results["failure"] != "", ["run", "failure"]].values.tolist()
    if failures:
        run, reason = failures[0]
        raise NbtrackError(
            f"{len(failures)} cells of Table I failed and are empty, the first of them {run}: "
            f"{reason}; mend the cause and run the same command again, the rest is kept"
        )


def explain_command(
    preset: Preset, budget: str, seeds: int, trackers: tuple[str, ...], row: str, column: str
) -> None:
    """Print where one cell of Table I comes from, and the command that makes it again."""
    (kind,) = _budgets(budget) if budget != "both" else ("steps",)
    _check_seeds(seeds)
    cells = plan_table_1(preset, prepare_scenes(preset, _tell, make=False), kind, seeds, trackers)
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
    device = device_name(choose_device())
    # Which scenes there are the columns tell.
    changed = [text for text in changed_settings(preset) if not text.startswith("scenes.names")]
    notes = TableNotes(preset.name, BUDGETS[budget], device, tuple(changed))
    paths = write_tables(folder, cells_1, cells_2, notes, default_pixels(preset))
    paths += write_comparisons(folder, cells_1, cells_2)
    paths.append(folder / "table_1_cells.csv")
    told = results[[name for name in _CELL_COLUMNS if name in results]]
    write_text_atomic(paths[-1], told.to_csv(index=False, lineterminator="\n"))
    where = f", on {device}" if budget == "clock" else ""
    print(f"Table I: ATE (m), {BUDGETS[budget]}{where}")
    print(error_texts(table_1(cells_1), deviations_1(cells_1)).to_string())
    print("Table I beside the paper's")
    print(beside_published(cells_1).to_string(float_format="%.3f", na_rep="–"))
    print(f"Table II: steps, on {device}, {torch.get_num_threads()} threads")
    print(step_texts(table_2(cells_2), deviations_2(cells_2)).to_string())
    print("\n".join(str(path) for path in paths))


def _tell(text: str) -> None:
    """To standard error: it is news, not a result."""
    tqdm.write(text, file=sys.stderr)
