"""Seconds of a core from a recording to its corrected map: NeuS+ as an MLP, and on grids of
features.

    python benchmarks/ten_seconds.py RECORDING

Both in turns, six rounds; writes paper_tables/corrected/mapping.csv. How accurate LM is in both
maps is measured by `corrected.py`. Run nothing else.
"""

import sys
import time
from itertools import product

import pandas as pd
import torch
from corrected import write_rows

from nbtrack import METHODS, load_preset, open_scene
from nbtrack.beyond.correct import correct_map
from nbtrack.mapping.fit import map_sequence

COMPARED = [METHODS["corrected"], METHODS["grid_corrected"]]
ROUNDS = 6


def main(folder: str) -> None:
    """Map and correct, again and again."""
    torch.set_num_threads(1)
    preset, rows = load_preset("smoke"), []
    scene = open_scene(folder, preset)
    sequence = scene.read()
    for number, method in product(range(ROUNDS), COMPARED):
        own = preset.with_method(method.settings)
        network, settings = own.network_of(method.field), own.mapping_of(method.field)
        began = time.process_time()
        made = map_sequence(method.field, sequence, network, settings)
        mapped = time.process_time()
        correct_map(made, sequence, own.correction[method.field])
        seconds = mapped - began, time.process_time() - mapped
        rows.append((scene.name, number, method.label, *seconds))
    columns = ["scene", "round", "method", "mapping_s", "correction_s"]
    write_rows("mapping.csv", pd.DataFrame(rows, columns=columns))


if __name__ == "__main__":
    main(sys.argv[1])
