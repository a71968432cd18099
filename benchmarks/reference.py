"""Errors of tracked paths against reference poses that are themselves off.

    python benchmarks/reference.py [RECORDING]

Writes paper_tables/corrected/reference.csv. It has rooms whose mapped poses were moved by smooth
errors, so that the truth is known, and recordings, whose truth is unknown. Three RMS distances of a
path are computed: from the reference, from the truth, and from pairs. For a pair of frames that are
`GAP` apart, generalised ICP finds the motion between them from their points alone, without a map.

The distance from pairs has an interval of 95 % (bootstrap over blocks of frames). `nearer_share` is
the share of the bootstrap's draws in which the path is nearer to the pairs than the reference is.
"""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import small_gicp
import torch
from motions import HAND_HELD
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from nbtrack import METHODS, load_preset, make_tracker, open_scenes, read_sequence
from nbtrack.beyond.correction import correct_map
from nbtrack.beyond.observed import draw_points
from nbtrack.machinery.device import choose_device, device_name
from nbtrack.machinery.files import tables_folder
from nbtrack.machinery.settings import with_settings
from nbtrack.mapping.fit import map_sequence
from nbtrack.tables import write_csv
from nbtrack.tracking import StepBudget, track_sequence

TRACKED = METHODS["corrected_dense"], METHODS["icp_dense"]
# Smooth errors like those of a registration: standard deviations (m, degrees), the distance (m) of
# the point ahead of the camera about which it is turned, and the filter's width (frames).
OFF_M, OFF_DEG, AHEAD, SMOOTH = 0.006, 0.25, 1.5, 4
# Frames from one to the other of a pair, points of each, and the voxel (m) and the largest distance
# of correspondences (m) of their registration.
GAP, PAIR_POINTS, PAIR_VOXEL, PAIR_REACH = 5, 16_384, 0.02, 0.05
# Bootstrap: frames of a block, whose errors are correlated, and the number of draws.
BLOCK, DRAWS = 10, 1000


def main(recordings: list[str]) -> None:
    """Compare paths in two rooms with two seeds of errors each, and in recordings as they are."""
    torch.set_num_threads(1)
    preset, tables = load_preset("smoke", settings=HAND_HELD), []
    for scene in open_scenes(preset):
        truth = scene.read(":120")
        for seed in (0, 1):
            given = replace(truth, T_world_camera=moved_poses(truth.T_world_camera, seed))
            tables.append(compared(given, preset, truth).assign(scene=scene.name, seed=seed))
    for recording in recordings:
        given = read_sequence(recording)
        tables.append(compared(given, preset).assign(scene=given.name, seed=0))
    table = pd.concat(tables)
    print(table.groupby(["scene", "path"], sort=False).mean(numeric_only=True).round(4))
    path = tables_folder() / "corrected" / "reference.csv"
    write_csv(path, table.assign(device=device_name(choose_device())))


def compared(given, preset, truth=None) -> pd.DataFrame:
    """A row for each path: its distances (m) from the reference, the truth if known, and pairs.

    `given` is the sequence with the reference poses, and `truth` the same with the true poses.
    """
    paths = {"reference": given} | ({"truth": truth} if truth else {})
    paths |= {method.label: tracked_path(method, given, preset) for method in TRACKED}
    pairs = registered_pairs(given)
    squares = {name: pair_errors(path, pairs) ** 2 for name, path in paths.items()}
    means = {name: in_blocks(values) for name, values in squares.items()}
    rows = []
    for name, path in paths.items():
        low, high = np.quantile(means[name] ** 0.5, [0.025, 0.975])
        row = {"path": name, "from_reference_m": apart(path, given)}
        row["from_truth_m"] = apart(path, truth) if truth else np.nan
        row |= {"from_pairs_m": squares[name].mean() ** 0.5, "pairs_low_m": low}
        row |= {"pairs_high_m": high, "nearer_share": (means[name] < means["reference"]).mean()}
        rows.append(row)
    return pd.DataFrame(rows)


def moved_poses(poses: np.ndarray, seed: int) -> np.ndarray:
    """Poses (camera to world) with smooth random errors.

    They move the camera, and turn it about a point ahead of it.
    """
    noise = np.random.default_rng(seed).normal(size=(len(poses), 6))
    noise = gaussian_filter1d(noise, SMOOTH, axis=0, mode="reflect")
    noise = (noise - noise.mean(axis=0)) / noise.std(axis=0)
    off = np.tile(np.eye(4), (len(poses), 1, 1))
    off[:, :3, :3] = Rotation.from_rotvec(OFF_DEG * noise[:, :3], degrees=True).as_matrix()
    ahead = np.array([0.0, 0.0, AHEAD])
    off[:, :3, 3] = OFF_M * noise[:, 3:] + ahead - off[:, :3, :3] @ ahead
    return poses @ off


def tracked_path(method, sequence, preset):
    """The sequence with the poses that a method tracks in a map of these very frames."""
    changed = with_settings(preset, *method.settings)
    settings, network = changed.mapping_of(method.field), changed.network_of(method.field)
    made = map_sequence(method.field, sequence, network, settings, device=torch.device("cpu"))
    if voxel := changed.correction.get(method.field):
        made = correct_map(made, sequence, voxel)
    how = sequence.T_world_camera[0], StepBudget(30), changed.tracking_of(method.tracker)
    found = track_sequence(make_tracker(method.tracker, made.field, *how), sequence)
    given = sequence.T_world_camera[:1]
    return replace(sequence, T_world_camera=np.concatenate([given, found.T_estimated]))


def apart(path, other) -> float:
    """RMS distance (m) of two paths' positions, without the first, which trackers are given."""
    a, b = (sequence.T_world_camera[1:, :3, 3] for sequence in (path, other))
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def registered_pairs(sequence) -> np.ndarray:
    """Poses (n x 4 x 4) of frames in the camera frame `GAP` before, from their points alone.

    Registration starts at the sequence's own poses.
    """
    seeded, clouds = torch.Generator().manual_seed(0), []
    for index in range(len(sequence)):
        points = draw_points(sequence[index], PAIR_POINTS, seeded)[0]
        clouds.append(small_gicp.preprocess_points(points, downsampling_resolution=PAIR_VOXEL))
    starts = np.linalg.inv(sequence.T_world_camera[:-GAP]) @ sequence.T_world_camera[GAP:]
    how = {"max_correspondence_distance": PAIR_REACH, "max_iterations": 50}
    pairs = [
        small_gicp.align(before, after, tree, start, **how).T_target_source
        for (before, tree), (after, _), start in zip(clouds, clouds[GAP:], starts, strict=False)
    ]
    return np.stack(pairs)


def pair_errors(path, pairs: np.ndarray) -> np.ndarray:
    """How far (m) each frame's position, seen from the frame `GAP` before, is off its pair."""
    poses = path.T_world_camera
    off = (np.linalg.inv(poses[:-GAP]) @ poses[GAP:] - pairs)[:, :3, 3]
    return np.linalg.norm(off, axis=1)


def in_blocks(values: np.ndarray) -> np.ndarray:
    """Means (DRAWS,) of bootstrap samples of blocks of values; all paths have the same blocks."""
    n_blocks = -(-len(values) // BLOCK)
    first = np.random.default_rng(0).integers(len(values), size=(DRAWS, n_blocks, 1))
    return values[(first + np.arange(BLOCK)) % len(values)].mean(axis=(1, 2))


if __name__ == "__main__":
    main(sys.argv[1:])
