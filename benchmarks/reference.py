"""What errors against reference poses say where the reference itself is off.

    python benchmarks/reference.py [RECORDING]

Writes to paper_tables/corrected: reference.csv, of rooms whose mapped poses were moved, so that the
truth is known; and, of a recording, consistency.csv: poses that its depth alone was made to agree
on, beside the given and the tracked ones, and how well its colours then agree, which took no part.
Both say how far positions of frames a little apart are from what generalised ICP makes of these two
frames' points alone, which knows no map.
"""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import small_gicp
import torch
from scipy import sparse
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.linalg import lsqr
from scipy.spatial.transform import Rotation

from nbtrack import METHODS, load_preset, make_tracker, open_scene, open_scenes
from nbtrack.core.device import choose_device, device_name
from nbtrack.core.files import tables_folder
from nbtrack.core.settings import with_settings
from nbtrack.data.pixels import PixelSampler
from nbtrack.fields import correction
from nbtrack.fields.base import intensity_of
from nbtrack.fields.grid import BakedField
from nbtrack.mapping.correct import correct_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.tables import write_csv
from nbtrack.tracking import StepBudget, track_sequence
from nbtrack.tracking.lm_solver import draw_points

TRACKED = METHODS["corrected_dense"], METHODS["icp_dense"]
# Smooth errors like a registration's: so far (m, degrees) about a point ahead (m), with so many
# frames' correlation.
OFF_M, OFF_DEG, AHEAD, SMOOTH = 0.006, 0.25, 1.5, 4
# Cells (m) and points a frame, for depth and for colours; and how often poses are solved for.
VOXEL, POINTS, COLOR_VOXEL, COLOR_POINTS, ROUNDS = 0.04, 2500, 0.02, 10_000, 3
# Frames between the two of a pair, points of each, and cells (m) and reach (m) of registering them.
GAP, PAIR_POINTS, PAIR_VOXEL, PAIR_REACH = 5, 16_384, 0.02, 0.05


def main() -> None:
    """Both experiments; the second where a recording is given."""
    torch.set_num_threads(1)
    preset, rows = load_preset("smoke"), []
    for scene in open_scenes(preset):
        truth = scene.read(":120")
        for seed in (0, 1):
            given = replace(truth, T_world_camera=moved_poses(truth.T_world_camera, seed))
            paths = {"reference": given, "truth": truth}
            paths |= {method.label: tracked_path(method, given, preset) for method in TRACKED}
            pairs = registered_pairs(given)
            for name, path in paths.items():
                off = apart(path, given), apart(path, truth), from_pairs(path, pairs)
                rows.append((scene.name, seed, name, *off))
    columns = ["scene", "seed", "path", "from_reference_m", "from_truth_m", "from_pairs_m"]
    table = pd.DataFrame(rows, columns=columns)
    print(table.groupby("path")[columns[3:]].mean())
    folder, made = tables_folder() / "corrected", {"device": device_name(choose_device())}
    write_csv(folder / "reference.csv", table.assign(**made))
    for recording in sys.argv[1:]:
        given = open_scene(recording, preset).read()
        table = consistency(given, preset).assign(**made)
        print(table.to_string())
        write_csv(folder / "consistency.csv", table)


def moved_poses(poses: np.ndarray, seed: int) -> np.ndarray:
    """Poses (camera to world) with smooth errors, turns about a point ahead of the camera."""
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
    if getattr(settings, "correct_voxel", 0.0):
        made = correct_map(made, sequence, settings)
    how = sequence.T_world_camera[0], StepBudget(30), changed.tracking_of(method.tracker)
    found = track_sequence(make_tracker(method.tracker, made.field, *how), sequence)
    given = sequence.T_world_camera[:1]
    return replace(sequence, T_world_camera=np.concatenate([given, found.T_estimated]))


def apart(path, other, aligned: bool = False) -> float:
    """RMS distance (m) of two paths' positions, but for the first, which trackers are given."""
    a, b = (sequence.T_world_camera[1:, :3, 3] for sequence in (path, other))
    if aligned:
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        a = a @ Rotation.align_vectors(b, a)[0].as_matrix().T
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def registered_pairs(sequence) -> np.ndarray:
    """Poses of frames in the frame `GAP` before, by their points alone; the sequence's own poses
    are the starts."""
    seeded, clouds = torch.Generator().manual_seed(0), []
    for index in range(len(sequence)):
        points = draw_points(sequence[index], PAIR_POINTS, seeded)[0]
        clouds.append(small_gicp.preprocess_points(points, downsampling_resolution=PAIR_VOXEL))
    starts = np.linalg.inv(sequence.T_world_camera[:-GAP]) @ sequence.T_world_camera[GAP:]
    pairs = [
        small_gicp.align(
            before, after, tree, start, max_correspondence_distance=PAIR_REACH, max_iterations=50
        ).T_target_source
        for (before, tree), (after, _), start in zip(
            clouds[:-GAP], clouds[GAP:], starts, strict=True
        )
    ]
    return np.stack(pairs)


def from_pairs(path, pairs: np.ndarray) -> float:
    """RMS distance (m) of positions in the frame `GAP` before from those of registered pairs."""
    poses = path.T_world_camera
    off = (np.linalg.inv(poses[:-GAP]) @ poses[GAP:] - pairs)[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def consistency(given, preset) -> pd.DataFrame:
    """A recording's poses as they are given and as its depth would have them."""
    changed = with_settings(preset, *TRACKED[0].settings)
    settings, network = changed.mapping_of("neus_plus"), changed.network_of("neus_plus")
    source = map_sequence("neus_plus", given, network, settings, device=torch.device("cpu")).field
    refined = given
    for _ in range(ROUNDS):
        twists, _ = solve(refined, source, with_poses=True)
        refined = replace(refined, T_world_camera=twisted(refined.T_world_camera, twists))
    paths = {"reference": given, "made consistent": refined}
    paths |= {method.label: tracked_path(method, given, preset) for method in TRACKED}
    pairs = registered_pairs(given)
    rows = [
        (
            name,
            apart(path, given, aligned=True),
            apart(path, refined, aligned=True),
            solve(path, source, with_poses=False)[1],
            color_difference(path, source),
            from_pairs(path, pairs),
        )
        for name, path in paths.items()
    ]
    columns = [
        "path",
        "from_reference_m",
        "from_consistent_m",
        "depth_m",
        "intensity",
        "from_pairs_m",
    ]
    return pd.DataFrame(rows, columns=columns).assign(scene=given.name)


def twisted(poses: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """Poses turned and moved about their own centres, in world axes."""
    poses = poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += twists[:, 3:]
    return poses


def points_of(sequence, index: int, generator, n_points: int) -> tuple[np.ndarray, ...]:
    """Of a frame: observed points (m, world), normals, arms from the camera, z-depths, luma."""
    sampler, frame = PixelSampler(sequence, torch.device("cpu")), torch.tensor([index])
    rays = sampler.draw(n_points, generator, frame, tangent_planes=True)
    points = rays.points(rays.depth[:, None])[:, 0]
    parts = points, rays.normals_world, points - rays.origins_world
    parts = *parts, rays.depth, intensity_of(rays.color)
    has_plane = rays.normals_world.any(dim=-1)
    return tuple(part[has_plane].double().numpy() for part in parts)


def solve(sequence, source, with_poses: bool) -> tuple[np.ndarray, float]:
    """Twists of all poses (rad, m), solved for together with the grid's corrections; and the median
    distance (m) of points from the surface after that."""
    generator, grid = torch.Generator().manual_seed(0), BakedField(source, VOXEL)
    frames = [points_of(sequence, i, generator, POINTS) for i in range(len(sequence))]
    owner = np.repeat(np.arange(len(frames)), [len(frame[0]) for frame in frames])
    points, normals, arms, depth, _ = (np.concatenate(part) for part in zip(*frames, strict=True))
    offsets = np.repeat(correction._OFFSETS, len(points))
    asked = np.concatenate([points + offset * normals for offset in correction._OFFSETS])
    vertices, weights = correction.interpolation(asked, grid)
    numbers, design, stiffness = correction._unknowns(vertices, weights, grid.n_vertices)
    wanted = offsets - design @ grid.volume[3].double().numpy()[numbers]
    if with_poses:
        jacobian = np.concatenate([np.cross(arms, normals), normals], axis=1)
        columns = 6 * owner[:, None] + np.arange(6)
        rows = np.arange(0, jacobian.size + 1, 6)
        size = (len(points), 6 * len(frames))
        moves = sparse.csr_array((jacobian.ravel(), columns.ravel(), rows), shape=size)
        design = sparse.hstack([design, sparse.vstack([moves] * len(correction._OFFSETS))]).tocsr()
        hold = 10 * sparse.eye_array(size[1])  # so weak that it only keeps the whole in place
        stiffness = sparse.block_diag([stiffness, hold]).tocsr()
    reliability = np.tile((depth.mean() / depth) ** 2, len(correction._OFFSETS))
    nothing = np.zeros((len(wanted), 3))  # of colours
    wishes = np.column_stack([nothing, wanted])
    found = correction._solve(design, stiffness, wishes, reliability)[:, 3]
    at_surface = np.abs(wanted - design @ found)[offsets == 0]
    return found[len(numbers) :].reshape(-1, 6), float(np.median(at_surface))


def color_difference(sequence, source) -> float:
    """Median difference in luma, [0, 1], of odd frames from a grid fitted to the even ones."""
    generator, grid = torch.Generator().manual_seed(1), BakedField(source, COLOR_VOXEL)
    frames = [points_of(sequence, i, generator, COLOR_POINTS) for i in range(len(sequence))]
    designs, lumas = [], []
    for part in (frames[::2], frames[1::2]):
        vertices, weights = correction.interpolation(np.concatenate([f[0] for f in part]), grid)
        rows = np.arange(0, vertices.size + 1, 8)
        shape = (len(vertices), grid.volume.shape[1])
        designs.append(sparse.csr_array((weights.ravel(), vertices.ravel(), rows), shape=shape))
        lumas.append(np.concatenate([frame[-1] for frame in part]))
    luma = lsqr(designs[0], lumas[0], damp=0.3)[0]
    difference = designs[1] @ luma - lumas[1]
    owner = np.repeat(np.arange(len(frames[1::2])), [len(frame[0]) for frame in frames[1::2]])
    # Only where even frames were; and exposure changes from frame to frame.
    is_known = designs[1] @ (designs[0].sum(axis=0) > 0) > 0.999
    table = pd.DataFrame({"frame": owner, "difference": difference})[is_known]
    centred = table["difference"] - table.groupby("frame")["difference"].transform("median")
    return float(centred.abs().median())


if __name__ == "__main__":
    main()
