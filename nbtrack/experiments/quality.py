"""Scores of a map against held-out images, and against the exact surface of a synthetic room."""

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from nbtrack.core.arrays import Frames, Values
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField
from nbtrack.machinery.errors import DataError
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import split_holdout
from nbtrack.plots.meshes import extract_mesh, query_field
from nbtrack.synthetic import Room

Scores = dict[str, float | None]
SCORES = (
    "psnr_db",  # of held-out colour
    "depth_l1_m",  # mean |error| of held-out depth, against exact depth in rooms, else measured
    "sdf_near_m",  # mean |error| of the distance where the true distance is below 5 cm
    "sdf_free_m",  # mean |error| of the distance elsewhere in free space that was seen
    "mesh_accuracy_m",  # mean distance of the mesh from the true surface
    "mesh_completion_m",  # mean distance of the true surface from the mesh
    "mesh_f_score",  # at 5 cm, in [0, 1]
)
NEAR = 0.05  # m: closer points are near a surface; for the F-score they lie on it
POINTS_SCORED = 20_000  # on the surface of a map, and on rays through as many pixels


def score_map(finished: Map, sequence: RgbdSequence, room: Room | None = None) -> Scores:
    """The scores, named by `SCORES`, of a map of a sequence; None for those that it cannot have.

    Images are scored if the field is learned and frames were held out. Distances are scored if the
    field is a distance, and surfaces in any field, both only in a synthetic `room`, whose geometry
    is known, and only where mapped frames saw the room.
    """
    field = finished.field
    scores = dict.fromkeys(SCORES)
    mapped, held_out = split_holdout(len(sequence), finished.record["settings"]["holdout_every"])
    if len(held_out) and isinstance(field, LearnedField):
        generator = torch.Generator(field.device).manual_seed(0)
        scores |= _score_images(field, _random_rays(sequence, held_out, generator), room)
    if room is not None:
        generator = torch.Generator().manual_seed(0)  # on the CPU, as the room's geometry is
        rays = _random_rays(sequence, mapped, generator)
        if field.is_distance:
            scores |= _score_sdf(field, rays, generator, room)
        scores |= _score_surface(field, sequence, mapped, rays, room)
    return scores


def _random_rays(sequence: RgbdSequence, frames: Frames, generator: torch.Generator) -> Rays:
    """Rays through `POINTS_SCORED` random pixels of some frames, on the generator's device."""
    indices = torch.from_numpy(frames).to(generator.device)
    return PixelSampler(sequence, generator.device).draw(POINTS_SCORED, generator, indices)


def _score_images(field: LearnedField, rays: Rays, room: Room | None) -> Scores:
    """PSNR (dB) of colour and L1 (m) of depth, over rays of held-out frames with a measured depth.

    Depth is compared with the exact depth in a room, without one with the measured depth.
    """
    is_measured = rays.depth > 0
    if not is_measured.any():
        return {}
    origins, directions = rays.origins_world[is_measured], rays.directions_world[is_measured]
    color, depth = field.render_rays(origins, directions)
    psnr_db = -10 * float(np.log10((color - rays.color[is_measured]).square().mean().item()))
    reference = (rays.depth if room is None else _exact_depths(rays, room))[is_measured]
    return {"psnr_db": psnr_db, "depth_l1_m": (depth - reference).cpu().abs().mean().item()}


def _exact_depths(rays: Rays, room: Room) -> Values:
    """The z-depth (m) at which each ray meets the room's surface."""
    origins_world, directions_world = rays.origins_world.cpu(), rays.directions_world.cpu()
    depth, _ = room.first_hit(origins_world.double().numpy(), directions_world.double().numpy())
    return torch.from_numpy(depth).to(rays.depth)


def _score_sdf(field: Field, rays: Rays, generator: torch.Generator, room: Room) -> Scores:
    """Mean |error| (m) of the signed distance, near surfaces and in free space that was seen.

    It is taken over points on rays of mapped frames. Half of the points lie between the camera and
    the measured surface, half within `NEAR` of the surface along the optical axis.
    """
    offsets = torch.rand(len(rays.depth), generator=generator, dtype=torch.float32)
    is_in_front = torch.arange(len(rays.depth)) % 2 == 0
    near_surface = rays.depth + NEAR * (2 * offsets - 1)
    depths = torch.where(is_in_front, rays.depth * offsets, near_surface)
    # `points` takes several depths for each ray; here it is one.
    points_world = rays.points(depths[:, None])[rays.depth > 0, 0].double().numpy()
    true_sdf = room.sdf(points_world)
    _, sdf = query_field(field, points_world)
    error = np.abs(sdf - true_sdf)
    is_near = np.abs(true_sdf) < NEAR
    is_free = ~is_near & (true_sdf > 0)
    return {"sdf_near_m": float(error[is_near].mean()), "sdf_free_m": float(error[is_free].mean())}


def _score_surface(
    field: Field, sequence: RgbdSequence, mapped: Frames, rays: Rays, room: Room
) -> Scores:
    """Accuracy (m), completion (m) and F-score of the part of a map's surface that was seen.

    Points of the true surface are those where `rays` of mapped frames meet the room, at most one in
    each cell of 5 cm. So surfaces near the camera, where rays are dense, count no more than far
    ones. Empty if the map has no surface where frames looked.
    """
    try:
        mesh = extract_mesh(field, sequence, mapped)
    except DataError:
        return {}
    if isinstance(mesh, trimesh.PointCloud):  # of a map of points, which has no faces
        points = np.random.default_rng(0).permutation(mesh.vertices)[:POINTS_SCORED]
    else:
        points = mesh.sample(POINTS_SCORED, seed=0)
    hits_world = rays.points(_exact_depths(rays, room)[:, None])[rays.depth > 0, 0].numpy()
    cells = np.floor(hits_world / NEAR).astype(int)
    _, one_in_each_cell = np.unique(cells, axis=0, return_index=True)
    to_truth = np.abs(room.sdf(points))  # m, from the map's surface
    to_map, _ = cKDTree(points).query(hits_world[one_in_each_cell])  # m, from the true surface
    precision, recall = float((to_truth < NEAR).mean()), float((to_map < NEAR).mean())
    return {
        "mesh_accuracy_m": float(to_truth.mean()),
        "mesh_completion_m": float(to_map.mean()),
        "mesh_f_score": 2 * precision * recall / max(precision + recall, 1e-9),  # 0, not NaN
    }
