"""The experiments behind notebooks 5, A1, A2, A3 and A6, each of which adds rows to a CSV.

    python benchmarks/evidence.py EXPERIMENT [SEEDS]

EXPERIMENT is a name in `GRIDS`. Rows are added to a CSV under paper_tables/ as they are finished,
the first seed first. Rows that are there are not made again, whatever has changed since: remove the
file to begin anew. Maps and runs are kept with all others (`NBTRACK_RUNS`), so that a killed
experiment resumes.

All cores are used, except by by_the_clock, beside which nothing else may run. full_size is for a
GPU. The paper's rooms have to lie below `NBTRACK_DATA` as the dataset has them (data/README.md).
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from motions import HAND_HELD, SPEEDS
from nine_rooms import SDF, VR, verdicts

from nbtrack import METHODS, Method, load_preset, map_scene, open_scenes, track_scenes
from nbtrack.experiments.bench import camera_motion, described
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import TABLE_1
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.machinery.device import choose_device, device_name
from nbtrack.machinery.files import tables_folder
from nbtrack.machinery.settings import with_settings
from nbtrack.recordings.recording import Recording, open_recording
from nbtrack.tables import write_csv, write_table_1

IN_GRIDS = "vr_grid", "sdf_grid"
_BY_CLOCK = {"rates_hz": [10], "clock": True}
KEPT = [
    "rate_hz", "method", "scene", "frames", "steps_per_frame", "path_m", "still_ate_m", "ate_m",
    "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "lost_frames", "metres_per_unit",
    "reach_m", "reach_deg", "beyond_reach_share", "greedy_ate_m",
]  # fmt: skip


@dataclass(frozen=True)
class OtherDepth(Scene):
    """One of the paper's rooms, read with another depth folder, or with a declared depth error."""

    depth_folder: str | None = None
    depth_error_per_m: float = 0.0

    @cached_property
    def recording(self) -> Recording:
        """The recording with that depth."""
        recording = open_recording(self.folder, self.format, self.depth_folder)
        declared = replace(recording.declared, depth_error_per_m=self.depth_error_per_m)
        return replace(recording, declared=declared)


@dataclass(frozen=True)
class Case:
    """One variation of an experiment: what is changed in all of its scenes."""

    place: dict[str, str | float] = field(default_factory=dict)  # columns that identify its rows
    settings: tuple[str, ...] = ()  # changes of the preset
    how: dict[str, Any] = field(default_factory=dict)  # arguments of `track_scenes`
    methods: Sequence[str | Method] | None = None  # None: those of the experiment
    tracked: tuple[str, ...] = ()  # more settings, of scenes that are tracked and not mapped
    depth: dict[str, Any] = field(default_factory=dict)  # fields of `OtherDepth`, if any

    def seen(self, scene: Scene) -> Scene:
        """The scene, read with the depth of this case."""
        return OtherDepth(scene.name, scene.folder, **self.depth) if self.depth else scene


@dataclass(frozen=True)
class Grid:
    """An experiment: the product of cases, scenes and methods, at the rates of the preset."""

    preset: Preset
    cases: Sequence[Case] = (Case(),)
    methods: Sequence[str | Method] = TABLE_1
    how: dict[str, Any] = field(default_factory=dict)  # more arguments of `track_scenes`
    folder: str = "evidence"  # below paper_tables/; that of the CSV unless `has_table`
    has_table: bool = False  # whether Table I is made of its rows, in a folder with its name
    has_maps: bool = False  # whether its rows have sizes and scores of the maps
    workers: int | None = None  # number of runs at the same time, for a GPU; None: by the cores


NINE = load_preset("nine_rooms")
# The first three of the nine, whatever was found in them.
THREE_ROOMS = f"scenes.names={[*NINE.scenes.names[:3]]}"
THREE = with_settings(NINE, THREE_ROOMS)
HELD = load_preset("smoke", settings=[THREE_ROOMS, *HAND_HELD])
# The paper's sizes: 640 x 480 pixels, 256 units, 512 and 4,096 pixels a step.
_FULL_MAPS = "mapping.imap.iterations=10_000", "mapping.neus.iterations=10_000"
FULL = load_preset("synthetic", settings=[THREE_ROOMS, "scenes.n_frames=240", *_FULL_MAPS])
# Five of the paper's rooms, at the sizes of the file beside the results.
PAPER_ROOMS = load_preset("paper", tables_folder() / "paper_rooms" / "settings.toml")
PAPER_SIZES = load_preset("paper", tables_folder() / "paper_rooms_gpu" / "settings.toml")
# The paper's rooms with the depth of the dataset's sensor, with that of one without its bias, which
# lies in a folder of its own, and with the first as one of the paper's authors corrects it.
SENSORS = (
    Case({"sensor": "dataset"}),
    Case({"sensor": "unbiased"}, depth={"depth_folder": "depth_unbiased"}),
)
CORRECTED = Case({"sensor": "dataset, corrected"}, depth={"depth_error_per_m": 0.00123631})
_SIZES_PLUS = {"n_rays": 96, "n_stratified": 8, "n_surface": 8, "n_surface_points": 1024}
_SIZES_PLUS |= {"learning_rate": 0.003}
_SMALL_PLUS = [f"mapping.neus_plus.{name}={size}" for name, size in _SIZES_PLUS.items()]
_OTHERWISE = "vr_metres", "sdf_metres", "vr_velocity", "sdf_velocity", "vr_neus"
READINGS = {name: METHODS[name] for name in _OTHERWISE}
# A unit of the three rooms is 1.9 to 2.0 m, so that 1 a unit is about 0.5 a metre.
READINGS["sdf_per_unit"] = replace(
    SDF, label="NeuS with SDF, distances in units", settings=("tracking.sdf.lambda_sdf=0.5",)
)


def _at_speed(speed: float) -> Case:
    """The same path at another speed: at a higher speed in fewer frames."""
    n_frames = min(THREE.scenes.n_frames, round(THREE.scenes.n_frames / speed))
    motion = f"scenes.motion=keyframes_at_{speed:g}"
    return Case({"speed": speed}, (motion, f"scenes.n_frames={n_frames}"))


TRAINED = 500, 1000, 2000, 4000, 8000  # iterations


def _trained(case: Case, units: int, iterations: int, learning_rate: float) -> Case:
    """A case with another width, number of iterations and learning rate of SDF's map."""
    sizes = {"iterations": iterations, "learning_rate": learning_rate}
    settings = [f"mapping.neus.{name}={size}" for name, size in sizes.items()]
    place = {"units": units, "iterations": iterations, **case.place}
    return replace(case, place=place, settings=(f"network.neus.width={units}", *settings))


def _with_steps(steps: float, n_pixels: int) -> Case:
    settings = f"tracking.vr.n_pixels={n_pixels}", f"tracking.sdf.n_pixels={n_pixels}"
    return Case({"n_pixels": n_pixels, "steps": steps}, settings, {"steps": steps})


GRIDS = {
    # Table I in five of the paper's rooms; a seed takes hours on two cores.
    "paper_rooms": Grid(PAPER_ROOMS, SENSORS, has_table=True, has_maps=True),
    "paper_rooms_gpu": Grid(PAPER_SIZES, SENSORS, has_table=True, has_maps=True),
    # What the bias of the sensor costs LM, in corrected maps of the sizes of `smoke`, and ICP.
    "sensors": Grid(
        with_settings(PAPER_ROOMS, *_SMALL_PLUS),
        [*SENSORS, CORRECTED],
        ["corrected", "icp_middle"],
        {"steps": 30},
        "paper_rooms",
    ),
    # How the error of SDF at 5 Hz follows the training of its map, and the sensor.
    "training": Grid(
        with_settings(PAPER_ROOMS, "scenes.names=['breakfast_room']"),
        [
            *(_trained(sensor, 96, n, 3e-3) for sensor, n in product(SENSORS, TRAINED)),
            _trained(CORRECTED, 96, 4000, 3e-3),
            *(_trained(sensor, 256, 1000, 1e-3) for sensor in SENSORS),
        ],
        ["sdf"],
        {"rates_hz": [5], "frames": ":240"},
        "paper_rooms",
    ),
    # Table I on the mapped path and on a second one; a seed takes an hour on two cores.
    "nine_rooms": Grid(
        NINE,
        [Case({"path": "mapped"}), Case({"path": "second"}, tracked=("scenes.seed=1",))],
        has_table=True,
    ),
    "full_size": Grid(FULL, has_table=True, has_maps=True, workers=9),
    # Other readings of the paper: rates in metres, constant velocity; and VR in SDF's map.
    "readings": Grid(
        THREE, [Case({"reading": name}, methods=[method]) for name, method in READINGS.items()]
    ),
    "speeds": Grid(THREE, [*map(_at_speed, SPEEDS)]),
    # Equal steps, more than the paper's VR has at any rate.
    "more_steps": Grid(THREE, [Case({"steps": n}, how={"steps": n}) for n in (128, 32, 8)]),
    # In grids of features, with the paper's steps; and in 1/10 s a frame.
    "cheap_queries": Grid(THREE, methods=IN_GRIDS),
    "by_the_clock": Grid(THREE, methods=(*TABLE_1, *IN_GRIDS), how=_BY_CLOCK),
    # Equal steps on the whole path, hand-held; every frame and every fourth.
    "steps": Grid(
        HELD,
        [
            Case({"steps": n, "every": every}, how={"steps": n, "frames": f"::{every}"})
            for n, every in product((8, 32, 128), (1, 4))
        ],
    ),
    # Steps x pixels x method: what is left between VR and SDF in one map is the loss.
    "factors": Grid(
        HELD,
        [
            _with_steps(method.paper_steps(10), HELD.tracking_of(tracker).n_pixels)
            for tracker, method in product(("vr", "sdf"), (VR, SDF))
        ],
        ["vr", "vr_neus", "sdf"],
        {"frames": ":"},
    ),
}


def main(experiment: str, seeds: int) -> None:
    """Add the missing rows of an experiment, and make the tables that depend on all of them."""
    grid = GRIDS[experiment]
    name = f"{experiment}/table_1_cells" if grid.has_table else f"{grid.folder}/{experiment}"
    path = tables_folder() / f"{name}.csv"
    add_rows(path, (chunk for seed in range(seeds) for chunk in chunks_of(grid, seed)))
    if experiment == "nine_rooms":
        write_csv(path.parent / "verdicts.csv", verdicts(pd.read_csv(path)), float_format="%.4g")
    if grid.has_table:
        table_of(grid, path)


def table_of(grid: Grid, path: Path) -> None:
    """Make Table I of the rows in a CSV; of several paths or sensors only of the first one."""
    rows = pd.read_csv(path)  # rounded, as every reader of the file has them
    note = []
    for name in ("path", "sensor"):
        if name in rows:
            rows = rows[rows[name] == rows[name].iloc[0]]
            note.append(f"{name}: {rows[name].iloc[0]}")
    note = [camera_motion(grid.preset, rows), *note, f"preset: {described(grid.preset)}"]
    note += [f"budget: {grid.preset.step_counts}", f"seeds: {rows['seed'].nunique()}"]
    note += [", ".join(rows["device"].unique())]
    write_table_1(path.parent, rows, f"{'; '.join(note)}.")


Chunk = tuple[dict[str, str | float], Callable[[], pd.DataFrame]]
"""Columns that identify some rows, and a function that makes these rows."""


def add_rows(path: Path, chunks: Iterator[Chunk]) -> None:
    """Add the rows that a CSV lacks, each as soon as it is finished, with machine and date."""
    rows = pd.read_csv(path) if path.exists() else pd.DataFrame()
    for place, make in chunks:
        wanted = pd.Series(place).map(str)
        if len(rows) and (rows[[*place]].astype(str) == wanted).all(axis=1).any():
            continue
        print(path.name, place, flush=True)
        device = device_name(choose_device())
        made = make().assign(**place, device=device, date=f"{datetime.now(UTC):%Y-%m-%d}")
        made = made[[*place, *made.columns.difference([*place], sort=False)]]
        rows = pd.concat([rows, made])
        write_csv(path, rows)


def chunks_of(grid: Grid, seed: int) -> Iterator[Chunk]:
    """The chunks of an experiment for one seed: each has the rows of one scene in one case."""
    for case in grid.cases:
        preset = with_settings(grid.preset, *case.settings)
        scenes = open_scenes(preset)
        tracked = open_scenes(with_settings(preset, *case.tracked)) if case.tracked else scenes
        methods = case.methods or grid.methods
        how = {"seeds": [seed], **grid.how, **case.how}
        if grid.workers:  # track all scenes at once; the calls below then read the finished runs
            track(scenes, methods, preset, grid.workers, **how)
        for mapped, seen in zip(map(case.seen, scenes), map(case.seen, tracked), strict=True):

            def make(mapped=mapped, seen=seen, methods=methods, preset=preset, how=how):
                rows = track([mapped], methods, preset, tracked=[seen], **how)
                return with_maps(rows, mapped, preset, seed) if grid.has_maps else rows

            yield {**case.place, "scene": mapped.name, "seed": seed}, make


def track(scenes: list[Scene], methods, preset, workers: int | None = None, **how) -> pd.DataFrame:
    """Rows of `track_scenes` with the columns `KEPT`, which may be empty, as without a reach."""
    rows = track_scenes(scenes, methods, preset, execution=Execution(workers), **how)
    return rows.reindex(columns=KEPT)


def with_maps(rows: pd.DataFrame, scene: Scene, preset: Preset, seed: int) -> pd.DataFrame:
    """Add columns to rows of Table I in one scene: sizes of images and maps, and maps' scores."""
    rows["reach_over_motion"] = rows["reach_m"] / (rows["path_m"] / rows["frames"])
    rows["image_width"] = scene.read(":1").intrinsics.width
    maps = []
    for name in TABLE_1:
        method = METHODS[name]
        made = map_scene(scene, method.field, preset, seed).record
        sizes = {"method": method.label, "units": made["network"]["width"]}
        sizes["n_pixels"] = preset.tracking_of(method.tracker).n_pixels
        sizes["iterations"] = made["settings"]["iterations"]
        maps.append({**sizes, "mapping_seconds": made["seconds"], **made["quality"]})
    return rows.merge(pd.DataFrame(maps), on="method", how="left")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 3)
