"""The functions that commands call; those of `tables` and `bench` are in `bench.py`, that of
`export` in `exports.py`."""

from argparse import Namespace
from collections.abc import Iterator
from typing import Any

import numpy as np

from nbtrack.checks.check import check_recording, quick_look
from nbtrack.experiments import runs
from nbtrack.experiments.exports import draw_overview
from nbtrack.experiments.jobs import run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.methods import DEFAULT_METHOD, TABLE_1, method_of
from nbtrack.experiments.presets import SIZES, Preset, ScenesConfig, load_preset
from nbtrack.experiments.scenes import Scene, open_scene, write_room
from nbtrack.experiments.track_jobs import TrackJob, reach_warnings
from nbtrack.machinery.errors import ConfigError, DataError
from nbtrack.machinery.files import absolute, data_folder, write_atomic
from nbtrack.machinery.progress import tell
from nbtrack.machinery.registry import command_line
from nbtrack.machinery.settings import flat, with_values
from nbtrack.mapping.files import MESH_FILE, Map
from nbtrack.plots import plot_overview
from nbtrack.plots.meshes import extract_mesh, mesh_bytes
from nbtrack.recordings import reading
from nbtrack.recordings.fetch import fetch_scene
from nbtrack.recordings.recording import open_recording
from nbtrack.recordings.writer import convert_sequence
from nbtrack.tracking import make_budget
from nbtrack.tracking.methods import METHODS
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

_FRAMES_APART = 10  # a mesh shows what every tenth frame saw: frames in between see the same
_ERRORS = "ate_rmse_m", "max_error_m", "still_ate_m"  # the metrics in a run's summary


def methods_command(options: Namespace) -> None:
    """Print every method that --method takes, grouped by tracker."""
    notes = dict.fromkeys(TABLE_1, " (the paper's)") | {DEFAULT_METHOD: " (default)"}
    for tracker in dict.fromkeys(method.tracker for method in METHODS.values()):
        print(f"tracker {tracker}")
        for name, method in METHODS.items():
            if method.tracker == tracker:
                print(f"  {name:<20}{method.label}{notes.get(name, '')}")


def map_command(options: Namespace) -> None:
    """Map a sequence, or resume a killed mapping; print the scores and where the files are."""
    method = method_of(options.method, options.field, tracker=None)
    preset = load_preset(options.preset, options.config, options.settings, method.settings)
    scene = _opened(options, preset)
    scene.select(options.frames)  # raises for a wrong slice, before anything is written
    job = MapJob.of(scene, method.field, preset, options.frames, options.seed)
    runs.prepare(options.out)
    _make_map(job)
    finished = job.map()
    _write_mesh(job, finished)
    folder = runs.deliver(job.folder, runs.FILES_OF_MAP, options.out)
    print(f"{folder}: {finished.field.label} map of {scene.name}")
    print(f"  mapped in {finished.record['seconds']:.0f} s on {finished.record['device']}")
    for name, value in finished.record["quality"].items():
        if isinstance(value, int | float):
            print(f"  {name}: {value:.5g}")
    if (folder / MESH_FILE).is_file():
        print(f"  mesh of what was seen: {folder / MESH_FILE}")


def _write_mesh(job: MapJob, finished: Map) -> None:
    """Write a mesh of what the mapped frames saw beside the map, or print why there is none."""
    try:
        numbers = job.scene.select(job.frames)[::_FRAMES_APART]
        seen = reading.without_outliers(reading.read_frames(job.scene.recording, numbers))
        mesh = extract_mesh(finished.field, seen)
    except DataError as error:
        print(f"  no mesh: {error}")
        return
    origin = np.array(finished.record["origin"])
    write_atomic(job.folder / MESH_FILE, mesh_bytes(mesh, "ply", origin))


def track_command(options: Namespace) -> None:
    """Track a sequence in a map that is given, or in its own, which is made if it is missing."""
    run = _asked_run(options)
    for warning in reach_warnings([run]):
        tell(f"nbtrack: warning: {warning}")
    runs.prepare(options.out)
    if not run.needs.given:
        _make_map(run.needs)
    # A finished run is made again: its metrics hold the paths of the recording and of the map, and
    # the seconds that it took. All of them may be others now.
    (run.folder / runs.METRICS_FILE).unlink(missing_ok=True)
    (metrics,) = run_jobs([run])
    draw_overview(run)
    folder = runs.deliver(run.folder, runs.FILES_OF_RUN, options.out)
    label = run.needs.map().field.label
    print(f"{run.scene.name}: {run.tracker} in {label}, {metrics['frames']} frames")
    for line in _summary(metrics):
        print(f"  {line}")
    print(f"  files  {folder}: trajectory.txt (TUM), overview.png, metrics.json with all numbers")
    command = command_line("export", str(absolute(folder)), "--to", "gif", "tracking.gif")
    print(f"  next   {command}")
    _warn(metrics)


def _asked_run(options: Namespace) -> TrackJob:
    """The run that the options of `track` ask for. A synthetic room that is missing is made.

    Raises ConfigError, DataError or MissingError, before a map is made, if the run cannot begin.
    """
    given, field = None, options.field
    if options.map_from:
        given = MapJob.of_given(options.map_from)
        if not options.method:  # a method names a field
            field = field or given.field
    method = method_of(options.method, field, options.tracker)
    preset = load_preset(options.preset, options.config, options.settings, method.settings)
    if given:
        _check_fits(given, method.field, preset, options)
    steps = options.steps
    if steps is None and options.rate is None:
        steps = method.usual_steps
    make_budget(steps, options.rate)  # raises for a wrong one, before a room is made
    scene = _opened(options, preset)
    job = given or MapJob.of(scene, method.field, preset, options.map_frames or ":", options.seed)
    if not given:
        scene.select(job.frames)  # raises for a wrong slice
    run = TrackJob(
        job, scene, method.tracker, preset.tracking_of(method.tracker), steps, options.rate,
        options.frames, options.seed, options.start,
    )  # fmt: skip
    run.check()
    return run


def _summary(metrics: dict[str, Any]) -> Iterator[str]:
    """Lines that tell the user how a run went: errors, lost frames, work."""
    n_frames, n_unknown = metrics["frames"], metrics["frames_without_reference"]
    ate, largest, still = (f"{1e3 * metrics.get(name, np.nan):.1f} mm" for name in _ERRORS)
    if "ate_rmse_m" in metrics:
        yield f"error  {ate} (ATE), at most {largest}; of a camera that stands still {still}"
        share = metrics["lost_frames"] / (n_frames - n_unknown)
        yield f"lost   {share:.1%} of the frames, off by more than {LOST_THRESHOLD_M:g} m"
    else:
        yield "error  no true pose is known of the tracked frames: errors cannot be computed"
    if "flagged_frames" in metrics:
        flagged = metrics["flagged_frames"] / n_frames
        yield f"       {flagged:.1%} of the frames lost, as the tracker itself says"
    if n_unknown:
        yield f"       {n_unknown / n_frames:.1%} of the frames without a true pose, in no error"
    if n_empty := metrics["frames_without_depth"]:
        yield f"       {n_empty / n_frames:.1%} of the frames without any depth, not searched"
    work = f"{metrics['steps_per_frame']:.1f} steps and {1e3 * metrics['seconds_per_frame']:.0f} ms"
    yield f"work   {work} a frame (budget: {metrics['budget']}) on {metrics['device']}"


def _warn(metrics: dict[str, Any]) -> None:
    """Print warnings if the errors of a run cannot be trusted."""
    if metrics["map_warning"]:
        tell(f"nbtrack: warning: {metrics['map_warning']}")
    outside = metrics.get("outside_map_share", 0.0)
    if outside > 0:
        tell(f"nbtrack: warning: {outside:.1%} of the frames saw little of what was mapped")


def _opened(options: Namespace, preset: Preset) -> Scene:
    """The scene that the command names; prints a line if its numbers are likely read wrongly."""
    scene = open_scene(options.sequence, preset, options.format)
    doubt = "" if scene.made else quick_look(scene.recording)  # rooms are always read rightly
    if doubt:
        tell(f"nbtrack: {doubt}; `data check` tells more")
    return scene


def _check_fits(given: MapJob, field: str, preset: Preset, options: Namespace) -> None:
    """Check that a given map was made as the command asks, before anything is tracked in it.

    Raises ConfigError for `--map-frames`, for a map of another field, and for a map that was made
    with another value of a setting that the user has chosen. With `--method` it also raises it if
    the map is not corrected as the method asks.
    """
    if options.map_frames:
        raise ConfigError("--map-from names a map that is made: leave --map-frames out")
    if field != given.field:
        found = f"{options.map_from} is a map of field {given.field!r}, not {field!r}"
        raise ConfigError(f"{found}: leave --method and --field out")
    of_map, wanted = flat(given.setting_tree), flat(preset.settings)
    asked_keys = {*preset.chosen}  # by --set, --config or NBTRACK_SET
    if options.method:  # it says whether the map is corrected, and in cells of which size
        asked_keys.add(f"correction.{field}")
    for key in sorted(asked_keys & of_map.keys()):  # a map has no settings of a tracker
        if of_map[key] != wanted[key]:
            found = f"{options.map_from} was made with {key}={of_map[key]}, not {wanted[key]}"
            advice = "leave that setting (--set, --config, NBTRACK_SET) or --method out"
            raise ConfigError(f"{found} as asked: {advice}, or map anew")


def _make_map(job: MapJob) -> None:
    """Make a map if it is not in the cache, and print whether it is.

    Frames that have no pose are not mapped; a line says how many these are.
    """
    folder = job.folder
    print(f"map found in {folder}" if job.is_done else f"no finished map in {folder}: mapping")
    has_pose = job.scene.recording.has_pose[reading.parse_frames(job.frames)]
    if not has_pose.all():
        tell(f"nbtrack: {(~has_pose).sum()} of {len(has_pose)} frames have no pose: not mapped")
    run_jobs([job])


def make_command(options: Namespace) -> None:
    """Write a synthetic room as a sequence folder, and print what was written."""
    config = with_values(ScenesConfig(), {name: getattr(options, name) for name in SIZES})
    runs.check_no_recording(options.out)
    write_room(options.room, options.out, config)
    print(f"{options.out}: {options.room}, {options.n_frames} frames, seed {options.seed}")


def check_command(options: Namespace) -> int:
    """Check a recording; print what it holds and what is wrong, and draw it into --out.

    Returns the exit status: 1 if something is wrong, else 0.
    """
    runs.prepare(options.out)
    recording = open_recording(options.folder, options.format, options.depth_folder, options.poses)
    report = check_recording(recording)
    if options.out:
        title = f"{recording.name} as it is read: points of its depth, and its path"
        figure = plot_overview(report.cloud, {"true": report.T_world_camera}, None, title)
        runs.save_picture(figure, options.out / runs.CHECK_FILE)
        print(f"picture: {options.out / runs.CHECK_FILE}")
    print(report)  # its verdict comes last
    return int(bool(report.faults))


def convert_command(options: Namespace) -> None:
    """Write a recording in the Neural RGB-D layout, and print what was written."""
    frames = reading.parse_frames(options.frames)
    runs.check_no_recording(options.out)
    recording = open_recording(options.folder, options.format, options.depth_folder, options.poses)
    print(convert_sequence(recording, options.out, frames))


def fetch_command(options: Namespace) -> None:
    """Download a scene of the dataset into the data folder, and print what was written."""
    print(fetch_scene(options.scene, data_folder() / options.scene, options.url))
    print(f"  next: nbtrack track {options.scene} --method sdf --rate 5 --preset paper")
