"""What each command does; `tables` and `bench` stand in `bench.py`."""

import importlib.util
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from nbtrack.beyond import PointCloud
from nbtrack.checks.check import check_recording, quick_warning
from nbtrack.data.sequence import RgbdSequence
from nbtrack.experiments import output
from nbtrack.experiments.jobs import run_jobs
from nbtrack.experiments.map_jobs import OF_MAPS, GivenMap, MapJob, setting_tree
from nbtrack.experiments.methods import DEFAULT_METHOD, method_of
from nbtrack.experiments.presets import SIZES, Preset, ScenesConfig, load_preset
from nbtrack.experiments.runs import MEANINGS, METRICS_FILE, read_trajectory
from nbtrack.experiments.scenes import Scene, open_scene, write_room
from nbtrack.experiments.track_jobs import TrackJob, reach_warnings
from nbtrack.machinery.errors import ConfigError, DataError, MissingError, look_up
from nbtrack.machinery.files import naming_damaged, write_atomic
from nbtrack.machinery.progress import ProgressBar, tell
from nbtrack.machinery.settings import flat, read_setting, with_values
from nbtrack.mapping.files import MESH_FILE, Map, read_map
from nbtrack.plots import cloud_of, movie_bytes, movie_pictures, plot_overview
from nbtrack.plots.meshes import extract_mesh, mesh_bytes
from nbtrack.plots.rerun_file import rerun_bytes
from nbtrack.recordings import reading
from nbtrack.recordings.recording import Recording, open_recording
from nbtrack.recordings.writer import convert_sequence
from nbtrack.tracking import Trajectory, make_budget
from nbtrack.tracking.methods import METHODS
from nbtrack.tracking.trajectories import number_lines, read_tum

_FRAMES_APART = 10  # every tenth frame tells what of a mesh was seen: neighbours see the same
_FRAMES_SHOWN = 20  # of a longer run at least so many frames tell what an overview shows
_CELLS = 120  # of an overview's mesh, along the longest side of its map
_MOVIE_FRAMES = 100  # at most, evenly spread over a run


def methods_command(options: Namespace) -> None:
    """List every method that --method takes."""
    for name, method in METHODS.items():
        print(f"  {name:<20}{method.label}{'  (default)' if name == DEFAULT_METHOD else ''}")


def map_command(options: Namespace) -> None:
    """Map a sequence, or resume; print the map's scores and where it and its mesh lie."""
    method = method_of(options.method, options.field, tracker=None)
    preset = load_preset(options.preset, options.config, options.settings, method.settings)
    scene = _opened(options, preset)
    scene.count(options.frames)  # raises for a wrong slice, before anything is written
    job = MapJob.of(scene, method.field, preset, options.frames, options.seed)
    output.prepare(options.out)
    _make_map(job)
    finished = job.map()
    _write_mesh(job, finished)
    folder = output.deliver(job.folder, output.FILES_OF_MAP, options.out)
    print(f"{folder}: {finished.field.label} map of {scene.name}")
    print(f"  mapped in {finished.record['seconds']:.0f} s on {finished.record['device']}")
    _print_numbers(finished.record["quality"])
    if (folder / MESH_FILE).is_file():
        print(f"  mesh of what was seen: {folder / MESH_FILE}")


def _write_mesh(job: MapJob, finished: Map) -> None:
    """Write the mesh of what was seen beside a finished map, or print why there is none."""
    try:
        recording = job.scene.recording
        mapped = reading.select_frames(recording, reading.parse_frames(job.frames))
        seen = reading.without_outliers(reading.read_frames(recording, mapped[::_FRAMES_APART]))
        mesh = extract_mesh(finished.field, seen)
    except DataError as error:
        print(f"  no mesh: {error}")
        return
    origin = np.array(finished.record["origin"])
    write_atomic(job.folder / MESH_FILE, mesh_bytes(mesh, "ply", origin))


def track_command(options: Namespace) -> None:
    """Track a sequence in its map, made first where none fits, or in a given one."""
    given = read_map(options.map_from) if options.map_from else None
    is_named = options.field or options.method
    field = given.field.name if given and not is_named else options.field
    method = method_of(options.method, field, options.tracker)
    preset = load_preset(options.preset, options.config, options.settings, method.settings)
    if given:
        _check_fits(given, method.field, options)
    has_budget = options.steps is not None or options.rate is not None
    steps = options.steps if has_budget else method.usual_steps
    budget = make_budget(steps, options.rate)  # raises for a wrong one, before a room is made
    scene = _opened(options, preset)
    if given:
        job = GivenMap(given, options.map_from)
    else:
        job = MapJob.of(scene, method.field, preset, options.map_frames or ":", options.seed)
        scene.count(job.frames)  # raises for a wrong slice
    run = TrackJob(
        job, scene, method.tracker, preset.tracking_of(method.tracker),
        steps=steps, rate_hz=options.rate, frames=options.frames, seed=options.seed,
        start=options.start,
    )  # fmt: skip
    run.check()
    for warning in reach_warnings([run]):
        tell(f"nbtrack: warning: {warning}")
    output.prepare(options.out)
    if not given:
        _make_map(job)
    # A finished run is made anew: recording and map may lie elsewhere now, and its times change.
    (run.folder / METRICS_FILE).unlink(missing_ok=True)
    (metrics,) = run_jobs([run])
    _draw_overview(run)
    folder = output.deliver(run.folder, output.FILES_OF_RUN, options.out)
    print(f"{folder}: {method.tracker} in {job.map().field.label}, {budget}")
    _print_run(metrics)


def _print_run(metrics: dict[str, Any]) -> None:
    """Print the errors of a finished run and its device; warn where they may not be trusted."""
    _print_numbers(metrics)
    if "ate_rmse_m" not in metrics:
        print("  no true pose is known of the tracked frames: errors cannot be computed")
    print(f"  on {metrics['device']}")
    outside = metrics.get("outside_map_share", 0.0)
    unseen = f"{outside:.0%} of the frames saw little of what was mapped" if outside > 0 else None
    for warning in filter(None, (metrics["map_warning"], unseen, metrics.get("map_misfit"))):
        tell(f"nbtrack: warning: {warning}")


def _opened(options: Namespace, preset: Preset) -> Scene:
    """The named scene. Warns where it is likely read wrongly, as a room made here never is."""
    scene = open_scene(options.sequence, preset, options.format)
    if not scene.made and (warning := quick_warning(scene.recording)):
        tell(f"nbtrack: warning: {warning}; `data check` tells more")
    return scene


def _check_fits(given: Map, field: str, options: Namespace) -> None:
    """Raises ConfigError where a given map contradicts the options: its frames, field, settings."""
    made, record = given.field.name, given.record
    if options.map_frames:
        raise ConfigError("--map-from names a map that is made: leave --map-frames out")
    if field != made:
        advice = "leave --method and --field out"
        raise ConfigError(f"{options.map_from} is a map of field {made!r}, not {field!r}: {advice}")
    voxel = record.get("correction", 0.0)  # m
    known = flat(setting_tree(made, record["network"], record["settings"], voxel))
    for text in options.settings:
        asked = read_setting(text)
        # Keys that no map has, as those of a tracker, are no contradiction.
        if any(known[key] != asked[key] for key in asked if key in known):
            advice = f"leave out what begins with {' or '.join(OF_MAPS)}, or map anew"
            what = f"{options.map_from} was made with other settings than --set {text}"
            raise ConfigError(f"{what}: {advice}")


def _make_map(job: MapJob) -> None:
    """Print whether the map is cached, and make it if not, without the frames that lack a pose."""
    folder = job.folder
    print(f"map found in {folder}" if job.is_done else f"no finished map in {folder}: mapping")
    has_pose = job.scene.recording.has_pose[reading.parse_frames(job.frames)]
    if not has_pose.all():
        tell(f"nbtrack: {(~has_pose).sum()} of {len(has_pose)} frames have no pose: not mapped")
    run_jobs([job])


def _print_numbers(results: dict[str, Any]) -> None:
    """Print the numbers among `results` by their `MEANINGS`; zeros only of lost frames."""
    for name, value in results.items():
        if isinstance(value, int | float) and (value or name in ("lost_frames", "flagged_frames")):
            print(f"  {MEANINGS.get(name, name)}: {value:.5g}")


def _draw_overview(run: TrackJob) -> None:
    """Draw a finished run beside its files: the path in what was seen of the map, from above."""
    tracked = read_trajectory(run.folder)
    field, metrics, n_frames = run.needs.map().field, tracked.metrics, len(tracked.frames)
    shown = np.arange(0, n_frames, max(1, n_frames // _FRAMES_SHOWN))
    try:
        surface = _surface(field, _seen(tracked, shown, run.scene.recording), _CELLS)
    except DataError as error:
        print(f"  no picture: {error}")
        return
    title = f"{run.scene.name}: {run.tracker} in {field.label}, {n_frames} frames"
    paths = {}
    if "ate_rmse_m" in metrics:
        ate_m, still_m = metrics["ate_rmse_m"], metrics.get("still_ate_m", np.nan)
        title += f", ATE {100 * ate_m:.2f} cm (standing still {100 * still_m:.0f} cm)"
        paths["true"] = tracked.T_true[np.isfinite(tracked.T_true).all(axis=(1, 2))]
    paths["tracked"] = tracked.T_estimated
    figure = plot_overview(cloud_of(surface), paths, tracked.frames, title)
    output.save_picture(figure, run.folder / output.OVERVIEW_FILE, dpi=120)  # 1080 pixels wide


def _seen(tracked: Trajectory, rows: np.ndarray, recording: Recording) -> RgbdSequence:
    """What was observed in some rows of a run, from where its camera was estimated to be."""
    frame_ids = tracked.frames["frame_id"].to_numpy()[rows]
    sequence = reading.read_frames(recording, frame_ids, needs_poses=False)
    return replace(sequence, T_world_camera=tracked.T_estimated[rows])


def _surface(field: Any, seen: RgbdSequence, n_cells: int) -> Any:
    """A mesh of what was seen of a map; `n_cells` span its longest side, or 6 m if that is less."""
    return extract_mesh(field, seen, voxel=max(6.0, 2 * field.bounds.metres_per_unit) / n_cells)


def export_command(options: Namespace) -> None:
    """Write a run or a map in another format, and print what was written."""
    export = look_up("format", options.to, _EXPORTS)
    output.check_no_recording(options.out)
    if options.out.exists():
        raise ConfigError(f"{options.out} exists: choose another file to write, or remove it first")
    content, summary = export(options.source, options.to)
    write_atomic(options.out, content)
    print(f"{options.out}: {summary}")


def _export_map(source: Path, format_name: str) -> tuple[bytes, str]:
    """A map as a coloured mesh: of what was seen where the map's folder has that mesh, else all."""
    finished = read_map(source)
    seen = source / MESH_FILE
    is_seen = seen.is_file() and not isinstance(finished.field, PointCloud)
    origin = np.array(finished.record["origin"])
    with naming_damaged(seen, "mesh", "remove it and map again"):
        mesh = trimesh.load_mesh(seen, process=False) if is_seen else extract_mesh(finished.field)
        if is_seen:  # its vertices are in the recording's world, and `mesh_bytes` moves them there
            mesh.vertices -= origin
        content = mesh_bytes(mesh, format_name, origin)
    what = "what was seen" if is_seen else "all"
    return content, f"{len(mesh.vertices)} coloured vertices of {what}"


def _export_run(source: Path, format_name: str) -> tuple[bytes, str]:
    """A run as a movie or for Rerun. Its recording and map must lie where they did in tracking."""
    if format_name == "rrd" and importlib.util.find_spec("rerun") is None:
        raise MissingError("--to rrd needs Rerun: pip install 'nbtrack[rerun]'")
    tracked = read_trajectory(source)
    metrics, n_frames = tracked.metrics, len(tracked.frames)
    stored = read_map(metrics["map"])
    if metrics.get("map_key") != stored.key:
        raise DataError(f"{metrics['map']} is not the map of this run any more: track again")
    shown = np.unique(np.linspace(0, n_frames - 1, _MOVIE_FRAMES).round().astype(int))
    seen = _seen(tracked, shown, open_recording(metrics["recording"], metrics["format"]))
    surface = _surface(stored.field, seen, 2 * _CELLS)  # cells half as large as in an overview
    title = f"{metrics['scene']}: {metrics['tracker']} in {stored.field.label}"
    if format_name == "rrd":
        content = rerun_bytes(surface, seen, tracked, title)
    else:
        with ProgressBar(f"movie of {metrics['scene']}", len(shown)) as bar:
            frames, poses = tracked.frames.iloc[shown], seen.T_world_camera
            content = movie_bytes(movie_pictures(surface, seen, frames, poses, title, bar.move_to))
    return content, f"{len(shown)} of {n_frames} frames, {len(content) / 1e6:.1f} MB"


def _export_trajectory(source: Path, format_name: str) -> tuple[str, str]:
    """The tracked poses of a run in KITTI's format, the only one of trajectories."""
    n_poses = len(read_trajectory(source).frames)  # raises for what is no run
    _, T_world_camera = read_tum(source / "trajectory.txt")  # m, in the recording's world
    what = "KITTI: three rows of the matrix (m), no time stamps"
    given = "the first frame's, which was given, is not among them"
    return number_lines(T_world_camera[:, :3].reshape(-1, 12)), f"{n_poses} poses, {what}; {given}"


_EXPORTS = {"kitti": _export_trajectory, "ply": _export_map, "glb": _export_map}
_EXPORTS |= {"gif": _export_run, "rrd": _export_run}


def make_command(options: Namespace) -> None:
    """Write a synthetic room as a sequence folder; ConfigError where none is named."""
    if options.out is None:
        raise ConfigError(f"--out is missing: name the folder that {options.room} is written to")
    config = with_values(ScenesConfig(), {name: getattr(options, name) for name in SIZES})
    output.check_no_recording(options.out)
    write_room(options.room, options.out, config)
    print(f"{options.out}: {options.room}, {options.n_frames} frames, seed {options.seed}")


def check_command(options: Namespace) -> None:
    """Validate a recording; print what it holds and what is wrong, and draw it into --out."""
    output.prepare(options.out)
    recording = open_recording(options.folder, options.format, options.depth_folder, options.poses)
    report = check_recording(recording)
    print(report)
    if options.out:
        apart_mm = 1e3 * report.conventions[0].median_m  # as the recording's files are declared
        title = f"{recording.name}: surfaces of two frames lie {apart_mm:.1f} mm apart (median)"
        figure = plot_overview(report.cloud, {"true": report.T_world_camera}, None, title)
        output.save_picture(figure, options.out / output.CHECK_FILE)
        print(f"  picture         {options.out / output.CHECK_FILE}")


def convert_command(options: Namespace) -> None:
    """Write a recording in the Neural RGB-D layout; print what became of it."""
    frames = reading.parse_frames(options.frames)
    output.check_no_recording(options.out)
    recording = open_recording(options.folder, options.format, options.depth_folder, options.poses)
    print(convert_sequence(recording, options.out, frames))
