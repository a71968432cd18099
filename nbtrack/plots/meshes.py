"""Surfaces of maps as coloured meshes, the part of them that was seen, and files of meshes."""

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from skimage.measure import marching_cubes
from trimesh.visual.color import srgb_to_linear

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
    """The coloured mesh (m, world frame) of a field's surface, by marching cubes.

    The cells of the grid have an edge of `voxel` metres. A field has values even where no camera
    has looked. With a sequence only faces are kept whose corners were all seen by its frames, or by
    those with the indices `frames`. A `PointCloud`, which has no surface, is returned as points.
    Raises DataError if there is no surface, or none was seen.
    """
    if isinstance(field, PointCloud):
        colors = (255 * field.colors).round().byte()
        return trimesh.PointCloud(field.points.cpu().numpy(), colors.cpu().numpy())
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])
    x, y, z = [np.arange(a, b + voxel, voxel) for a, b in zip(low, high, strict=True)]
    # A generator of layers of the grid: all points of a large room would be gigabytes.
    layers = (np.stack(np.meshgrid(x_layer, y, z, indexing="ij"), axis=-1) for x_layer in x)
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
    """The exact distance (m) of a room as a field, with the bounds of a map and a grey colour."""

    name, label, surface_level = "exact", "exact distance", 0.0

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
    """The mesh (m, world frame) of a room's exact surface within a map's bounds, coloured.

    Like the mesh of the map, it has only what the frames of the sequence have seen.
    """
    mesh = extract_mesh(ExactDistance(room, mapped), sequence, voxel=voxel)
    # The colour of a vertex is what a short ray sees that hits the surface there from free space.
    # Normals may point to either side; the sign is 1 where they point to free space, else -1.
    step = 0.5 * voxel * mesh.vertex_normals
    sign = np.sign(room.sdf(mesh.vertices + step) - room.sdf(mesh.vertices - step))[:, None]
    _, colors, _ = room.cast(mesh.vertices + sign * step, -sign * step)
    mesh.visual.vertex_colors = (255 * colors).round().astype(np.uint8)
    return mesh


def mesh_bytes(mesh: Mesh, kind: str, origin: Position, up: Position | None = None) -> bytes:
    """The content of a PLY or GLB file (`kind`) of a mesh, in the world frame of its recording.

    `origin` (m) is the position of the mesh's world origin in that frame. `up` is the axis of the
    world that points up (a unit vector; None: y): a GLB file is turned, since its y points up by
    convention. A PLY file keeps the axes.
    """
    if kind == "glb":
        return _glb_bytes(mesh, origin, np.array([0.0, 1, 0] if up is None else up))
    return _ply_bytes(mesh, origin)


def _glb_bytes(mesh: Mesh, origin: Position, up: Position) -> bytes:
    """A GLB file of a mesh, with linear colours, as GLB asks for.

    GLB has single precision only, which resolves decimetres at an origin of millions of metres. So
    the mesh stays as it is, and the transform of its node turns and moves it.
    """
    # The rows of the rotation are the file's axes x, y and z in the world: a horizontal axis, up,
    # and the axis that completes a right-handed frame.
    horizontal = np.array([0.0, 0, 1] if up[0] else [1.0, 0, 0])
    T_file_mesh = np.eye(4)
    T_file_mesh[:3, :3] = horizontal, up, np.cross(horizontal, up)
    T_file_mesh[:3, 3] = T_file_mesh[:3, :3] @ origin
    colors = np.array(mesh.visual.vertex_colors)
    colors[:, :3] = (255 * srgb_to_linear(colors[:, :3])).round()
    mesh = mesh.copy()
    mesh.visual.vertex_colors = colors
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=T_file_mesh)
    return scene.export(file_type="glb")


def _ply_bytes(mesh: Mesh, origin: Position) -> bytes:
    """A PLY file of a mesh that is moved by `origin` (m), with sRGB colours, as those of images.

    A moved mesh has double precision: single precision resolves decimetres at an origin of millions
    of metres, as geographic coordinates have.
    """
    content = mesh.export(file_type="ply", vertex_normal=False)
    if not origin.any():
        return content
    # trimesh writes single precision. Its vertices, the first part of the body, are replaced.
    head, end, body = content.partition(b"end_header\n")
    single = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])
    double = np.dtype([("xyz", "<f8", 3), ("rgba", "u1", 4)])
    vertices = np.frombuffer(body, single, len(mesh.vertices)).astype(double)
    vertices["xyz"] = mesh.vertices + origin
    head = head.replace(b"property float", b"property double")
    return head + end + vertices.tobytes() + body[len(vertices) * single.itemsize :]


@torch.no_grad()
def query_field(field: Field, points_world: GridPoints) -> tuple[np.ndarray, np.ndarray]:
    """Colours (*shape, 3) and values (*shape,) of a field at points, in batches to bound memory."""
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32)).view(-1, 3)
    answers = [field(part.to(field.device)) for part in points.split(_POINTS_AT_ONCE)]
    colors, values = (torch.cat(parts).cpu().numpy() for parts in zip(*answers, strict=True))
    return colors.reshape(points_world.shape), values.reshape(points_world.shape[:-1])


def seen_by(
    points_world: GridPoints, sequence: RgbdSequence, frames: Frames | None = None
) -> Bool[np.ndarray, "*shape"]:
    """Whether each point (m) was seen: in view of a frame, under 0.1 m behind what it measured.

    `frames` are indices in the sequence, by default all; every fifth of them is used.
    """
    points = torch.from_numpy(np.ascontiguousarray(points_world, np.float32)).view(-1, 3)
    frames = np.arange(len(sequence)) if frames is None else frames
    behind = min_depth_behind(points, sequence, frames)
    return behind.numpy().reshape(points_world.shape[:-1]) < 0.1
