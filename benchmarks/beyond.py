"""The larger results that notebooks 6 and A1 read: CSV in paper_tables/beyond and open_questions.

    python benchmarks/beyond.py

On the two rooms of the `smoke` preset, with the paper's step counts; ten minutes on two CPU cores.
Maps and runs are kept with all others (`NBTRACK_RUNS`), so that a killed run goes on.
"""

from collections.abc import Sequence
from dataclasses import replace

import pandas as pd
from basin import find_from_afar

from nbtrack import METHODS, Method, load_preset, map_scene, map_scenes, open_scenes, track_scenes
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder, write_atomic
from nbtrack.core.settings import with_settings
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_3
from nbtrack.experiments.presets import Preset
from nbtrack.experiments.scenes import Scene
from nbtrack.tables import write_table_3

_COLUMNS = ["rate_hz", "method", "n_pixels", "scene", "frames"]
_COLUMNS += ["steps_per_frame", "seconds_per_frame", "ate_m"]
_FIRST_60 = ":60"

_CHANGES = {
    "without colour": "tracking.lm.lambda_intensity=0",
    "with narrow scales throughout": "tracking.lm.anneal=false",
    "with f in place of f/|∇f|": "tracking.lm.divide_by_slope=false",
    "from the previous pose": "tracking.lm.motion_model=previous_pose",
    "from constant velocity": "tracking.lm.motion_model=constant_velocity",
    "with four times the points": "tracking.lm.n_pixels=2048",
    "in NeuS+ without rendering": "mapping.neus_plus.lambda_rendering=0",
}
# LM with one thing changed at a time.
INGREDIENTS = [
    METHODS["lm"],
    *(Method(label, "neus_plus", "lm", (setting,)) for label, setting in _CHANGES.items()),
    Method("in NeuS, as in the paper", "neus", "lm"),
]


def write(folder: str, name: str, table: pd.DataFrame) -> None:
    """One file of paper_tables/."""
    path = tables_folder() / folder / f"{name}.csv"
    write_atomic(path, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    print(f"{folder}/{path.name}: {len(table)} rows")


def beyond(scenes: Sequence[Scene], preset: Preset) -> None:
    """Table III, the basin of convergence, and what each ingredient of LM adds."""
    results = track_scenes(scenes, TABLE_3, preset, RATES_3_HZ, frames=_FIRST_60)
    write("beyond", "table_3_cells", results[_COLUMNS])
    device = device_name(choose_device())
    note = f"Preset: smoke; budget: the paper's step counts; first 60 frames; {device}."
    write_table_3(tables_folder() / "beyond", results, note)
    # Times count: one run after the other. Other frames than above, so that none is cached.
    speed = track_scenes(scenes, TABLE_3, preset, [10], frames=":40", execution=Execution(1, 1))
    write("beyond", "speed", speed[_COLUMNS])
    write("beyond", "points", points_and_bytes(scenes, preset))
    searches = find_from_afar(scenes[0], {"sdf_plus": 79, "lm": 30, "baked": 30}, preset)
    write("beyond", "basin", searches)
    parts = [
        track_scenes(scenes[:1], INGREDIENTS, preset, steps=30, frames=frames).assign(kept=frames)
        for frames in (":", "::8")
    ]
    ingredients = pd.concat(parts)[["method", "scene", "kept", "steps_per_frame", "ate_m"]]
    write("beyond", "ingredients", ingredients)


def points_and_bytes(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """LM and ICP with fewer and more points a frame; ICP in coarser clouds too. Error and size.

    `map_mb` is what the map's numbers take, a million bytes.
    """
    maps = {"NeuS+ with SDF (LM)": ("neus_plus", "lm", ())}
    for voxel in (0.02, 0.05, 0.1):
        setting = f"mapping.points.voxel={voxel}"
        maps[f"ICP, cells of {100 * voxel:g} cm"] = ("points", "icp", (setting,))
    parts = []
    for label, (field, tracker, settings) in maps.items():
        fields = [map_scene(s, field, with_settings(preset, *settings)).field for s in scenes]
        sizes = [sum(t.nbytes for t in field.state_dict().values()) / 1e6 for field in fields]
        for n in (128, 512, 2048, 4096):
            points = f"tracking.{tracker}.n_pixels={n}"
            method = Method(label, field, tracker, (*settings, points))
            found = track_scenes(scenes, [method], preset, [10], frames=_FIRST_60)
            parts.append(found.assign(map_mb=sizes))
    return pd.concat(parts)[["method", "n_pixels", "scene", "map_mb", "ate_m"]]


def open_questions(scenes: Sequence[Scene], preset: Preset) -> None:
    """Steps against learning rates, the start of the search, VR in both maps, cost of mapping."""
    write("open_questions", "steps_and_rates", steps_and_rates(scenes[:1], preset))
    methods = ["vr", "sdf", "vr_velocity", "sdf_velocity"]
    starts = track_scenes(scenes, methods, preset, rates_hz=[10])
    write("open_questions", "starts", starts[_COLUMNS])
    both = track_scenes(scenes, ["vr", "sdf", "vr_neus"], preset, rates_hz=[2], frames=_FIRST_60)
    write("open_questions", "vr_in_both_maps", both[_COLUMNS])
    write("open_questions", "mapping_time", mapping_time(scenes[:1], preset))


def steps_and_rates(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """More steps with the paper's learning rates, and larger steps with those of 10 Hz.

    `reach_mm` is how far Adam can move the position along an axis in a frame.
    """
    parts = []
    for name in ("vr", "sdf"):
        method = METHODS[name]
        more = track_scenes(scenes, [method], preset).assign(how="more steps", factor=1.0)
        parts.append(more)
        for factor in (1.0, 2.0, 4.0):
            rates = {"position_rate": factor * 5e-4, "orientation_rate": factor * 1e-3}
            settings = tuple(f"tracking.{method.tracker}.{k}={v!r}" for k, v in rates.items())
            larger = replace(method, settings=settings)
            found = track_scenes(scenes, [larger], preset, rates_hz=[10])
            parts.append(found.assign(how="larger steps", factor=factor))
    table = pd.concat(parts)
    table["reach_mm"] = 0.5 * table["steps"] * table["factor"]
    return table[["method", "how", "scene", "steps", "factor", "reach_mm", "ate_m"]]


def mapping_time(scenes: Sequence[Scene], preset: Preset) -> pd.DataFrame:
    """Held-out depth error against mapping time; every row is a map made from start to end."""
    parts = []
    for field in ("imap", "neus"):
        whole = preset.mapping_of(field)
        for share in (0.125, 0.35, 0.9):  # a whole one is cached, made beside another
            iterations = round(share * whole.iterations)
            shorter = with_settings(preset, f"mapping.{field}.iterations={iterations}")
            samples = whole.n_rays * (whole.n_stratified + whole.n_surface)
            made = map_scenes(scenes, [field], shorter, execution=Execution(1, 1))
            parts.append(made.assign(iterations=iterations, samples=samples))
    return pd.concat(parts)[["field", "scene", "iterations", "samples", "seconds", "depth_l1_m"]]


if __name__ == "__main__":
    smoke = load_preset("smoke")
    rooms = open_scenes(smoke)
    beyond(rooms, smoke)
    open_questions(rooms, smoke)
