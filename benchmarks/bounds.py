"""Lower bounds of the errors in Table I, since a tracker's steps have a limited length.

    python benchmarks/bounds.py

Reads `poses.txt` of the dataset's scenes in the data folder (`NBTRACK_DATA`; no images are needed),
and replaces the rows of these scenes in `paper_tables/protocol/bounds.csv`. A row is for a scene, a
cell of Table I, and a reading of what the paper leaves open: the unit of a step, and the motion
model. It has two bounds of the ATE:

- `greedy_ate_m`, of a tracker that ends each frame as near to the path as its reach allows;
- `least_any_m`, the smallest possible one, of a tracker that knows the whole path and may move
  ahead of the camera. It is empty for constant velocity, whose reach grows with the speed.
"""

from itertools import product

import numpy as np
import pandas as pd
from scipy.optimize import lsq_linear

from nbtrack.data.dataset import DATASET_SCENES, DATASET_UNITS
from nbtrack.machinery.files import data_folder, tables_folder
from nbtrack.recordings.formats import Declaration
from nbtrack.tables import published_table_1, write_csv
from nbtrack.tracking import SdfSettings, paper_steps
from nbtrack.tracking.metrics import still_metrics
from nbtrack.tracking.reach import greedy_ate, reach

RATE = SdfSettings().position_rate
METHODS = {"vr": "iMAP with VR", "sdf": "NeuS with SDF"}
PREVIOUS, VELOCITY = "previous_pose", "constant_velocity"
READINGS = {"metre": PREVIOUS, "map": PREVIOUS, "metre, constant velocity": VELOCITY}


def least_of_all(T_world_camera: np.ndarray, reach_m: float) -> float:
    """The smallest ATE (m) of all paths that move by at most the reach in a frame, along each axis.

    The motions of all frames are found by constrained least squares.
    """
    offsets = T_world_camera[1:, :3, 3] - T_world_camera[0, :3, 3]
    sums = np.tril(np.ones((len(offsets), len(offsets))))  # times the motions: the positions
    # `cost` is half the sum of squared residuals.
    costs = [lsq_linear(sums, axis, (-reach_m, reach_m)).cost for axis in offsets.T]
    return float(np.sqrt(2 * sum(costs) / len(offsets)))


def bounds_of(scene: str) -> pd.DataFrame:
    """Rows of one scene: one for each method, rate and reading."""
    file_poses = np.loadtxt(data_folder() / scene / "poses.txt").reshape(-1, 4, 4)
    path = Declaration(camera_axes="opengl").poses_to_opencv(file_poses)
    published = published_table_1().set_index(["rate_hz", "method", "scene"])["ate_m"]
    known = {"scene": scene, "frames": len(path), **still_metrics(path)}
    rows = []
    for (tracker, method), rate_hz, reading in product(METHODS.items(), (10, 5, 2), READINGS):
        steps = paper_steps(tracker, rate_hz)
        unit = DATASET_UNITS.get(scene, np.nan) if reading == "map" else 1.0
        reach_m, motion_model = reach(steps, unit * RATE), READINGS[reading]
        has_least = motion_model == PREVIOUS and np.isfinite(reach_m)
        row = {"tracker": tracker, "rate_hz": rate_hz, "steps": steps, "reading": reading}
        row |= {"published_ate_m": published[rate_hz, method, DATASET_SCENES[scene]]}
        row |= {"metres_per_unit": unit, "reach_m": reach_m}
        row |= {"greedy_ate_m": greedy_ate(path, reach_m, motion_model)}
        row |= {"least_any_m": least_of_all(path, reach_m) if has_least else np.nan}
        rows.append({**known, **row})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    there = [name for name in DATASET_SCENES if (data_folder() / name / "poses.txt").is_file()]
    file = tables_folder() / "protocol" / "bounds.csv"
    kept = pd.read_csv(file) if file.is_file() else pd.DataFrame({"scene": []})
    kept = kept[~kept["scene"].isin(there)]
    print(write_csv(file, pd.concat([kept, *map(bounds_of, there)]), float_format="%.5g"))
