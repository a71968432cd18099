"""Table I over nine synthetic rooms and several seeds, on the mapped path and on a second one.

    python benchmarks/nine_rooms.py [SEEDS]

Rows are added to paper_tables/nine_rooms/table_1_cells.csv as they are finished; those that are
there are not made again, whatever has changed since: remove the file to begin anew. A seed takes 40
minutes on two CPU cores. The tables of `python -m nbtrack tables --preset nine_rooms` are rewritten
from the rows of the mapped path.
"""

import sys
from datetime import UTC, datetime
from itertools import product

import pandas as pd

from nbtrack import load_preset, open_scenes, track_scenes
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder, write_atomic
from nbtrack.experiments.methods import TABLE_1
from nbtrack.tables import style_table_1, write_table_1

COLUMNS = [
    "path", "rate_hz", "method", "scene", "seed", "frames", "steps_per_frame", "ate_m",
    "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "lost_frames", "device", "date",
]  # fmt: skip
PRESET = load_preset("nine_rooms")
SECOND = load_preset("nine_rooms", settings=["scenes.seed=1"])


def main(seeds: int) -> None:
    """Make the rows that are missing, two rooms at a time."""
    folder = tables_folder() / PRESET.name
    path = folder / "table_1_cells.csv"
    rows = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)
    scenes = {"mapped": open_scenes(PRESET), "second": open_scenes(SECOND)}
    pairs = [slice(start, start + 2) for start in range(0, len(scenes["mapped"]), 2)]
    for seed, kind, pair in product(range(seeds), scenes, pairs):
        mapped, tracked = scenes["mapped"][pair], scenes[kind][pair]
        done = rows.query("path == @kind and seed == @seed")["scene"]
        if {scene.name for scene in mapped} <= {*done}:
            continue
        made = track_scenes(mapped, TABLE_1, PRESET, seeds=[seed], tracked=tracked)
        made = made.assign(path=kind, date=f"{datetime.now(UTC):%Y-%m-%d}")
        rows = pd.concat([rows, made[COLUMNS]]) if len(rows) else made[COLUMNS]
        write_atomic(path, rows.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
        print(style_table_1(made))
    note = (
        f"Preset: {PRESET.name}; budget: the paper's step counts; {device_name(choose_device())}."
    )
    write_table_1(folder, rows.query("path == 'mapped'"), note)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
