"""A map in ten seconds: NeuS+ on grids of features beside NeuS+ as an MLP, both corrected.

    python benchmarks/ten_seconds.py accuracy [RECORDING ...]
    python benchmarks/ten_seconds.py times RECORDING

`accuracy` writes paper_tables/corrected/grid.csv: LM with 2,048 points in both maps of all nine
rooms, on the mapped path and on another, and of recordings, three seeds each. `times` prints
seconds of a core from a recording to its corrected map, of both in turns, six rounds. Times count:
run nothing else.
"""

import sys
import time
from itertools import product

import pandas as pd
import torch
from corrected import ALONE, SEEDS, WRONG_IN_RECORDING_M, WRONG_M, write_rows
from mistakes import mistakes
from motions import HAND_HELD

from nbtrack import METHODS, load_preset, open_scene, open_scenes, read_run, track_scenes
from nbtrack.beyond.correct import correct_map
from nbtrack.mapping.fit import map_sequence

COMPARED = [METHODS["corrected"], METHODS["grid_corrected"]]
KEPT = ["frames", "path", "scene", "method", "seed", "ate_m", "still_ate_m", "map_seconds"]
PRESET = load_preset("nine_rooms", settings=HAND_HELD)
ROUNDS = 6


def main() -> None:
    """What is asked for."""
    torch.set_num_threads(1)
    what, *folders = sys.argv[1:]
    if what == "times":
        print(times(folders[0]).to_string(index=False))
    else:
        write_rows("grid.csv", accuracy(folders))


def accuracy(folders: list[str]) -> pd.DataFrame:
    """A row a run: its error, and the mistakes of its verdicts."""
    second = load_preset("nine_rooms", settings=[*HAND_HELD, "scenes.seed=1"])
    rooms, elsewhere = open_scenes(PRESET), open_scenes(second)
    recordings = [open_scene(folder, PRESET) for folder in folders]
    runs = [judged(recordings, recordings, "mapped", frames) for frames in (":", "::2", "::4")]
    for (path, tracked), frames in product(
        (("mapped", rooms), ("second", elsewhere)), (":", "::4", "::8")
    ):
        runs.append(judged(rooms, tracked, path, frames))
    return pd.concat(runs)


def judged(scenes, tracked, path: str, frames: str) -> pd.DataFrame:
    """Both methods with all seeds."""
    how = {"steps": 30, "frames": frames, "seeds": SEEDS, "execution": ALONE}
    found = track_scenes(scenes, COMPARED, PRESET, tracked=tracked, **how)
    wrong_m = WRONG_M if scenes[0].room else WRONG_IN_RECORDING_M
    counts = pd.DataFrame([mistakes(read_run(run).frames, wrong_m) for run in found["run"]])
    return found.assign(path=path, frames=frames, **counts)[[*KEPT, *counts]]


def times(folder: str) -> pd.DataFrame:
    """Seconds of a core that mapping and correction take, and the map's size."""
    scene, rows = open_scene(folder, PRESET), []
    sequence = scene.read()
    for number, method in product(range(ROUNDS), COMPARED):
        own = PRESET.with_method(method.settings)
        network, settings = own.network_of(method.field), own.mapping_of(method.field)
        began = time.process_time()
        made = map_sequence(method.field, sequence, network, settings)
        mapping = time.process_time()
        correct_map(made, sequence, own.correction[method.field])
        seconds = mapping - began, time.process_time() - mapping
        rows.append((number, method.label, *seconds, sum(seconds)))
    columns = ["round", "method", "mapping_s", "correction_s", "seconds"]
    return pd.DataFrame(rows, columns=columns)


if __name__ == "__main__":
    main()
