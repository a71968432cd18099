"""Peak memory of mapping a sequence of 1,600 frames of 640x480, by `/usr/bin/time -v`.

    python benchmarks/mapping_memory.py [WORK_FOLDER]

Writes cpu/memory.csv. The sequence has the size of the dataset's longest scenes. Its frames are
those of a synthetic room, each standing there several times (as hard links): what the images show
does not matter here.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from nbtrack.synthetic import make_room
from nbtrack.tables import write_csv

N_FRAMES, N_RENDERED = 1600, 40
ITERATIONS = 5  # memory has reached its peak after the first


def make_long_sequence(folder: Path) -> Path:
    """A scene folder of `N_FRAMES` frames in the Neural RGB-D layout."""
    short, long = folder / "short", folder / "long_scene"
    if not short.is_dir():
        make_room("living_room", short, N_RENDERED, 640, 480)
    shutil.rmtree(long, ignore_errors=True)
    for name, prefix in (("images", "img"), ("depth_filtered", "depth")):
        (long / name).mkdir(parents=True)
        for number in range(N_FRAMES):
            source = short / name / f"{prefix}{number % N_RENDERED}.png"
            os.link(source, long / name / f"{prefix}{number}.png")
    shutil.copy(short / "focal.txt", long)
    poses = np.loadtxt(short / "poses.txt").reshape(-1, 4, 4)
    np.savetxt(long / "poses.txt", np.tile(poses, (N_FRAMES // N_RENDERED, 1, 1)).reshape(-1, 4))
    return long


def measure(field: str, sequence: Path, runs: Path) -> float:
    """Peak resident memory (GB) of the whole command: reading, mapping, scoring, meshing."""
    command = [
        "/usr/bin/time", "-v", sys.executable, "-m", "nbtrack", "map", str(sequence),
        "--field", field, "--preset", "paper", "--set", f"mapping.{field}.iterations={ITERATIONS}",
    ]  # fmt: skip
    environment = {**os.environ, "NBTRACK_RUNS": str(runs)}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    if ended.returncode:
        raise SystemExit(ended.stderr)
    (kilobytes,) = re.findall(r"Maximum resident set size \(kbytes\): (\d+)", ended.stderr)
    return int(kilobytes) * 1024 / 1e9


def main() -> None:
    """Measure both of the paper's fields."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        sequence = make_long_sequence(folder)
        for field in ("imap", "neus"):
            rows.append({"field": field, "frames": N_FRAMES, "width": 640, "height": 480})
            rows[-1]["peak_gb"] = measure(field, sequence, Path(temporary) / "runs")
            print(rows[-1])
    write_csv(Path(__file__).parent / "cpu" / "memory.csv", pd.DataFrame(rows))


if __name__ == "__main__":
    main()
