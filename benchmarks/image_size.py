"""Whether larger camera pictures cost tracking anything: the same walk in four sizes, in turns.

    python benchmarks/image_size.py

Writes image_size.csv to paper_tables/corrected: median milliseconds a frame, everything counted but
the reading of files, in the corrected map of one room. Times count: run nothing else.
"""

import torch
from motions import HAND_HELD
from turns import in_turns

from nbtrack import METHODS, load_preset, make_tracker, map_scene, open_scene
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder
from nbtrack.core.settings import with_settings
from nbtrack.tables import write_csv
from nbtrack.tracking import StepBudget

ROOM, WIDTHS, FRAMES, POINTS = "living_room", (96, 320, 640, 1280), 60, 2048


def main() -> None:
    """One tracker a size; frame after frame, each in its turn."""
    torch.set_num_threads(1)
    settings = *METHODS["corrected"].settings, f"tracking.lm.n_pixels={POINTS}"
    preset = load_preset("smoke", settings=[*HAND_HELD, *settings])
    field = map_scene(open_scene(ROOM, preset), "neus_plus", preset).field
    walks = {}
    for width in WIDTHS:
        of_size = with_settings(preset, f"scenes.width={width}")
        walks[width] = open_scene(ROOM, of_size).read(f":{FRAMES}")
    how = StepBudget(30), preset.tracking_of("lm")
    runs = {
        width: (make_tracker("lm", field, walk.T_world_camera[0], *how), walk)
        for width, walk in walks.items()
    }
    table = in_turns(runs).rename(columns={"run": "width"}).groupby("width").median().reset_index()
    print(table.to_string(index=False))
    made = {"n_pixels": POINTS, "scene": ROOM, "device": device_name(choose_device())}
    write_csv(tables_folder() / "corrected" / "image_size.csv", table.assign(**made))


if __name__ == "__main__":
    main()
