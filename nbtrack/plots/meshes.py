"""Surfaces of maps as coloured meshes, and which part of them was seen."""

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from skimage.measure import marching_cubes

from nbtrack.beyond.points import PointCloud, min_depth_behind
from nbtrack.core.arrays import Colors, Frames, Points, Position, Values
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.machinery.errors import DataError
from nbtrack.synthetic import Room

_POINTS_AT_ONCE = 65_536
GridPoints = Float[np.ndarray, "*shape 3"]  # m
Mesh = trimesh.Trimesh | trimesh.PointCloud


def extract_mesh(
    field: Field,
    sequence: RgbdSequence | None = None,
    frames: Frames | None = None,
    voxel: float = 0.05,
) -> Mesh:
    """Coloured mesh (m, world frame) of a field's surface, by marching cubes; points as they are.

    A field has a value everywhere, also where no camera looked. With a sequence, a face is kept
    only if each of its corners was seen in a frame of it, or in one of `frames` if they are given.

    The grid's cells have an edge of `voxel` metres. A `PointCloud` has no surface: it is returned
    with its colours. Raises DataError where there is no surface.
    """
    if isinstance(field, PointCloud):
        colors = (255 * field.colors).round().byte()
        return trimesh.PointCloud(field.points.cpu().numpy(), colors.cpu().numpy())
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])
    x, y, z = [np.arange(a, b + voxel, voxel) for a, b in zip(low, high, strict=True)]
    # One at a time: all points of a large place are gigabytes.
    layers = (np.stack(np.meshgrid(place, y, z, indexing="ij"), axis=-1) for place in x)
    values = np.concatenate([query_field(field, layer)[1] for layer in layers])
    if not values.min() < field.surface_level < values.max():
        span = f"[{values.min():.3g}, {values.max():.3g}]"
        found = f"the {field.label} map has no surface: its values lie in {span}"
        raise DataError(f"{found}, all on one side of {field.surface_level:g}; map for longer")
    vertices, faces, _, _ = marching_cubes(values, field.surface_level, spacing=(voxel,) * 3)
    colors, _ = query_field(field, vertices + low)
    rgb = (255 * colors).round().astype(np.uint8)
    mesh = trimesh.Trimesh(vertices + low, faces, vertex_colors=rgb, process=False)
    if sequence is not None:
        mesh.update_faces(seen_by(mesh.vertices, sequence, frames)[faces].all(axis=1))
        mesh.remove_unreferenced_vertices()
    if not len(mesh.faces):
        raise DataError(f"no frame saw the surface of the {field.label} map: map for longer")
    return mesh


class ExactDistance(Field):
    """The exact distance (m) of a room as a field: its colour is grey, its bounds are the map's."""

    name, label, surface_level = "exact", "Exact distance", 0.0

    def __init__(self, room: Room, mapped: Field) -> None:
        super().__init__(mapped.bounds)
        self.room = room

    def forward(self, points_world: Points) -> tuple[Colors, Values]:
        """Grey, and the room's signed distance (m), at points (n, 3; m, world frame)."""
        sdf = self.room.sdf(points_world.cpu().numpy().astype(float))
        return torch.full_like(points_world, 0.5), torch.from_numpy(sdf).float()


def exact_mesh(
    room: Room, mapped: Field, sequence: RgbdSequence, voxel: float = 0.05
) -> trimesh.Trimesh:
    """The mesh (m, world frame) of a room within a map's bounds, in the colours that cameras see.

    As that of the map by `extract_mesh`, it has what the frames of the sequence have seen.
    """
    mesh = extract_mesh(ExactDistance(room, mapped), sequence, voxel=voxel)
    step = 0.5 * voxel * mesh.vertex_normals
    outwards = np.sign(room.sdf(mesh.vertices + step) - room.sdf(mesh.vertices - step))[:, None]
    _, colors, _ = room.cast(mesh.vertices + outwards * step, -outwards * step)
    mesh.visual.vertex_colors = (255 * colors).round().astype(np.uint8)
    return mesh


def mesh_bytes(mesh: Mesh, kind: str, origin: Position, up: Position | None = None) -> bytes:
    """A mesh as a file, "ply" or "glb", in the world of the recording: moved by its origin (m).

    In GLB y is up and colours are linear. `up` is the world's axis that is up (None: y); it is
    turned there. In PLY the axes stay, and colours are sRGB, as those of images.

    With an origin of millions of metres, as in the coordinates of geographic maps, single precision
    resolves decimetres only. So a moved PLY file has double precision; a GLB file, which knows
    none, holds the unmoved mesh and by how much its node is turned and moved.
    """
    if kind == "glb":
        up = np.array([0.0, 1, 0] if up is None else up)
        side = np.array([0.0, 0, 1] if up[0] else [1.0, 0, 0])
        T = np.eye(4)
        T[:3, :3] = side, up, np.cross(side, up)
        T[:3, 3] = T[:3, :3] @ origin
        colors = np.array(mesh.visual.vertex_colors)
        srgb = colors[:, :3] / 255
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        colors[:, :3] = (255 * linear).round()  # IEC 61966-2-1
        mesh = mesh.copy()
        mesh.visual.vertex_colors = colors
        scene = trimesh.Scene()
        scene.add_geometry(mesh, transform=T)
        return scene.export(file_type=kind)
    content = mesh.export(file_type=kind, vertex_normal=False)
    if not origin.any():
        return content
    # The vertices, which are the first part of the body, are replaced.
    head, end, body = content.partition(b"end_header\n")
    single = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])
    double = np.dtype([("xyz", "<f8", 3), ("rgba", "u1", 4)])
    vertices = np.frombuffer(body, single, len(mesh.vertices)).astype(double)
    vertices["xyz"] = mesh.vertices + origin
    head = head.replace(b"property float", b"property double")
    return head + end + vertices.tobytes() + body[len(vertices) * single.itemsize :]


@torch.no_grad()
def query_field(field: Field, points_world: GridPoints) -> tuple[np.ndarray, np.ndarray]:
    """Colours (*shape, 3) and values (*shape,) at points, some at a time to bound the memory."""
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32)).view(-1, 3)
    answers = [field(part.to(field.device)) for part in points.split(_POINTS_AT_ONCE)]
    colors, values = (torch.cat(parts).cpu().numpy() for parts in zip(*answers, strict=True))
    return colors.reshape(points_world.shape), values.reshape(points_world.shape[:-1])


def seen_by(
    points_world: GridPoints, sequence: RgbdSequence, frames: Frames | None = None
) -> Bool[np.ndarray, "*shape"]:
    """Whether points (m) were seen: in view of a frame, at most 0.1 m behind what it measured.

    `frames` are indices in the sequence, by default all; see `min_depth_behind`.
    """
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32)).view(-1, 3)
    frames = np.arange(len(sequence)) if frames is None else frames
    behind = min_depth_behind(points, sequence, frames)
    return behind.numpy().reshape(points_world.shape[:-1]) < 0.1
