"""How good a map is: held-out images, and distances and meshes against the exact surface."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from nbtrack.core.errors import DataError
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField
from nbtrack.fields.points import PointField
from nbtrack.fields.views import render_rays
from nbtrack.mapping.meshes import extract_mesh, keep_seen, query_field, seen_by
from nbtrack.synthetic import Room, true_surface_points

Frames = Int[np.ndarray, "frames"]

F_SCORE_THRESHOLD = 0.05  # m
NEAR_SURFACE = 0.05  # m: distances below this count as near a surface
_PIXELS_SCORED = 20_000
_POINTS_SCORED = 20_000


@dataclass(frozen=True)
class MapQuality:
    """Scores of one map. None where the truth is not known, or the field has no such answer.

    A cloud of points is no mesh and cannot be rendered: its points take the mesh's place.
    """

    psnr_db: float | None = None  # of held-out colour
    depth_l1_m: float | None = None  # of held-out depth
    sdf_near_m: float | None = None  # mean |error| where the true distance is below 5 cm
    sdf_free_m: float | None = None  # mean |error| elsewhere in seen free space
    mesh_accuracy_m: float | None = None  # mean distance of the mesh from the true surface
    mesh_completion_m: float | None = None  # mean distance of the true surface from the mesh
    mesh_f_score: float | None = None  # at 5 cm, in [0, 1]

    def to_dict(self) -> dict[str, float | None]:
        """The fields by name, for JSON and tables."""
        return asdict(self)


def score_map(
    field: Field,
    sequence: RgbdSequence,
    mapped: Int[np.ndarray, "mapped"],
    held_out: Int[np.ndarray, "held_out"],
    room: Room | None,
    voxel: float = 0.05,
) -> MapQuality:
    """All scores that the data allow.

    Args:
        mapped: indices of the frames the field was fitted to: they say what has been seen.
        held_out: indices of the frames kept back; may be empty.
        room: the exact scene, if it is a synthetic one.
    """
    scores: dict[str, float] = {}
    if len(held_out) and isinstance(field, LearnedField):
        scores |= score_images(field, sequence, held_out)
    if room is not None:
        if hasattr(field, "sdf_gradient"):
            scores |= score_sdf(field, sequence, mapped, room)
        if isinstance(field, PointField):
            scores |= score_points(field, sequence, mapped, room)
        else:
            scores |= score_mesh(field, sequence, mapped, room, voxel)
    return MapQuality(**scores)


def score_images(field: Field, sequence: RgbdSequence, held_out: Frames) -> dict[str, float]:
    """PSNR (dB) and depth L1 (m) over random measured pixels of held-out frames."""
    device = next(field.parameters()).device
    sampler = PixelSampler(sequence, device)
    generator = torch.Generator(device).manual_seed(0)
    frames = torch.from_numpy(held_out).to(device)
    rays = sampler.draw(_PIXELS_SCORED, generator, frames)
    squares, errors = [], []
    for part in torch.nonzero(rays.depth > 0).squeeze(-1).split(4096):
        color, depth = render_rays(field, rays.origins_world[part], rays.directions_world[part])
        squares.append((color - rays.color[part]).square())
        errors.append((depth - rays.depth[part]).abs())
    mean_square = torch.cat(squares).mean().item()
    return {
        "psnr_db": -10 * float(np.log10(mean_square)),
        "depth_l1_m": torch.cat(errors).mean().item(),
    }


def score_sdf(field: Field, sequence: RgbdSequence, mapped: Frames, room: Room) -> dict[str, float]:
    """Mean |error| (m) of the signed distance near surfaces and in free space that was seen.

    Points lie on rays of the mapped frames: half of them between camera and surface, half within
    5 cm of the measured surface. What counts as near is decided by the true distance.
    """
    points = _points_along_rays(sequence, mapped)
    true_sdf = room.sdf(points)
    error = np.abs(query_field(field, points)[1] - true_sdf)
    near = np.abs(true_sdf) < NEAR_SURFACE
    return {
        "sdf_near_m": float(error[near].mean()),
        "sdf_free_m": float(error[~near & (true_sdf > 0)].mean()),
    }


def score_mesh(
    field: Field, sequence: RgbdSequence, mapped: Frames, room: Room, voxel: float
) -> dict[str, float]:
    """Accuracy, completion (m) and F-score at 5 cm of the seen part of the mesh.

    Accuracy needs no sampling of the truth: the exact distance at each point of the mesh is its
    distance from the surface. A map that has no surface yet gets no scores.
    """
    try:
        mesh = keep_seen(extract_mesh(field, voxel), sequence, mapped)
    except DataError:
        return {}
    if len(mesh.faces) == 0:
        return {}
    return _score_surface(mesh.sample(_POINTS_SCORED, seed=0), sequence, mapped, room)


def score_points(
    field: PointField, sequence: RgbdSequence, mapped: Frames, room: Room
) -> dict[str, float]:
    """The scores of a mesh, of the map's points: as many as are drawn on a mesh."""
    order = np.random.default_rng(0).permutation(len(field.points))[:_POINTS_SCORED]
    points = field.points.cpu().double().numpy()[order]
    return _score_surface(points, sequence, mapped, room) if len(points) else {}


def _score_surface(
    points: Float[np.ndarray, "n 3"], sequence: RgbdSequence, mapped: Frames, room: Room
) -> dict[str, float]:
    to_truth = np.abs(room.sdf(points))
    truth = true_surface_points(room, _POINTS_SCORED, seed=0)
    truth = truth[seen_by(truth, sequence, mapped)]
    to_mesh = cKDTree(points).query(truth)[0]
    precision = float((to_truth < F_SCORE_THRESHOLD).mean())
    recall = float((to_mesh < F_SCORE_THRESHOLD).mean())
    return {
        "mesh_accuracy_m": float(to_truth.mean()),
        "mesh_completion_m": float(to_mesh.mean()),
        "mesh_f_score": 2 * precision * recall / max(precision + recall, 1e-9),
    }


def _points_along_rays(sequence: RgbdSequence, mapped: Frames) -> Float[np.ndarray, "n 3"]:
    """World points (m, float64) in seen free space and around seen surfaces."""
    generator = torch.Generator().manual_seed(0)
    sampler = PixelSampler(sequence, torch.device("cpu"))
    rays = sampler.draw(_POINTS_SCORED, generator, torch.from_numpy(mapped))
    offsets = torch.rand(len(rays.depth), generator=generator)
    in_front = rays.depth * offsets
    around = rays.depth + NEAR_SURFACE * (2 * offsets - 1)
    half = torch.arange(len(rays.depth)) % 2 == 0
    depths = torch.where(half, in_front, around)
    points = rays.points(depths[:, None])[:, 0]
    return points[rays.depth > 0].double().numpy()
