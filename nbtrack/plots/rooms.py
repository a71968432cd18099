"""Rooms in three dimensions: a still picture to look into, and a viewer to turn by hand."""

from collections.abc import Mapping

import numpy as np
import trimesh
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from nbtrack.core.arrays import Poses
from nbtrack.plots.style import draw_paths, method_colors, new_axes, styled
from nbtrack.plots.top_views import up_of

_MOST_FACES, _MOST_FACES_TO_TURN = 120_000, 10_000  # more are merged first
_ELEVATION = np.radians(45)  # of the viewer
_AMBIENT = 0.55  # share of the light that comes from everywhere


@styled
def plot_mesh(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses], title: str = "") -> Figure:
    """A vertex-coloured mesh as a doll's house: the near walls and the ceiling are left out.

    Left out is every face that shows its back, so that one looks into a room from outside, from
    where most surface shows. Parallel projection; lengths across the picture are true (m).

    Args:
        T_paths: camera-to-world poses by label, drawn on top; "true" is green, "tracked" red.
    """
    mesh, up = _at_most(mesh, _MOST_FACES), up_of(*T_paths.values())
    # Marching cubes orients faces by the sign of the field, which differs between densities and
    # distances. The room's shell outweighs what stands in it, so the middle votes.
    inwards = mesh.bounds.mean(axis=0) - mesh.triangles_center
    side = np.sign((inwards * mesh.face_normals).sum(axis=1) @ mesh.area_faces)
    # None of the azimuths looks along the walls of a room aligned to the axes.
    screens = np.stack([screen_axes(up, azimuth) for azimuth in np.arange(15.0, 360.0, 30.0)])
    fronts = side * mesh.face_normals @ screens[:, 2].T
    best = (mesh.area_faces @ fronts.clip(0)).argmax()
    to_screen, faces = screens[best], mesh.faces[fronts[:, best] > 0]
    corners = (mesh.vertices @ to_screen.T)[faces]
    # Smoothed normals: those of single marching-cubes faces flicker.
    normals = side * mesh.vertex_normals[faces].mean(axis=1)
    light = to_screen[2] + 0.5 * to_screen[0] + 0.6 * up
    shade = _AMBIENT + (1 - _AMBIENT) * (normals @ light / np.linalg.norm(light)).clip(0)
    colors = mesh.visual.vertex_colors[faces, :3].mean(axis=1) / 255 * shade[:, None]
    order = corners[..., 2].mean(axis=1).argsort()  # from the farthest to the nearest
    axes = new_axes(title, 5.6)[0, 0]
    look = {"edgecolors": "face", "linewidths": 0.4, "rasterized": True}
    axes.add_collection(PolyCollection(corners[order, :, :2], facecolors=colors[order], **look))
    draw_paths(axes, T_paths, to_screen[:2])
    axes.set(aspect="equal", xlabel="across the picture (m)", yticks=[])
    axes.spines["left"].set_visible(False)
    axes.grid(False)
    axes.legend(loc="upper right")
    return axes.figure


def mesh_viewer(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses]) -> trimesh.Scene:
    """The same, to be turned by hand: `mesh_viewer(...).show()` in a notebook.

    The mesh is made coarser: the viewer adds 1.0 MB to the notebook, 0.7 MB of it the viewer's own.
    """
    scene = trimesh.Scene([_at_most(mesh, _MOST_FACES_TO_TURN)])
    for label, color in method_colors(T_paths).items():
        path = trimesh.load_path(T_paths[label][:, :3, 3])
        path.colors = [trimesh.visual.color.hex_to_rgba(color)] * len(path.entities)
        scene.add_geometry(path, geom_name=label)
    return scene


def screen_axes(up: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Rows: the picture's right, its upward direction, and the way to the viewer (world frame)."""
    side, azimuth = np.roll(up, 1), np.radians(azimuth_deg)  # any horizontal axis is azimuth 0
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    viewer = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
    right = np.cross(up, level)
    return np.stack([right, np.cross(viewer, right), viewer])


def _at_most(mesh: trimesh.Trimesh, n_faces: int) -> trimesh.Trimesh:
    """The mesh, or where it has too many faces a coarser one: vertices of a grid cell merge."""
    if len(mesh.faces) <= n_faces:
        return mesh
    cell = np.sqrt(2.2 * mesh.area / n_faces)
    coarse = mesh.copy().apply_scale(1 / cell)
    coarse.merge_vertices(digits_vertex=0, merge_tex=True, merge_norm=True)
    coarse.update_faces(coarse.nondegenerate_faces() & coarse.unique_faces())
    return coarse.apply_scale(cell)
