"""A map's mesh and paths in a notebook, to be turned by hand."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import trimesh
from trimesh.viewer.notebook import scene_to_notebook

from nbtrack.core.arrays import Poses
from nbtrack.plots.scene import inward_side, screen_axes, up_of
from nbtrack.plots.style import method_colors

_MAX_FACES_TO_TURN = 10_000  # more are merged for the viewer
_MAX_TUBES = 80  # straight pieces of a path in the viewer


def _make_unlit(tree: dict) -> None:
    """One material for all meshes of a scene that shows their colours as they are."""
    tree["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for mesh in tree["meshes"]:
        mesh["primitives"][0]["material"] = 0


def mesh_viewer(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses]) -> Any:
    """A room as in `plot_mesh`, to be turned by hand: HTML. The mouse wheel scrolls the page.

    It adds 1.2 MB to the notebook, 0.7 MB of it the viewer's own.
    """
    viewer = scene_to_notebook(viewer_scene(mesh, T_paths))
    quiet = "<script>addEventListener('wheel', e => e.stopImmediatePropagation(), true)</script>"
    viewer.data = viewer.data.replace("<body>", f"<body>{quiet}", 1)
    return viewer


def viewer_scene(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses]) -> trimesh.Scene:
    """What it shows: the mesh, made coarser, and a tube for each path.

    A tube ends in a pyramid, which opens where the last camera looks.
    """
    room = mesh.copy()
    if len(room.faces) > _MAX_FACES_TO_TURN:  # vertices of a grid cell merge
        cell = np.sqrt(2.2 * room.area / _MAX_FACES_TO_TURN)
        room.apply_scale(1 / cell)
        room.merge_vertices(digits_vertex=0, merge_tex=True, merge_norm=True)
        room.update_faces(room.nondegenerate_faces() & room.unique_faces())
        room.apply_scale(cell)
    if inward_side(room) < 0:
        room.faces = room.faces[:, ::-1]  # the viewer leaves out faces that show their back
    scene = trimesh.Scene({"mesh": room})
    # The viewer's one light leaves sides black: it is switched off (glTF's KHR_materials_unlit).
    scene.export = partial(scene.export, tree_postprocessor=_make_unlit)
    for label, color in method_colors(T_paths).items():
        path = _path_mesh(T_paths[label], 0.004 * mesh.scale)
        path.visual.face_colors = trimesh.visual.color.hex_to_rgba(color)
        scene.add_geometry(path, geom_name=label)
    view = np.eye(4)
    view[:3, :3] = screen_axes(up_of(*T_paths.values()), 15.0).T
    scene.camera = trimesh.scene.Camera(name="viewer", fov=(60, 45))
    scene.camera_transform = scene.camera.look_at(room.vertices, rotation=view)
    return scene


def _path_mesh(T_world_camera: Poses, radius: float) -> trimesh.Trimesh:
    """A tube along camera positions, and a pyramid from the last one to where that camera looks."""
    places = T_world_camera[:, :3, 3]
    corners = places[np.linspace(0, len(places) - 1, _MAX_TUBES + 1).astype(int)]
    segments = np.stack([corners[:-1], corners[1:]], axis=1)
    moved = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > 1e-6
    parts = [trimesh.creation.cylinder(radius, segment=s, sections=6) for s in segments[moved]]
    height = 9 * radius
    tip_first = trimesh.transformations.translation_matrix([0, 0, height]) @ np.diag([1, 1, -1, 1])
    pose = T_world_camera[-1] @ tip_first
    parts.append(trimesh.creation.cone(0.8 * height, height, sections=4, transform=pose))
    return trimesh.util.concatenate(parts)
