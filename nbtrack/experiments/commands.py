"""What each command does and prints."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from nbtrack.core.config import Preset
from nbtrack.core.device import choose_device
from nbtrack.core.errors import ConfigError, DataError
from nbtrack.data.sequence import RgbdSequence, parse_frames
from nbtrack.experiments.cells import (
    GivenMap,
    MapCell,
    TrackCell,
    cell_lock,
    check_pair,
    make_budget,
)
from nbtrack.experiments.export import MESH_FILE, export
from nbtrack.experiments.parallel import Execution, Job, Report, run_jobs
from nbtrack.experiments.results import map_summary, obtain_map, run_track
from nbtrack.experiments.scenes import Scene, find_scene
from nbtrack.fields import field_class
from nbtrack.mapping.files import StoredMap, read_map
from nbtrack.mapping.meshes import extract_mesh, keep_seen, write_mesh
from nbtrack.tracking.trackers import tracker_class


def map_command(
    sequence: str,
    field_name: str,
    preset: Preset,
    frames: str,
    seed: int,
    out: Path | None,
    format: str | None = None,
) -> None:
    """Map a sequence, or resume; print the map's scores and where it and its mesh lie."""
    field_class(field_name)
    parse_frames(frames)
    cell = MapCell(_scene(sequence, preset, format), field_name, preset, frames, seed, out)
    _map_with_bar(cell)
    summary = map_summary(cell)
    print(f"{cell.folder}: {field_class(field_name).label} map of {cell.scene.name}")
    print(f"  mapped in {summary['seconds']:.0f} s on {summary['device']}")
    for name, value in summary["quality"].items():
        if value is not None:
            print(f"  {_with_unit(name, value)}")
    try:
        mesh = keep_seen(extract_mesh(obtain_map(cell).field), _every_tenth(cell))
    except DataError as error:
        print(f"  no mesh: {error}")
    else:
        write_mesh(cell.folder / MESH_FILE, mesh)
        print(f"  mesh of what was seen: {cell.folder / MESH_FILE}")


def track_command(
    sequence: str,
    field_name: str | None,
    tracker_name: str,
    preset: Preset,
    steps: float | None,
    rate_hz: float | None,
    map_frames: str | None,
    frames: str,
    seed: int,
    out: Path | None,
    format: str | None = None,
    map_from: Path | None = None,
) -> None:
    """Track a sequence in its map, made first where none fits, or in a given one; print the errors.

    Args:
        field_name: the map's field; None to take a given map as it is.
        map_from: folder or file of a map made earlier, which then stands for the sequence's own.
    """
    tracker = tracker_class(tracker_name)
    stored = None if map_from is None else _given_map(map_from, field_name, map_frames)
    field_name = field_name if stored is None else stored.field.name
    check_pair(tracker_name, field_name, preset.tracking_of(tracker_name).bake_voxel)
    parse_frames(frames)
    map_frames = map_frames or ":"
    parse_frames(map_frames)
    budget = make_budget(steps, rate_hz)  # a wrong one is told before a room is made
    scene = _scene(sequence, preset, format)
    n_frames = len(scene.frame_numbers(frames))
    scene.frame_numbers(map_frames)
    if stored is None:
        map_cell = MapCell(scene, field_name, preset, map_frames, seed)
    else:
        network = {**preset.network, field_name: stored.network}
        map_cell = GivenMap(scene, replace(preset, network=network), stored)
    cell = TrackCell(map_cell, tracker_name, steps, rate_hz, frames, seed)
    device = choose_device()
    if stored is None:
        _map_with_bar(map_cell)
    folder = out or cell.folder
    job = Job(cell.name, n_frames - 1, _track_job, (cell, folder, device))
    (tracked,) = run_jobs([job], "tracking", Execution(workers=1))
    print(f"{folder}: {tracker.label}, {budget}")
    _print_metrics(tracked)


def _print_metrics(tracked: dict[str, Any]) -> None:
    for name in _PRINTED:
        print(f"  {_with_unit(name, tracked[name])}")
    if tracked["frames_without_depth"]:
        print(f"  frames without any depth, not searched: {tracked['frames_without_depth']}")
    print(f"  on {tracked['device']}")
    if tracked.get("map_warning"):
        print(f"nbtrack: warning: {tracked['map_warning']}", file=sys.stderr)


def export_command(source: Path, format_name: str, out: Path) -> None:
    """Write a run's trajectory or a map in another format; print what was written."""
    print(f"{out}: {export(source, format_name, out)}")


_PRINTED = (
    "ate_rmse_m", "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "frames",
    "lost_frames", "steps_per_frame", "seconds_per_step", "seconds_per_frame", "map_seconds",
)  # fmt: skip
_UNITS = {"_m": ("m", 4), "_deg": ("degrees", 3), "_db": ("dB", 1), "_seconds": ("s", 0)}


def _with_unit(name: str, value: float | int) -> str:
    for suffix, (unit, digits) in _UNITS.items():
        if name.endswith(suffix):
            return f"{name.removesuffix(suffix).replace('_', ' ')}: {value:.{digits}f} {unit}"
    return f"{name.replace('_', ' ')}: {value:.4g}"


def _scene(sequence: str, preset: Preset, format: str | None = None) -> Scene:
    """The scene, with a bar while a room has to be made."""
    config = preset.scenes
    with tqdm(total=config.n_frames, desc="room", unit="frame", delay=1.0, leave=False) as bar:
        # Small rooms are made sooner than processes start.
        workers = (os.cpu_count() or 1) if config.width >= 320 else 1
        return find_scene(
            sequence, config, lambda done, total: bar.update(done - bar.n), workers, format
        )


def _given_map(path: Path, field_name: str | None, map_frames: str | None) -> StoredMap:
    """The map at a path. Raises ConfigError if it is not what else was asked for."""
    if map_frames is not None:
        raise ConfigError("--map-from names a map that is made: leave --map-frames out")
    stored = read_map(path)
    found = stored.field.name
    if field_name is not None and not issubclass(field_class(found), field_class(field_name)):
        raise ConfigError(f"{path} is a map of field {found!r}, not {field_name!r}: leave it out")
    return stored


def _every_tenth(cell: MapCell) -> RgbdSequence:
    """Some frames of a map, enough to say what has been seen: neighbours see the same."""
    numbers = cell.scene.frame_numbers(cell.frames)
    return cell.scene.read(slice(numbers.start, numbers.stop, 10 * numbers.step))


def _map_with_bar(cell: MapCell) -> None:
    if cell.is_done:
        tqdm.write(f"map found in {cell.folder}")
        return
    tqdm.write(f"no finished map in {cell.folder}: mapping")
    total = cell.preset.mapping_of(cell.field_name).iterations
    run_jobs([Job(cell.scene.name, total, _map_job, (cell,))], "mapping", Execution(workers=1))


def _map_job(cell: MapCell, report: Report) -> None:
    obtain_map(cell, report=report)


def _track_job(cell: TrackCell, folder: Path, device: torch.device, report: Report) -> dict:
    # `tables` may be at the same cell.
    with cell_lock(cell.folder, lambda status: report(0, status)):
        return run_track(cell, folder, device, report)
