"""VR, VR by colour alone, and SDF in five fields; and how opaque their maps are to VR.

    python benchmarks/other_fields.py [SEEDS]

Rows are added to paper_tables/other_fields/table_1_cells.csv as they are finished; those that are
there are not made again, whatever has changed since: remove the file to begin anew. The first seed
takes 90 minutes on one core, a further one, of NeuS and VolSDF alone, 15. Then opacity.csv is made.
"""

import sys
from collections.abc import Iterator
from functools import partial
from itertools import product

import pandas as pd
import torch
from evidence import Chunk, add_rows, track
from motions import HAND_HELD

from nbtrack import load_preset, map_scene, open_scenes
from nbtrack.data.pixels import PixelSampler
from nbtrack.experiments.methods import METHODS
from nbtrack.machinery.files import tables_folder
from nbtrack.tables import write_csv

ROWS = (
    "vr", "color", "vr_neus", "color_neus", "sdf", "vr_volsdf", "color_volsdf", "sdf_volsdf",
    "vr_plus", "color_plus", "sdf_plus", "vr_occupancy", "color_occupancy",
)  # fmt: skip
FURTHER = ("vr_neus", "sdf", "vr_volsdf", "sdf_volsdf")  # rows of the seeds after the first
RATES_HZ = (10.0, 2.0)


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


def track_rows(seeds: int) -> Iterator[Chunk]:
    """Whole paths, method by method."""
    preset = load_preset("smoke", settings=HAND_HELD)
    for seed, scene, name in product(range(seeds), open_scenes(preset), ROWS):
        if seed and name not in FURTHER:
            continue
        place = {"scene": scene.name, "seed": seed, "method": METHODS[name].label}
        how = {"rates_hz": RATES_HZ, "frames": ":", "seeds": [seed]}
        yield place, partial(track, [scene], [name], preset, 1, **how)


def main(seeds: int) -> None:
    """Make the rows that are missing."""
    folder = tables_folder() / "other_fields"
    add_rows(folder / "table_1_cells.csv", track_rows(seeds))
    write_csv(folder / "opacity.csv", opacity(seeds), float_format="%.4g")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
