"""A still 3-D picture of a room that one can look into, without any graphics hardware."""

from collections.abc import Mapping

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from nbtrack.plots.style import (
    TRUE_LABEL,
    camera_positions,
    new_figure,
    path_colors,
    styled,
)
from nbtrack.plots.top_view import Y_UP, Direction

_MOST_FACES = 120_000  # more are merged first; about half of them face the reader
_AMBIENT = 0.55  # share of the light that comes from everywhere
_HEIGHT = 5.6  # inches


@styled
def plot_mesh(
    mesh: trimesh.Trimesh,
    T_paths: Mapping[str, Float[np.ndarray, "_ 4 4"]] | None = None,
    title: str = "",
    up: Direction = Y_UP,
    azimuth_deg: float | None = None,
    elevation_deg: float = 45.0,
) -> Figure:
    """A vertex-coloured mesh as a doll's house: the near walls and the ceiling are left out.

    Left out is every face that shows its back, so that one looks into a room from outside.
    Parallel projection; trajectories are drawn on top, in the colours of `plot_trajectories`.

    Args:
        T_paths: camera-to-world poses by label; the label "true" is green.
        up: the world's up, any direction.
        azimuth_deg: turns the viewer around the room; by default from where most surface shows.
        elevation_deg: 90 looks straight down.
    """
    mesh = _facing_free_space(_at_most(mesh, _MOST_FACES))
    if azimuth_deg is None:
        azimuth_deg = _best_azimuth(mesh, up, elevation_deg)
    to_screen = screen_axes(up, azimuth_deg, elevation_deg)
    figure = new_figure(title, _HEIGHT)
    axes = figure.subplots()
    _draw_faces(axes, mesh, to_screen, np.array(up, float))
    colors = path_colors(T_paths or {})
    for label, T_world_camera in (T_paths or {}).items():
        page = camera_positions(T_world_camera) @ to_screen[:2].T
        is_true = label == TRUE_LABEL
        axes.plot(*page.T, color="white", linewidth=4.2 if is_true else 3.0, alpha=0.6)
        axes.plot(*page.T, color=colors[label], linewidth=2.6 if is_true else 1.5, label=label)
        axes.plot(*page[0], "o", color="black", markersize=4.5)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    _draw_scale(axes)
    if T_paths:
        axes.legend(loc="upper right")
    return figure


def mesh_viewer(
    mesh: trimesh.Trimesh, T_paths: Mapping[str, Float[np.ndarray, "_ 4 4"]] | None = None
) -> trimesh.Scene:
    """The same, to be turned by hand: `mesh_viewer(...).show()` in a notebook."""
    scene = trimesh.Scene([mesh])
    colors = path_colors(T_paths or {})
    for label, T_world_camera in (T_paths or {}).items():
        path = trimesh.load_path(camera_positions(T_world_camera))
        path.colors = [trimesh.visual.color.hex_to_rgba(colors[label])] * len(path.entities)
        scene.add_geometry(path, geom_name=label)
    return scene


def screen_axes(
    up: Direction, azimuth_deg: float, elevation_deg: float
) -> Float[np.ndarray, "3 3"]:
    """Rows: the picture's right, its upward direction, and the way to the viewer (world frame)."""
    upward = np.array(up) / np.linalg.norm(up)
    # Any horizontal direction will do as azimuth 0; the axis least along `up` is safe.
    side = np.cross(upward, np.eye(3)[np.abs(upward).argmin()])
    side /= np.linalg.norm(side)
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(upward, side)
    viewer = np.cos(elevation) * level + np.sin(elevation) * upward
    # Level with the picture even where the viewer looks straight down.
    right = np.cross(upward, level)
    return np.stack([right, np.cross(viewer, right), viewer])


def visible_faces(
    mesh: trimesh.Trimesh, to_viewer: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "faces"]:
    """Which faces show their front."""
    return mesh.face_normals @ to_viewer > 0


def _best_azimuth(mesh: trimesh.Trimesh, up: Direction, elevation_deg: float) -> float:
    """The azimuth (degrees) from which the fronts of the faces fill the largest area."""
    azimuths = np.arange(15.0, 360.0, 30.0)  # none along the walls of a room aligned to the axes
    viewers = np.stack([screen_axes(up, float(a), elevation_deg)[2] for a in azimuths])
    fronts = np.clip(mesh.face_normals @ viewers.T, 0, None)
    return float(azimuths[(mesh.area_faces @ fronts).argmax()])


def _draw_faces(
    axes: Axes,
    mesh: trimesh.Trimesh,
    to_screen: Float[np.ndarray, "3 3"],
    up: Float[np.ndarray, "3"],
) -> None:
    """Paint the faces from the farthest to the nearest."""
    visible = visible_faces(mesh, to_screen[2])
    corners = (mesh.vertices @ to_screen.T)[mesh.faces[visible]]
    order = corners[..., 2].mean(axis=1).argsort()
    colors = mesh.visual.vertex_colors[:, :3][mesh.faces[visible]].mean(axis=1) / 255
    # Smoothed normals: those of single marching-cubes faces flicker.
    normals = mesh.vertex_normals[mesh.faces[visible]].mean(axis=1)
    light = to_screen[2] + 0.5 * to_screen[0] + 0.6 * up
    light /= np.linalg.norm(light)
    shade = _AMBIENT + (1 - _AMBIENT) * np.clip(normals @ light, 0, 1)
    faces = PolyCollection(
        corners[order, :, :2], facecolors=(colors * shade[:, None])[order], edgecolors="face",
        linewidths=0.4, antialiased=True, rasterized=True,
    )  # fmt: skip
    axes.add_collection(faces)


def _facing_free_space(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its normals towards the inside of the room.

    Marching cubes orients faces by the sign of the field, which differs between densities and
    distances. The room's shell outweighs what stands in it, so the middle votes.
    """
    middle = mesh.bounds.mean(axis=0)
    towards = np.einsum("nd,nd->n", middle - mesh.triangles_center, mesh.face_normals)
    if float(towards @ mesh.area_faces) >= 0:
        return mesh
    turned = mesh.copy()
    turned.invert()
    return turned


def _at_most(mesh: trimesh.Trimesh, n_faces: int) -> trimesh.Trimesh:
    """The mesh, or where it has too many faces a coarser one: vertices of a grid cell merge."""
    if len(mesh.faces) <= n_faces:
        return mesh
    cell = np.sqrt(2.2 * mesh.area / n_faces)
    keys = np.floor(mesh.vertices / cell).astype(int)
    _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    is_face = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
    is_face &= faces[:, 0] != faces[:, 2]
    counts = np.bincount(merged.reshape(-1))[:, None]
    vertices, colors = np.zeros((len(first), 3)), np.zeros((len(first), 4))
    np.add.at(vertices, merged.reshape(-1), mesh.vertices)
    np.add.at(colors, merged.reshape(-1), mesh.visual.vertex_colors)
    colors_255 = (colors / counts).astype(np.uint8)
    return trimesh.Trimesh(
        vertices / counts, faces[is_face], vertex_colors=colors_255, process=False
    )


def _draw_scale(axes: Axes) -> None:
    """A bar of one metre: lengths across the picture are true."""
    left, _ = axes.get_xlim()
    bottom, _ = axes.get_ylim()
    axes.plot([left, left + 1], [bottom, bottom], color="black", linewidth=2)
    axes.annotate(
        "1 m", (left + 0.5, bottom), xytext=(0, 4), textcoords="offset points", ha="center"
    )
