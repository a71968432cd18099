"""How good a map is, against held-out images and the exact surface; and whether it belongs."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from nbtrack.core.arrays import Frames, Values
from nbtrack.core.camera import pixel_directions
from nbtrack.core.errors import DataError
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field, LearnedField, PointCloud
from nbtrack.mapping.files import Map
from nbtrack.mapping.meshes import extract_mesh, query_field
from nbtrack.synthetic import Room

Scores = dict[str, float | None]
SCORES = (
    "psnr_db",  # of held-out colour
    "depth_l1_m",  # of held-out depth: the exact one of synthetic rooms, else the measured
    "sdf_near_m",  # mean |error| where the true distance is below 5 cm
    "sdf_free_m",  # mean |error| elsewhere in seen free space
    "mesh_accuracy_m",  # mean distance of the mesh from the true surface
    "mesh_completion_m",  # mean distance of the true surface from the mesh
    "mesh_f_score",  # at 5 cm, in [0, 1]
)
NEAR = 0.05  # m: distances below this count as near a surface, and as found by the F-score
POINTS_SCORED = 20_000  # on surfaces and along rays; as many pixels
_MISFIT_PIXELS, _MISFIT_FRAMES = 500, 10
# A map is refused where its misfit exceeds both. Measured on nine maps of three rooms (one a real
# recording): frames of the same room 0.024 m at most, of other rooms 0.095 m at least.
MISFIT_FACTOR, MISFIT_ALLOWED = 3.0, 0.05  # times what is usual in the map's own frames; m


def split_holdout(n_frames: int, every: int) -> tuple[Frames, Frames]:
    """Indices of the frames to map and of those kept back for scoring.

    Every `every`-th frame is kept back, beginning in the middle of the first stretch; with
    `every` = 0, or too few frames, none is.

    >>> split_holdout(6, 3)
    (array([0, 2, 3, 5]), array([1, 4]))
    """
    indices = np.arange(n_frames)
    if every < 2 or n_frames < every:
        return indices, indices[:0]
    held_out = indices[every // 2 :: every]
    return np.setdiff1d(indices, held_out), held_out


def score_map(finished: Map, sequence: RgbdSequence, room: Room | None = None) -> Scores:
    """`SCORES` of a map of a sequence; None where its field has no such answer, or without truth.

    Only what the mapped frames have seen counts. The truth is known of synthetic rooms only.
    """
    field, scores = finished.field, dict.fromkeys(SCORES)
    mapped, held_out = split_holdout(len(sequence), finished.record["settings"]["holdout_every"])
    if len(held_out) and isinstance(field, LearnedField):
        scores |= _score_images(field, sequence, held_out, room)
    if room is not None:
        generator = torch.Generator().manual_seed(0)
        sampler = PixelSampler(sequence, torch.device("cpu"))
        rays = sampler.draw(POINTS_SCORED, generator, torch.from_numpy(mapped))
        if field.is_distance:
            scores |= _score_sdf(field, rays, generator, room)
        scores |= _score_surface(field, sequence, mapped, rays, room)
    return scores


def _score_images(
    field: LearnedField, sequence: RgbdSequence, held_out: Frames, room: Room | None
) -> Scores:
    """PSNR (dB) and depth L1 (m) over random measured pixels of held-out frames."""
    generator = torch.Generator(field.device).manual_seed(0)
    frames = torch.from_numpy(held_out).to(field.device)
    rays = PixelSampler(sequence, field.device).draw(POINTS_SCORED, generator, frames)
    hit = rays.depth > 0
    if not hit.any():
        return {}
    origins, directions = rays.origins_world[hit], rays.directions_world[hit]
    color, depth = field.render_rays(origins, directions)
    psnr_db = -10 * float(np.log10((color - rays.color[hit]).square().mean().item()))
    reference = (rays.depth if room is None else _exact_depths(rays, room))[hit]
    return {"psnr_db": psnr_db, "depth_l1_m": (depth - reference).cpu().abs().mean().item()}


def _exact_depths(rays: Rays, room: Room) -> Values:
    """The z-depth (m) at which each ray meets the room's surface."""
    exact = (part.cpu().double().numpy() for part in (rays.origins_world, rays.directions_world))
    return torch.from_numpy(room.first_hit(*exact)[0]).to(rays.depth)


def _score_sdf(field: Field, rays: Rays, generator: torch.Generator, room: Room) -> Scores:
    """Mean |error| (m) of the signed distance near surfaces and in free space that was seen.

    Points lie on rays of mapped frames: half between camera and surface, half near the surface.
    """
    offsets = torch.rand(len(rays.depth), generator=generator)
    is_in_front = torch.arange(len(rays.depth)) % 2 == 0
    around = rays.depth + NEAR * (2 * offsets - 1)
    depths = torch.where(is_in_front, rays.depth * offsets, around)
    points = rays.points(depths[:, None])[:, 0][rays.depth > 0].double().numpy()
    true_sdf = room.sdf(points)
    error, is_near = np.abs(query_field(field, points)[1] - true_sdf), np.abs(true_sdf) < NEAR
    is_free = ~is_near & (true_sdf > 0)
    return {"sdf_near_m": float(error[is_near].mean()), "sdf_free_m": float(error[is_free].mean())}


def _score_surface(field: Field, sequence, mapped: Frames, rays: Rays, room: Room) -> Scores:
    """Accuracy, completion (m) and F-score of the seen part of a map's surface, if it has one.

    The true surface is where rays of mapped frames meet the room, one point a cell of 5 cm: what is
    near the camera counts no more than what is far.
    """
    try:
        mesh = extract_mesh(field, sequence, mapped)
    except DataError:
        return {}
    if isinstance(field, PointCloud):
        points = np.random.default_rng(0).permutation(mesh.vertices)[:POINTS_SCORED]
    else:
        points = mesh.sample(POINTS_SCORED, seed=0)
    true_points = rays.points(_exact_depths(rays, room)[:, None])[rays.depth > 0, 0].numpy()
    cells = np.floor(true_points / NEAR).astype(int)
    true_points = true_points[np.unique(cells, axis=0, return_index=True)[1]]
    to_truth, to_map = np.abs(room.sdf(points)), cKDTree(points).query(true_points)[0]
    precision, recall = float((to_truth < NEAR).mean()), float((to_map < NEAR).mean())
    return {
        "mesh_accuracy_m": float(to_truth.mean()),
        "mesh_completion_m": float(to_map.mean()),
        "mesh_f_score": 2 * precision * recall / max(precision + recall, 1e-9),
    }


def depth_residual_of(field: Field, frame: Frame) -> float:
    """How far (m) a map is from what a frame measured, at the frame's given pose.

    The median over random pixels of |rendered depth - measured depth|; of points and grids, which
    cannot be rendered, the distance at what was measured. NaN where nothing was.
    """
    if not frame.has_depth:
        return float("nan")
    frame = frame.to(field.device)
    pixels = frame.measured_pixels()
    order = torch.randperm(pixels.shape[1], generator=torch.Generator().manual_seed(0))
    rows, columns = pixels[:, order[:_MISFIT_PIXELS].to(pixels.device)]
    T_world_camera = torch.from_numpy(frame.T_world_camera).float().to(rows.device)
    if not isinstance(field, LearnedField):
        points_world = transform_points(T_world_camera, frame.points(rows, columns)[0])
        return float(field(points_world)[1].abs().median())
    directions = pixel_directions(frame.camera, columns, rows) @ T_world_camera[:3, :3].T
    origins, measured = T_world_camera[:3, 3].expand_as(directions), frame.at(rows, columns)[1]
    return float((field.render_rays(origins, directions)[1] - measured).abs().median())


def usual_depth_residual(field: Field, sequence: RgbdSequence, mapped: Frames) -> float:
    """The median misfit (m) of some of the mapped frames, evenly spread; 0 if none has a depth."""
    spread = np.linspace(0, len(mapped) - 1, min(_MISFIT_FRAMES, len(mapped))).round().astype(int)
    frames = [sequence[index] for index in mapped[spread].tolist()]
    return float(np.median([depth_residual_of(field, f) for f in frames if f.has_depth] or [0.0]))


def check_belongs(finished: Map, frame: Frame) -> str | None:
    """A warning where it cannot be told whether a map belongs to a frame; None where it does.

    The rule: its misfit is at most 5 cm, or three times what is usual in the map's own frames.
    Raises DataError if it is more.
    """
    name, usual = f"the map of {finished.record['scene']}", finished.record["misfit_m"]
    misfit_m = depth_residual_of(finished.field, frame)
    if np.isnan(misfit_m):
        return f"{frame.name} has no depth: whether {name} belongs to it cannot be told"
    allowed = max(MISFIT_ALLOWED, MISFIT_FACTOR * usual)
    if misfit_m > allowed:
        raise DataError(
            f"at its given pose {frame.name} is off {name} by {misfit_m:.3f} m (usual in this map "
            f"{usual:.3f} m, allowed {allowed:.3f} m): give the room's own map, poses in the map's "
            "world frame, begin where it was mapped, or let the camera be found: --start unknown"
        )
    return None
