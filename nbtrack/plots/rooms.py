"""Rooms: values, points and paths from above; meshes to look into, and to turn by hand.

Up is the axis of the world that the cameras' own up is nearest to: they are mostly held upright.
"""

from collections.abc import Mapping
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from trimesh.viewer.notebook import scene_to_notebook

from nbtrack.core.arrays import Points, Poses, Transform, Values
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.plots.meshes import extract_mesh, query_field, seen_by
from nbtrack.plots.style import DOTTED, log_axes, method_colors, new_axes, styled
from nbtrack.synthetic import Room
from nbtrack.tables import STANDING_STILL

_POINTS_ALONG = 240  # grid points along the longer side of a slice
_DIMMED = 0.72  # how white the unseen becomes
_CUT = 0.01  # share of a recording's points cut off at either end: wild depths hide the room
_MAX_FACES_TO_TURN = 10_000  # more are merged for the viewer
_MAX_TUBES = 80  # straight pieces of a path in the viewer
_ELEVATION = np.radians(45)  # of the viewer of a mesh
_GREEN = method_colors(["true"])["true"]
_AMBIENT = 0.55  # share of the light on a mesh that comes from everywhere


@styled
def plot_slice(
    field: Field, sequence: RgbdSequence, height: float, room: Room | None = None, title: str = ""
) -> Figure:
    """A field's values on the horizontal plane `height` metres up.

    A signed distance is blue in free space and red in matter; a density or an occupancy has a
    logarithmic scale. Black is the surface (the field's `surface_level`), dashed green the true
    one. What no frame has seen is pale: there the field invents. `sequence` are the frames that the
    map was made of, `room` is the exact scene, if it is a synthetic one.
    """
    axes = new_axes(title, 5.4)[0, 0]
    up, page = _draw_from_above(axes, {"camera path": sequence.T_world_camera})
    # A regular grid, with coordinates to the right and ahead.
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])[:, page]
    step = (high - low).max() / _POINTS_ALONG
    right, ahead = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    points = np.tile(height * up, (len(ahead) * len(right), 1))
    points[:, page] = np.stack(np.meshgrid(right, ahead), axis=-1).reshape(-1, 2)
    values = query_field(field, points)[1].reshape(len(ahead), len(right))
    seen = seen_by(points, sequence).reshape(values.shape)
    norm, colors = _scale_of(field, values)
    grid = {"shading": "nearest", "rasterized": True}  # pixels are centred on the points
    image = axes.pcolormesh(right, ahead, values, cmap=colors, norm=norm, **grid)
    look = {"label": field.value_label, "extend": "both", "aspect": 25, "pad": 0.015}
    axes.figure.colorbar(image, ax=axes, **look)
    # The map's surface lies below what makes the unseen pale.
    lines = {"surface": (values - field.surface_level, 2, "black", "-")}
    if room is not None:
        lines["true surface"] = (room.sdf(points).reshape(values.shape), 3, _GREEN, "--")
    for name, (zero_there, zorder, color, style) in lines.items():
        axes.plot([], [], style, color=color, label=name)
        if zero_there.min() < 0 < zero_there.max():  # matplotlib warns where there is no line
            look = {"colors": color, "linestyles": style, "zorder": zorder}
            axes.contour(right, ahead, zero_there, [0.0], **look)
    veil = np.dstack([np.ones((*values.shape, 3)), _DIMMED * ~seen])
    axes.pcolormesh(right, ahead, veil, gid="unseen", zorder=2.5, **grid)
    axes.set_title(f"{field.label} at height {height:.2f} m; pale: never seen")
    axes.figure.legend_below()
    return axes.figure


def _scale_of(field: Field, values: np.ndarray) -> tuple[Normalize, str]:
    """How a field's values are coloured; see `plot_slice`."""
    if field.is_distance:
        limit = np.clip(np.quantile(np.abs(values), 0.98), 0.2, 1.5)
        return Normalize(-limit, limit), "RdBu"
    return LogNorm(field.surface_level / 200, 50 * field.surface_level, clip=True), "YlOrBr"


@styled
def plot_points(points: Mapping[str, tuple[Points, Values, Transform]], title: str = "") -> Figure:
    """Observed points by their signed distance (cm) in a map, a panel a pose.

    White points lie on the map's surface, blue ones in front of it, red ones behind it. All panels
    share one scale, cut at the 95 % quantile of the first. The dot is the camera. By label, as
    "before" and "after": points (m, world frame), their signed distances (m), and the
    camera-to-world pose that placed them.
    """
    panels = new_axes(title, 4.5, 1, len(points), sharex=True, sharey=True)[0]
    limit = 100 * float(next(iter(points.values()))[1].abs().quantile(0.95))
    look = {"cmap": "RdBu", "s": 6, "edgecolors": "0.6", "linewidths": 0.15}
    for axes, (label, parts) in zip(panels, points.items(), strict=True):
        places, sdf, T_world_camera = (part.cpu().numpy() for part in parts)
        _, page = _draw_from_above(axes, {"camera": T_world_camera[None]})
        image = axes.scatter(*places[:, page].T, c=100 * sdf, vmin=-limit, vmax=limit, **look)
        axes.set_title(f"{label}: mean |distance| {100 * np.abs(sdf).mean():.2f} cm")
        axes.set_facecolor("0.93")
    look = {"label": "signed distance (cm)", "extend": "both", "aspect": 25}
    axes.figure.colorbar(image, ax=list(panels), **look)
    return axes.figure


@styled
def plot_trajectories(T_true: Poses, estimates: Mapping[str, Poses], title: str = "") -> Figure:
    """Paths (m) from above: camera-to-world poses by method, the true ones green.

    The world axis along which the true path is longer lies across the page.
    """
    axes = new_axes(title, 4.7)[0, 0]
    _draw_from_above(axes, {"true": T_true, **estimates}, longer_across=True)
    axes.figure.legend_below()
    return axes.figure


@styled
def plot_overview(
    cloud: pd.DataFrame, T_paths: Mapping[str, Poses], frames: pd.DataFrame | None, title: str
) -> Figure:
    """Coloured points (m) and paths from above, and the errors of a tracked run over time.

    The cloud's columns are x, y, z (m, world frame), red, green, blue (0 to 255); what is higher
    than all cameras is left out. Walls should be thin and straight: doubled or fanned ones mean
    that a recording is read wrongly. `frames` are those of the run that is called "tracked";
    without them, or without a known true pose, there are no errors.
    """
    has_errors = frames is not None and frames["translation_error_m"].notna().any()
    left, *right = new_axes(title, 4.2 if has_errors else 6.0, 1, 1 + has_errors)[0]
    draw_cloud(left, cloud, T_paths)
    left.figure.legend_below()
    for axes in right:
        seconds = frames["time"] - frames["time"].iloc[0]
        color = method_colors(["tracked"])["tracked"]
        axes.plot(seconds, 100 * frames["translation_error_m"], color=color, label="tracked")
        axes.plot(seconds, 100 * frames["still_error_m"], label=STANDING_STILL, **DOTTED)
        axes.set(xlabel="time (s)", ylabel="translation error (cm)")
        log_axes(axes, "y")
        axes.legend(loc="best")
    return left.figure


def draw_cloud(axes: Axes, cloud: pd.DataFrame, T_paths: Mapping[str, Poses]) -> list[int]:
    """Coloured points from above, but for those higher than all cameras; and paths.

    Returns the indices of the world's axes to the right and ahead.
    """
    up, page = _draw_from_above(axes, T_paths)
    places = cloud[["x", "y", "z"]]
    inside = (places >= places.quantile(_CUT)) & (places <= places.quantile(1 - _CUT))
    heights = (places @ up)[inside.all(axis=1)].sort_values()  # drawn from the floor up
    highest = max((path[:, :3, 3] @ up).max() for path in T_paths.values())
    shown = cloud.loc[heights.index[heights <= highest + 0.1]]
    colors = shown[["red", "green", "blue"]].to_numpy() / 255
    axes.scatter(*places.loc[shown.index].to_numpy()[:, page].T, c=colors, s=4, linewidths=0)
    return page


@styled
def plot_mesh(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses], title: str = "") -> Figure:
    """A vertex-coloured mesh of a room from outside, without the near walls and the ceiling.

    Every face that shows its back is left out, and one looks from where most surface shows. The
    projection is parallel; lengths across the picture are true (m). The camera-to-world poses by
    label are drawn on top, and larger beside it; "true" is green, "tracked" red.
    """
    up = up_of(*T_paths.values())
    to_screen = _best_view(mesh, up)
    room, enlarged = new_axes(title, 5.0, 1, 2, width_ratios=[2, 1])[0]
    _draw_mesh(room, mesh, to_screen, up)
    for axes in (room, enlarged):
        _draw_paths(axes, T_paths, to_screen[:2])
        _look_through(axes)
    enlarged.set_title("The path, larger")
    room.figure.legend_below()
    return room.figure


@styled
def plot_map_and_slice(
    field: Field,
    sequence: RgbdSequence,
    T_paths: Mapping[str, Poses],
    title: str = "",
    voxel: float = 0.04,
) -> Figure:
    """A map as in the paper's Figure 1: its surface, a slice through its signed distance, paths.

    The surface is drawn as `plot_mesh` draws it, from a grid of `voxel` metres. The slice lies at
    the cameras' mean height and is drawn beside the room, in the same projection; thin lines are
    0.25 m apart. What no frame of `sequence` has seen is pale. The camera-to-world poses (m) by
    label are drawn in both.
    """
    mesh = extract_mesh(field, sequence, voxel=voxel)
    up = up_of(sequence.T_world_camera)
    to_screen = _best_view(mesh, up)
    axes = new_axes(title, 4.6)[0, 0]
    _draw_mesh(axes, mesh, to_screen, up)
    height = (sequence.T_world_camera[:, :3, 3] @ up).mean()
    # From the room to where the slice is drawn; it is above the middle of the room's height.
    aside = 1.04 * np.ptp(mesh.vertices @ to_screen[0]) * to_screen[0]
    aside -= (height - (mesh.vertices @ up).mean()) * up
    page = [axis for axis in range(3) if up[axis] == 0]
    sides = [np.arange(low, high, voxel) for low, high in mesh.bounds[:, page].T]
    points = np.empty((len(sides[0]), len(sides[1]), 3)) + height * up
    points[..., page] = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    _draw_slice(axes, field, sequence, points, (points + aside) @ to_screen[:2].T)
    _draw_paths(axes, T_paths, to_screen[:2], width=0.5)
    moved = {label: path.copy() for label, path in T_paths.items()}
    for path in moved.values():
        path[:, :3, 3] += aside
    axes.figure.legend_below()
    _draw_paths(axes, moved, to_screen[:2], width=0.5)
    _look_through(axes)
    axes.set_axis_off()
    return axes.figure


def _draw_slice(
    axes: Axes, field: Field, sequence: RgbdSequence, points: np.ndarray, places: np.ndarray
) -> None:
    """A field's values at a grid of points (rows, columns, 3; m), drawn at places on the page.

    What no frame has seen is pale. The surface is black, other lines are 0.25 m apart.
    """
    flat = points.reshape(-1, 3)
    values = query_field(field, flat)[1].reshape(points.shape[:2])
    unseen = ~seen_by(flat, sequence).reshape(values.shape)
    colors = ScalarMappable(*_scale_of(field, values))
    right, ahead = np.moveaxis(places, -1, 0)
    rgb = colors.to_rgba(values)[..., :3]
    rgb[unseen] += _DIMMED * (1 - rgb[unseen])
    axes.pcolormesh(right, ahead, rgb[:-1, :-1], rasterized=True)
    look = {"colors": "0.35", "linewidths": 0.4, "linestyles": "-"}
    axes.contour(right, ahead, values, np.arange(-1.0, 1.01, 0.25), **look)
    axes.contour(right, ahead, values, [field.surface_level], colors="black", linewidths=1.4)
    axes.figure.colorbar(colors, ax=axes, label=field.value_label, extend="both", shrink=0.6)


def _best_view(mesh: trimesh.Trimesh, up: np.ndarray) -> np.ndarray:
    """The `screen_axes` from which most surface of a room shows its front."""
    # None of the azimuths looks along the walls of a room aligned to the axes.
    screens = np.stack([screen_axes(up, azimuth) for azimuth in np.arange(15.0, 360.0, 30.0)])
    fronts = _inward_side(mesh) * mesh.face_normals @ screens[:, 2].T
    return screens[(mesh.area_faces @ fronts.clip(0)).argmax()]


def _draw_mesh(axes: Axes, mesh: trimesh.Trimesh, to_screen: np.ndarray, up: np.ndarray) -> None:
    """The faces of a mesh that show their front, shaded, the nearest on top."""
    side = _inward_side(mesh)
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


def _look_through(axes: Axes) -> None:
    """Axes of a parallel projection: lengths across the picture are true."""
    axes.set(aspect="equal", xlabel="across the picture (m)", yticks=[])
    axes.spines["left"].set_visible(False)
    axes.grid(False)


def _make_unlit(tree: dict) -> None:
    """One material for all meshes of a scene that shows their colours as they are."""
    tree["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def mesh_viewer(mesh: trimesh.Trimesh, T_paths: Mapping[str, Poses]) -> Any:
    """The same, to be turned by hand: HTML for a notebook. The mouse wheel scrolls the page.

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
    if _inward_side(room) < 0:
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


def _inward_side(mesh: trimesh.Trimesh) -> float:
    """1 where the normals of a room's shell point inwards, else -1.

    Marching cubes orients faces by the sign of the field, which differs between densities and
    distances. The sign is that of the sum over the area, since a room's shell is larger than what
    stands in it.
    """
    inwards = mesh.bounds.mean(axis=0) - mesh.triangles_center
    return np.sign((inwards * mesh.face_normals).sum(axis=1) @ mesh.area_faces)


def _path_mesh(T_world_camera: Poses, radius: float) -> trimesh.Trimesh:
    """A tube along camera positions, and a pyramid from the last one to where that camera looks."""
    places = T_world_camera[:, :3, 3]
    corners = places[np.linspace(0, len(places) - 1, _MAX_TUBES + 1).astype(int)]
    segments = np.stack([corners[:-1], corners[1:]], axis=1)
    moved = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > 1e-6
    parts = [trimesh.creation.cylinder(radius, segment=s, sections=6) for s in segments[moved]]
    image = np.array([[-1.0, -0.75], [1.0, -0.75], [1.0, 0.75], [-1.0, 0.75]])
    pyramid = 6 * radius * np.vstack([np.zeros(3), np.column_stack([image, np.full(4, 1.5)])])
    pyramid = pyramid @ T_world_camera[-1, :3, :3].T + places[-1]
    return trimesh.util.concatenate([*parts, trimesh.convex.convex_hull(pyramid)])


def up_of(*T_paths: Poses) -> np.ndarray:
    """The world's axis, with its sign, that is nearest to the mean up of cameras."""
    above = -np.concatenate(T_paths)[:, :3, 1].mean(axis=0)
    axis = np.abs(above).argmax()
    return np.sign(above[axis]) * np.eye(3)[axis]


def _draw_from_above(
    axes: Axes, T_paths: Mapping[str, Poses], longer_across: bool = False
) -> tuple[np.ndarray, list[int]]:
    """Paths, and axes in metres, equal, and turned so that nothing is mirrored.

    Returns up, and the indices of the world's axes across and along the page; the one along which
    the first path is longer may be asked for across.
    """
    up = up_of(*T_paths.values())
    page = [axis for axis in range(3) if up[axis] == 0]
    if longer_across:
        page.sort(key=lambda axis: -np.ptp(next(iter(T_paths.values()))[:, axis, 3]))
    right, ahead = page
    _draw_paths(axes, T_paths, np.eye(3)[page])
    axes.set(xlabel=f"{'xyz'[right]} (m)", ylabel=f"{'xyz'[ahead]} (m)", aspect="equal")
    # Right, page-up and up must be right-handed.
    axes.yaxis.set_inverted(np.cross(np.eye(3)[right], np.eye(3)[ahead]) @ up < 0)
    return up, page


def _draw_paths(
    axes: Axes, T_paths: Mapping[str, Poses], to_page: np.ndarray, width: float = 1.0
) -> None:
    """Trajectories by label on a page, (2, 3), with a dot at the start of each."""
    starts = []
    styles = cycle(("--", "-.", ":"))
    for label, color in method_colors(T_paths).items():
        path = T_paths[label][:, :3, 3] @ to_page.T
        # The true path is wide, so that the others do not hide it.
        dashes, own = ("-", 4.0) if label == "true" else (next(styles), 1.6)
        look = {"linewidth": own * width, "color": color, "label": label, "zorder": 3}
        axes.plot(*path.T, dashes, **look)
        starts.append(path[0])
    axes.plot(
        *np.transpose(starts), "o", color="black", markersize=5 * width, zorder=4, label="start"
    )


def screen_axes(up: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Rows: the picture's right, its upward direction, and the way to the viewer (world frame)."""
    side = np.roll(up, 1)  # any horizontal axis is azimuth 0
    azimuth = np.radians(azimuth_deg)
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    viewer = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
    right = np.cross(up, level)
    return np.stack([right, np.cross(viewer, right), viewer])
