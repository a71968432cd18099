"""Accuracy, time, basin and verdicts of the second-order tracker, as the tables in README.md show.

    python benchmarks/second_order.py [RECORDING]

Maps and runs are kept with all others (`NBTRACK_RUNS`). RECORDING is a folder in the dataset's
layout; without one only the synthetic rooms of the `smoke` preset are run.
"""

import sys

import pandas as pd
import torch
from basin import find_from_afar

from nbtrack import METHODS, Method, load_preset, map_scenes, open_scene, open_scenes, track_scenes
from nbtrack.core.settings import with_settings
from nbtrack.experiments.grid import Execution

_LONGER = "mapping.neus_plus.iterations=4000"
# Method and steps a frame at most.
COMPARED = {
    METHODS["sdf"]: 15.3,
    METHODS["sdf_plus"]: 15.3,
    METHODS["lm"]: 30.0,
    Method("LM, 2048 points", "neus_plus", "lm", ("tracking.lm.n_pixels=2048",)): 30.0,
    METHODS["baked"]: 30.0,
    Method("LM, NeuS+ mapped for 4000 iterations", "neus_plus", "lm", (_LONGER,)): 30.0,
    Method("the same, baked", "neus_plus", "lm", (_LONGER, *METHODS["baked"].settings)): 30.0,
    METHODS["icp"]: 1.0,
}
ALONE = Execution(workers=1)  # times count
TOO_FAST = ("::8", "::10", "::12", "::16")
"""So much of a recording is left out that some frames are lost: verdicts are scored there."""
COLUMNS = ["scene", "method", "ate_m", "seconds_per_frame", "steps_per_frame", "lost_frames"]


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(1)
    preset = load_preset("smoke")
    rooms = open_scenes(preset)
    recordings = [open_scene(folder, preset) for folder in sys.argv[1:]]
    for scenes, slices in ((rooms, [":120"]), (recordings, [":", "::2", "::3"])):
        for frames in slices if scenes else ():
            runs = [
                track_scenes(scenes, [method], preset, steps=steps, frames=frames, execution=ALONE)
                for method, steps in COMPARED.items()
            ]
            print(frames, pd.concat(runs)[COLUMNS].to_string(index=False), sep="\n")
    for frames in TOO_FAST if recordings else ():
        for name, steps in (("lm", 100), ("baked", 100), ("icp", 1)):
            found = track_scenes(recordings, [name], preset, steps=steps, frames=frames)
            verdicts = ["method", "frames", "lost_frames", "lost_precision", "lost_recall"]
            print(frames, found[verdicts].to_string(index=False, header=False))
    for field, iterations in (("neus", 2000), ("neus_plus", 1400), ("neus_plus", 500)):
        shorter = with_settings(preset, f"mapping.{field}.iterations={iterations}")
        scores = map_scenes(rooms[:1], [field], shorter)[["seconds", "sdf_near_m", "sdf_free_m"]]
        print(field, iterations, scores.to_string(index=False, header=False))
    searches = find_from_afar(rooms[0], {"sdf_plus": 79, "lm": 30, "baked": 30}, preset)
    shares = searches.groupby(["method", "offset"], sort=False)["recovered"].mean()
    print((100 * shares.unstack(sort=False)).round().to_string())


if __name__ == "__main__":
    main()
