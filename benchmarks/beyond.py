"""The larger results that notebook 6 reads: CSV in paper_tables/beyond.

    python benchmarks/beyond.py

On the two rooms of the `smoke` preset, with the paper's step counts; minutes on two CPU cores.
Maps and runs are kept with all others (`NBTRACK_RUNS`), so that a killed run goes on.
"""

from collections.abc import Sequence

import pandas as pd
from basin import find_from_afar

from nbtrack import METHODS, Method, load_preset, map_scene, open_scenes, track_scenes
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

_CHANGES = {
    "without colour": "tracking.lm.lambda_intensity=0",
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


def write(name: str, table: pd.DataFrame) -> None:
    """One file of paper_tables/beyond/."""
    path = tables_folder() / "beyond" / f"{name}.csv"
    write_atomic(path, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    print(f"{path.name}: {len(table)} rows")


def beyond(scenes: Sequence[Scene], preset: Preset) -> None:
    """Table III, the basin of convergence, and what each ingredient of LM adds."""
    results = track_scenes(scenes, TABLE_3, preset, RATES_3_HZ)
    write("table_3_cells", results[_COLUMNS])
    device = device_name(choose_device())
    note = f"Preset: smoke; budget: the paper's step counts; 60 frames; {device}."
    write_table_3(tables_folder() / "beyond", results, note)
    # Times count: one run after the other. Other frames than above, so that none is cached.
    speed = track_scenes(scenes, TABLE_3, preset, [10], frames=":40", execution=Execution(1, 1))
    write("speed", speed[_COLUMNS])
    write("points", points_and_bytes(scenes, preset))
    searches = find_from_afar(scenes[0], {"sdf_plus": 79, "lm": 30, "baked": 30}, preset)
    write("basin", searches)
    parts = [
        track_scenes(scenes[:1], INGREDIENTS, preset, steps=30, frames=frames).assign(kept=frames)
        for frames in (":", "::8")
    ]
    ingredients = pd.concat(parts)[["method", "scene", "kept", "steps_per_frame", "ate_m"]]
    write("ingredients", ingredients)


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
            found = track_scenes(scenes, [method], preset, [10])
            parts.append(found.assign(map_mb=sizes))
    return pd.concat(parts)[["method", "n_pixels", "scene", "map_mb", "ate_m"]]


if __name__ == "__main__":
    smoke = load_preset("smoke")
    beyond(open_scenes(smoke), smoke)
