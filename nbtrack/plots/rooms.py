"""Rooms: values, points and paths from above; meshes to look into.

Up is the axis of the world that the cameras' own up is nearest to: they are mostly held upright.
"""

from collections.abc import Mapping
from itertools import cycle

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from nbtrack.core.arrays import Poses
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.plots.meshes import extract_mesh, query_field, seen_by
from nbtrack.plots.projection import best_view, draw_mesh, up_of
from nbtrack.plots.style import DOTTED, log_axes, method_colors, new_axes, styled
from nbtrack.synthetic import Room
from nbtrack.tables import STANDING_STILL

_POINTS_ALONG = 240  # grid points along the longer side of a slice
_DIMMED = 0.72  # how white the unseen becomes
_CUT = 0.01  # share of a recording's points cut off at either end: wild depths hide the room
_GREEN = method_colors(["true"])["true"]


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
    to_screen = best_view(mesh, up)
    room, enlarged = new_axes(title, 5.0, 1, 2, width_ratios=[2, 1])[0]
    draw_mesh(room, mesh, to_screen, up)
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
    to_screen = best_view(mesh, up)
    axes = new_axes(title, 4.6)[0, 0]
    draw_mesh(axes, mesh, to_screen, up)
    height = (sequence.T_world_camera[:, :3, 3] @ up).mean()
    # From the room to where the slice is drawn; it is above the middle of the room's height.
    aside = 1.04 * np.ptp(mesh.vertices @ to_screen[0]) * to_screen[0]
    aside -= (height - (mesh.vertices @ up).mean()) * up
    page = [axis for axis in range(3) if up[axis] == 0]
    sides = [np.arange(low, high, voxel) for low, high in mesh.bounds[:, page].T]
    points = np.stack(np.meshgrid(*sides), axis=-1) @ np.eye(3)[page] + height * up
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


def _look_through(axes: Axes) -> None:
    """Axes of a parallel projection: lengths across the picture are true."""
    axes.set(aspect="equal", xlabel="across the picture (m)", yticks=[])
    axes.spines["left"].set_visible(False)
    axes.grid(False)


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
