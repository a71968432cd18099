"""Meshes of rooms as one sees them from outside and above, in a parallel projection."""

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from nbtrack.core.arrays import Poses

_ELEVATION = np.radians(45)  # of the viewer of a mesh
_AMBIENT = 0.55  # share of the light on a mesh that comes from everywhere


def best_view(mesh: trimesh.Trimesh, up: np.ndarray) -> np.ndarray:
    """The `screen_axes` from which most surface of a room shows its front."""
    # None of the azimuths looks along the walls of a room aligned to the axes.
    screens = np.stack([screen_axes(up, azimuth) for azimuth in np.arange(15.0, 360.0, 30.0)])
    fronts = inward_side(mesh) * mesh.face_normals @ screens[:, 2].T
    return screens[(mesh.area_faces @ fronts.clip(0)).argmax()]


def draw_mesh(axes: Axes, mesh: trimesh.Trimesh, to_screen: np.ndarray, up: np.ndarray) -> None:
    """The faces of a mesh that show their front, shaded, the nearest on top."""
    side = inward_side(mesh)
    faces = mesh.faces[side * mesh.face_normals @ to_screen[2] > 0]
    corners = (mesh.vertices @ to_screen.T)[faces]
    # Smoothed normals: those of single marching-cubes faces flicker.
    normals = side * mesh.vertex_normals[faces].mean(axis=1)
    light = to_screen[2] + 0.5 * to_screen[0] + 0.6 * up
    shade = _AMBIENT + (1 - _AMBIENT) * (normals @ light / np.linalg.norm(light)).clip(0)
    colors = mesh.visual.vertex_colors[faces, :3].mean(axis=1) / 255 * shade[:, None]
    order = corners[..., 2].mean(axis=1).argsort()  # from the farthest to the nearest
    look = {"edgecolors": "face", "linewidths": 0.4, "rasterized": True}
    axes.add_collection(PolyCollection(corners[order, :, :2], facecolors=colors[order], **look))


def inward_side(mesh: trimesh.Trimesh) -> float:
    """1 where the normals of a room's shell point inwards, else -1.

    Marching cubes orients faces by the sign of the field, which differs between densities and
    distances. The sign is that of the sum over the area, since a room's shell is larger than what
    stands in it.
    """
    inwards = mesh.bounds.mean(axis=0) - mesh.triangles_center
    return np.sign((inwards * mesh.face_normals).sum(axis=1) @ mesh.area_faces)


def up_of(*T_paths: Poses) -> np.ndarray:
    """The world's axis, with its sign, that is nearest to the mean up of cameras."""
    above = -np.concatenate(T_paths)[:, :3, 1].mean(axis=0)
    axis = np.abs(above).argmax()
    return np.sign(above[axis]) * np.eye(3)[axis]


def screen_axes(up: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Rows: the picture's right, its upward direction, and the way to the viewer (world frame)."""
    side = np.roll(up, 1)  # any horizontal axis is azimuth 0
    azimuth = np.radians(azimuth_deg)
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    viewer = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
    right = np.cross(up, level)
    return np.stack([right, np.cross(viewer, right), viewer])
