"""Triangle meshes of fields, and which part of a surface a sequence has seen."""

from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from skimage.measure import marching_cubes

from nbtrack.core.camera import project
from nbtrack.core.errors import DataError
from nbtrack.core.files import write_bytes_atomic
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field

_POINTS_AT_ONCE = 65_536


def extract_mesh(field: Field, voxel: float = 0.05) -> trimesh.Trimesh:
    """Coloured mesh (m, world frame) of the field's surface, by marching cubes.

    Args:
        voxel: edge length of the grid's cells, m.

    Raises:
        DataError: the field has no surface inside its bounds.
    """
    low, high = np.array(field.bounds.minimum), np.array(field.bounds.maximum)
    axes = [np.arange(a, b + voxel, voxel) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = query_field(field, points)[1].reshape([len(axis) for axis in axes])
    if not values.min() < field.surface_level < values.max():
        raise DataError(
            f"the {field.label} map has no surface: its values lie in [{values.min():.3g}, "
            f"{values.max():.3g}], all on one side of {field.surface_level:g}; map for longer"
        )
    vertices, faces, _, _ = marching_cubes(values, field.surface_level, spacing=(voxel,) * 3)
    vertices = vertices + low
    colors = query_field(field, vertices)[0]
    colors_255 = (255 * colors).round().astype(np.uint8)
    return trimesh.Trimesh(vertices, faces, vertex_colors=colors_255, process=False)


def write_mesh(path: Path, mesh: trimesh.Trimesh, file_type: str = "ply") -> None:
    """Writes a mesh with the colours of its vertices, as PLY or as binary glTF ("glb").

    The world frame stays as it is (m): viewers that take y for up show rooms whose z is up lying
    on their side.
    """
    write_bytes_atomic(path, mesh.export(file_type=file_type))


@torch.no_grad()
def query_field(
    field: Field, points_world: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Colours and values at any number of points (m), some at a time to bound the memory."""
    device = next(field.parameters()).device
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32))
    results = [field(part.to(device)) for part in points.split(_POINTS_AT_ONCE)]
    colors, values = zip(*results, strict=True)
    return torch.cat(colors).cpu().numpy(), torch.cat(values).cpu().numpy()


def keep_seen(
    mesh: trimesh.Trimesh, sequence: RgbdSequence, frames: Int[np.ndarray, "frames"] | None = None
) -> trimesh.Trimesh:
    """The faces all of whose corners a sequence, or those of its frames, has seen.

    A field says something everywhere; what no camera looked at is invention and is neither shown
    nor scored.
    """
    seen = seen_by(mesh.vertices, sequence, frames)
    kept = mesh.copy()
    kept.update_faces(seen[mesh.faces].all(axis=1))
    kept.remove_unreferenced_vertices()
    return kept


def seen_by(
    points_world: Float[np.ndarray, "n 3"],
    sequence: RgbdSequence,
    frames: Int[np.ndarray, "frames"] | None = None,
    tolerance: float = 0.1,
    every: int = 5,
) -> Bool[np.ndarray, "n"]:
    """Whether a point (m) lies in some frame's view and not behind what that frame measured.

    Args:
        frames: indices of the frames to ask; by default all.
        tolerance: how far (m) behind the measured depth a point may lie.
        every: only each `every`-th frame is asked: neighbours see the same.
    """
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32))
    seen = torch.zeros(len(points), dtype=torch.bool)
    intrinsics = sequence.intrinsics
    frames = np.arange(len(sequence)) if frames is None else frames
    for index in frames[::every].tolist():
        T_world_camera = torch.from_numpy(sequence.T_world_camera[index]).float()
        points_camera = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        columns, rows, depth = project(intrinsics, points_camera)
        columns, rows = columns.round(), rows.round()
        inside = (depth > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < intrinsics.width) & (rows < intrinsics.height)
        measured = torch.from_numpy(sequence.depth(index))
        at_pixel = measured[rows[inside].long(), columns[inside].long()]
        seen[inside] |= (at_pixel > 0) & (depth[inside] < at_pixel + tolerance)
    return seen.numpy()
