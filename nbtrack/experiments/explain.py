"""Where a number of Table I comes from, and the command that makes it again."""

import re
import shlex
from collections.abc import Sequence

from nbtrack.core.config import Preset
from nbtrack.core.errors import ConfigError, MissingError, nearest_name
from nbtrack.core.settings import changed_settings
from nbtrack.experiments.cells import TrackCell
from nbtrack.experiments.grid import TableCell
from nbtrack.experiments.scenes import DATASET_SCENES
from nbtrack.synthetic import ROOMS
from nbtrack.tables.layout import PAPER_SCENE_LABELS

# Where a single run gets these from its own options.
_NOT_PASSED_ON = ("scenes.names", "scenes.track_frames", "tables.")


def find_cells(cells: Sequence[TableCell], row: str, column: str) -> list[TableCell]:
    """The runs behind one cell of Table I, one a seed.

    Args:
        row: rate and method, as "10 sdf" or "10 Hz NeuS with SDF".
        column: a scene, by its folder's name or the paper's label.

    Raises:
        ConfigError: the table has no such row or column.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:hz)?[\s,/:]*(.*?)\s*", row, re.IGNORECASE)
    rate_hz, method = (float(match[1]), match[2].casefold()) if match else (None, "")
    scene = column.casefold()
    found = [
        cell
        for cell in cells
        if cell.rate_hz == rate_hz
        and method in (cell.method.casefold(), cell.run.tracker_name.casefold())
    ]
    if not found:
        rows = dict.fromkeys(f"{cell.rate_hz:g} {cell.run.tracker_name}" for cell in cells)
        raise ConfigError(f"no row {row!r} in the table: {nearest_name(row, [*rows])}")
    here = [cell for cell in found if scene in _names_of(cell.run.scene_name)]
    if not here:
        columns = dict.fromkeys(cell.run.scene_name for cell in cells)
        raise ConfigError(f"no column {column!r} in the table: {nearest_name(column, [*columns])}")
    return here


def explain_run(run: TrackCell) -> str:
    """Result, settings, seeds, device, versions and files of a finished run, and its command.

    Raises:
        MissingError: the run has not been made yet.
    """
    if not run.is_done:
        raise MissingError(
            f"{run.name} has not been computed with these settings: run the tables command with "
            "the same options, without --explain, first"
        )
    metrics = run.metrics()
    preset = run.map_cell.preset
    lines = {
        "ate_rmse_m": repr(metrics["ate_rmse_m"]),
        "method": f"field {metrics['field']}, tracker {metrics['tracker']}",
        "budget": metrics["budget"],
        "frames": f"{run.frames} ({metrics['frames']} tracked, {metrics['lost_frames']} lost)",
        "seed": f"{run.map_cell.seed} of the map, {run.seed} of the tracking",
        "device": f"{metrics['device']}, {metrics['threads']} threads",
        "versions": ", ".join(f"{k} {v}" for k, v in metrics["versions"].items()),
        "preset": " ".join([preset.name, *_settings(preset)]),
        "key": metrics["key"],
        "trajectory": str(run.folder / "trajectory.txt"),
        "map": str(run.map_cell.folder),
        "again": command_of(run),
    }
    width = max(map(len, lines))
    body = [f"  {name:<{width}}  {value}" for name, value in lines.items()]
    return "\n".join([run.name, *body])


def command_of(run: TrackCell) -> str:
    """The command that makes a run anew, its map too where that is not cached.

    It writes to a folder of its own; `ate_rmse_m` in the `metrics.json` there is the number.
    """
    preset = run.map_cell.preset
    by_clock = run.rate_hz is not None
    words = [
        "python", "-m", "nbtrack", "track", _name_or_folder(run),
        "--field", run.map_cell.field_name, "--tracker", run.tracker_name,
        *(["--rate", repr(run.rate_hz)] if by_clock else ["--steps", repr(run.steps)]),
        "--map-frames", run.map_cell.frames, "--frames", run.frames, "--seed", str(run.seed),
        "--device", run.metrics()["device_type"], "--threads", str(run.metrics()["threads"]),
        "--preset", preset.name,
    ]  # fmt: skip
    for setting in _settings(preset):
        words += ["--set", setting]
    return shlex.join([*words, "--out", f"again_{run.name}"])


def _name_or_folder(run: TrackCell) -> str:
    scene = run.map_cell.scene
    return scene.name if scene.name in (*ROOMS, *DATASET_SCENES) else str(scene.folder)


def _settings(preset: Preset) -> list[str]:
    return [text for text in changed_settings(preset) if not text.startswith(_NOT_PASSED_ON)]


def _names_of(scene: str) -> tuple[str, ...]:
    return scene.casefold(), PAPER_SCENE_LABELS.get(scene, scene).casefold()
