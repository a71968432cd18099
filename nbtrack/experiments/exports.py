"""Export runs and maps in other forms: pictures, movies, meshes, lists of poses."""

from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from nbtrack.beyond.points import PointCloud
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments import runs
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.machinery.errors import ConfigError, DataError, look_up
from nbtrack.machinery.files import naming_damaged, write_atomic
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.registry import from_extra
from nbtrack.mapping.files import MESH_FILE, Map, read_map
from nbtrack.plots import cloud_of, movie_bytes, movie_pictures, plot_overview
from nbtrack.plots.meshes import extract_mesh, mesh_bytes
from nbtrack.plots.movie import rerun_bytes
from nbtrack.recordings import reading
from nbtrack.recordings.pose_files import number_lines, read_tum, shifted
from nbtrack.recordings.recording import Recording
from nbtrack.tracking import Trajectory

_FRAMES_SHOWN = 20  # an overview shows what 20 to 39 evenly spaced frames saw, or all of fewer
_CELLS = 120  # of an overview's mesh, along two map units
_MOVIE_FRAMES = 100  # at most so many, evenly spread over a run


def draw_overview(run: TrackJob) -> None:
    """Draw a finished run into its folder: the camera's path in the part of the map that it saw.

    Prints why if there is no picture.
    """
    tracked = runs.read_trajectory(run.folder)
    field, metrics, n_frames = run.needs.map().field, tracked.metrics, len(tracked.frames)
    shown = np.arange(0, n_frames, max(1, n_frames // _FRAMES_SHOWN))
    try:
        surface = _surface(field, _seen(tracked, shown, run.scene.recording), _CELLS)
    except DataError as error:
        print(f"  no picture: {error}")
        return
    title = f"{run.scene.name}: {run.tracker} in {field.label}, {n_frames} frames"
    origin = np.array(metrics["origin"])
    surface.apply_translation(origin)  # pictures, as files, are in the recording's world
    paths = {}
    if "ate_rmse_m" in metrics:
        title += f", ATE {100 * metrics['ate_rmse_m']:.2f} cm"
        if "still_ate_m" in metrics:  # it needs two true poses
            title += f" (standing still {100 * metrics['still_ate_m']:.0f} cm)"
        is_known = np.isfinite(tracked.T_true).all(axis=(1, 2))
        paths["true"] = shifted(tracked.T_true[is_known], origin)
    paths["tracked"] = shifted(tracked.T_estimated, origin)
    figure = plot_overview(cloud_of(surface), paths, tracked.frames, title)
    runs.save_picture(figure, run.folder / runs.OVERVIEW_FILE, dpi=120)  # 1080 pixels wide


def _seen(tracked: Trajectory, rows: np.ndarray, recording: Recording) -> RgbdSequence:
    """The frames of some rows of a run, as a sequence with the estimated poses."""
    frame_ids = tracked.frames["frame_id"].to_numpy()[rows]
    sequence = reading.read_frames(recording, frame_ids, needs_poses=False)
    return replace(sequence, T_world_camera=tracked.T_estimated[rows])


def _surface(field: Any, seen: RgbdSequence, n_cells: int) -> Any:
    """A mesh of the part of a map that some frames saw.

    Two units of the map, or 6 m if that is more, have `n_cells` cells; 6 m have `_CELLS` of 5 cm.
    Two units are the map's longest side, unless its unit is declared.
    """
    return extract_mesh(field, seen, voxel=max(6.0, 2 * field.bounds.metres_per_unit) / n_cells)


def export_command(options: Namespace) -> None:
    """Write a run or a map in the format that --to names, and print what was written."""
    export = look_up("format", options.to, _EXPORTS)
    runs.check_no_recording(options.out)
    if options.out.exists():
        raise ConfigError(f"{options.out} exists: choose another file to write, or remove it first")
    content, summary = export(options.source, options.to)
    write_atomic(options.out, content)
    print(f"{options.out}: {summary}")


def _export_map(source: Path, format_name: str) -> tuple[bytes, str]:
    """The file of a coloured mesh of a map, or of the map of a run; and a summary.

    The mesh is the one beside the map, which shows what was seen, if it is there; else it shows all
    of the map.
    """
    if (source / runs.METRICS_FILE).is_file():
        finished, source = _map_of(runs.read_trajectory(source))
    else:
        finished = read_map(source)
    mesh_file = source / MESH_FILE
    # The file of a map of points has no faces, and `load_mesh` finds nothing in it.
    has_mesh = mesh_file.is_file() and not isinstance(finished.field, PointCloud)
    origin = np.array(finished.record["origin"])
    with naming_damaged(mesh_file, "mesh", "remove it and map again"):
        if has_mesh:
            mesh = trimesh.load_mesh(mesh_file, process=False)
            mesh.vertices -= origin  # `mesh_bytes` adds the origin to a mesh in the map's world
        else:
            mesh = extract_mesh(finished.field)
        content = mesh_bytes(mesh, format_name, origin, finished.record.get("up"))
    part = "what was seen" if has_mesh else "all"
    return content, f"{len(mesh.vertices)} coloured vertices of {part}"


def _map_of(tracked: Trajectory) -> tuple[Map, Path]:
    """The map of a run, and its path. Raises DataError if another map lies there by now."""
    path = Path(tracked.metrics["map"])
    stored = read_map(path)
    if tracked.metrics.get("map_key") != stored.key:
        raise DataError(f"{path} is not the map of this run any more: track again")
    return stored, path


def _export_run(source: Path, format_name: str) -> tuple[bytes, str]:
    """The file of a run as a movie or for Rerun; and a summary.

    The recording and the map must lie where they lay when the run was made.
    """
    if format_name == "rrd":  # before any work
        from_extra("rerun", "rerun")
    tracked = runs.read_trajectory(source)
    metrics, n_frames = tracked.metrics, len(tracked.frames)
    stored, _ = _map_of(tracked)
    shown = np.unique(np.linspace(0, n_frames - 1, _MOVIE_FRAMES).round().astype(int))
    scene = Scene(metrics["scene"], Path(metrics["recording"]), metrics["format"])
    if scene.fingerprint != metrics["recording_key"]:
        raise DataError(f"{scene.folder} is not the recording of this run any more: track again")
    seen = _seen(tracked, shown, scene.recording)
    surface = _surface(stored.field, seen, 2 * _CELLS)  # with cells half as large as an overview's
    title = f"{metrics['scene']}: {metrics['tracker']} in {stored.field.label}"
    if format_name == "rrd":
        content = rerun_bytes(surface, seen, tracked, title)
    else:
        origin = np.array(metrics["origin"])
        surface.apply_translation(origin)
        seen = replace(seen, T_world_camera=shifted(seen.T_world_camera, origin))
        with ProgressBar(f"movie of {metrics['scene']}", len(shown)) as bar:
            frames, poses = tracked.frames.iloc[shown], seen.T_world_camera
            content = movie_bytes(movie_pictures(surface, seen, frames, poses, title, bar.move_to))
    return content, f"{len(shown)} of {n_frames} frames, {len(content) / 1e6:.1f} MB"


def _export_trajectory(source: Path, format_name: str) -> tuple[str, str]:
    """The tracked poses of a run in KITTI's format, in the recording's world; and a summary.

    A line holds the upper three rows of a pose's matrix. As in `trajectory.txt`, a first pose that
    was given is left out. `format_name` is not used: this is the only format of trajectories.
    """
    runs.read_trajectory(source)  # raises if there is no run; its poses are in the map's world
    _, T_world_camera = read_tum(source / "trajectory.txt")  # m
    n_poses = len(T_world_camera)
    summary = f"{n_poses} poses, without a first one that was given, as three rows of numbers (m)"
    return number_lines(T_world_camera[:, :3].reshape(-1, 12)), summary


_EXPORTS = {"kitti": _export_trajectory, "ply": _export_map, "glb": _export_map}
_EXPORTS |= {"gif": _export_run, "rrd": _export_run}
