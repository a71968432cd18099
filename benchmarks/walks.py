"""Long walks: 1,200 frames around the whole of each room, mapped from every fourth frame.

    python benchmarks/walks.py

Writes walks.csv to paper_tables/corrected: LM in the corrected map and in the baked one, and ICP,
at every and at every fourth frame of all nine rooms; then the paper's two methods with the steps of
2 Hz in the first two. Half an hour on one core for LM and ICP, as long again for the paper's two.
Maps and runs are kept (`NBTRACK_RUNS`), so that a killed benchmark goes on. Times count: run
nothing else.
"""

from itertools import product

import pandas as pd
import torch
from mistakes import mistakes
from motions import HAND_HELD

from nbtrack import METHODS, Method, load_preset, open_scenes, read_run
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder
from nbtrack.core.settings import with_settings
from nbtrack.experiments.grid import Execution, run_jobs
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.methods import TABLE_1
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.tables import write_csv

PRESET = load_preset(
    "nine_rooms", settings=[*HAND_HELD, "scenes.motion=tour", "scenes.n_frames=1200"]
)
MAPPED, STEPS, RATE_HZ = "::4", 30, 2
METHODS_OF_WALKS = [METHODS[name] for name in ("corrected", "baked", "icp_middle")]
WRONG_M = 0.05
KEPT = ["still_ate_m", "path_m", "max_error_m", "map_seconds"]


def main() -> None:
    """A row a run; the file grows run by run."""
    torch.set_num_threads(1)
    rooms, rows = open_scenes(PRESET), []
    paper = [METHODS[name] for name in TABLE_1]
    for method, room, frames in product(METHODS_OF_WALKS, rooms, (":", "::4")):
        rows.append(run(room, method, frames))
        write(rows)
    for room, method in product(rooms[:2], paper):
        rows.append(run(room, method, ":", method.paper_steps(RATE_HZ)))
        write(rows)


def run(room: Scene, method: Method, frames: str, steps: float = STEPS) -> dict:
    """One tracked walk; `found_again` counts how often a wrong frame is followed by a right one."""
    preset = with_settings(PRESET, *method.settings)
    settings = preset.tracking_of(method.tracker)
    made = MapJob.of(room, method.field, preset, MAPPED)
    job = TrackJob(made, room, method.tracker, settings, steps, frames=frames)
    found = run_jobs([job], Execution(workers=1))[0]
    tracked = read_run(job.folder.name).frames
    is_wrong = (tracked["translation_error_m"] > WRONG_M).to_numpy()
    width, _, depth = room.room.parts[0].solid.size
    field = made.map().field
    return {
        "scene": room.name,
        "floor_m2": width * depth,
        "method": method.label,
        "n_pixels": settings.n_pixels,
        "frames": frames,
        "ate_m": found["ate_rmse_m"],
        "milliseconds": 1e3 * tracked["seconds"].median(),
        **{name: found[name] for name in KEPT},
        **mistakes(tracked, WRONG_M),
        "found_again": int((is_wrong[:-1] & ~is_wrong[1:]).sum()),
        "map_mb": sum(part.nbytes for part in field.state_dict().values()) / 1e6,
    }


def write(rows: list[dict]) -> None:
    """With the machine."""
    table = pd.DataFrame(rows).assign(device=device_name(choose_device()))
    write_csv(tables_folder() / "corrected" / "walks.csv", table)


if __name__ == "__main__":
    main()
