"""VR, VR by colour alone, and SDF in five fields; how opaque their maps are to VR; and from how far
off colour alone finds a pose.

    python benchmarks/other_fields.py [SEEDS]

Rows are added to paper_tables/other_fields/table_1_cells.csv as they are finished; those that are
there are not made again, whatever has changed since: remove the file to begin anew. The first seed
takes 90 minutes on one core, a further one, of NeuS and VolSDF alone, 15. Then opacity.csv is made
and, where it is missing, starts.csv.
"""

import sys
from datetime import UTC, datetime
from itertools import product
from pathlib import Path

import pandas as pd
import torch
from basin import OFFSETS, find_from_afar
from motions import HAND_HELD

from nbtrack import load_preset, map_scene, open_scenes, track_scenes
from nbtrack.core.files import tables_folder, write_atomic
from nbtrack.data.pixels import PixelSampler
from nbtrack.experiments.grid import Execution
from nbtrack.experiments.methods import METHODS

ROWS = (
    "vr", "color", "vr_neus", "color_neus", "sdf", "vr_volsdf", "color_volsdf", "sdf_volsdf",
    "vr_plus", "color_plus", "sdf_plus", "vr_occupancy", "color_occupancy",
)  # fmt: skip
FURTHER = ("vr_neus", "sdf", "vr_volsdf", "sdf_volsdf")  # rows of the seeds after the first
RATES_HZ = (10.0, 2.0)
COLUMNS = [
    "scene", "seed", "rate_hz", "method", "frames", "steps_per_frame",
    "path_m", "still_ate_m", "ate_m",
    "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "lost_frames", "device", "date",
]  # fmt: skip


def starts(path: Path) -> None:
    """VR with and without depth, from starts that are off by up to 4 cm and 4 degrees."""
    preset = load_preset("smoke", settings=HAND_HELD)
    methods = dict.fromkeys(["vr", "color", "vr_neus", "color_neus"], 100)
    found = find_from_afar(open_scenes(preset)[0], methods, preset, OFFSETS[:3], 8)
    write_atomic(path, found.to_csv(index=False, float_format="%.6g", lineterminator="\n"))


@torch.no_grad()
def opacity(seeds: int) -> pd.DataFrame:
    """What VR's own samples see of a map at the true poses: opacity, and how deep (m) it looks.

    A row a map, with the mean over pixels of all frames, and the map's own scale (m).
    """
    preset, rows = load_preset("smoke", settings=HAND_HELD), []
    vr = preset.tracking_of("vr")
    for scene, name, seed in product(open_scenes(preset), ("neus", "volsdf"), range(seeds)):
        field = map_scene(scene, name, preset, seed).field
        sequence, generator = scene.read(), torch.Generator()
        draw = PixelSampler(sequence, torch.device("cpu")).draw
        rays = draw(5000, generator.manual_seed(0), torch.arange(len(sequence)))
        seen = field.render_hierarchically(rays, vr.n_stratified, vr.n_importance, generator)
        measured, row = rays.depth > 0, {"field": field.label, "scene": scene.name, "seed": seed}
        row |= {**field.diagnostics(), "opacity": seen.opacity[measured].mean().item()}
        rows.append({**row, "depth_bias_m": (seen.depth - rays.depth)[measured].mean().item()})
    return pd.DataFrame(rows)


def main(seeds: int) -> None:
    """Make the rows that are missing, method by method, over whole paths."""
    preset, folder = load_preset("smoke", settings=HAND_HELD), tables_folder() / "other_fields"
    path, seen = folder / "table_1_cells.csv", folder / "starts.csv"
    rows = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)
    for seed, scene, name in product(range(seeds), open_scenes(preset), ROWS):
        place = {"scene": scene.name, "seed": seed, "method": METHODS[name].label}
        is_there = (rows[[*place]] == pd.Series(place)).all(axis=1).any()
        if is_there or (seed and name not in FURTHER):
            continue
        how = {"frames": ":", "seeds": [seed], "execution": Execution(workers=1)}
        made = track_scenes([scene], [name], preset, RATES_HZ, **how)
        made = made.assign(date=f"{datetime.now(UTC):%Y-%m-%d}")[COLUMNS]
        rows = pd.concat([rows, made]) if len(rows) else made
        write_atomic(path, rows.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
        print(made.to_string(index=False, header=False), flush=True)
    found = opacity(seeds).to_csv(index=False, float_format="%.4g", lineterminator="\n")
    write_atomic(folder / "opacity.csv", found)
    if not seen.exists():
        starts(seen)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
