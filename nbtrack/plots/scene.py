"""The parts of figures of rooms: meshes, point clouds, slices through a field's values, and paths.

A room is seen from above, or from outside in a parallel projection. Cameras are mostly upright, so
that the axis of the world that is nearest to their upward direction is taken as up.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
import pandas as pd
import trimesh
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.transforms import Bbox

from nbtrack.core.arrays import Poses
from nbtrack.fields import Field
from nbtrack.plots.meshes import query_field
from nbtrack.plots.style import method_colors

Paths = Mapping[str, Poses]  # camera-to-world poses (m) by label
_ELEVATION = np.radians(45)  # of the viewer of a mesh, above the horizon
_AMBIENT = 0.75  # share of the light on a mesh that comes from all sides
# The grey of what no frame has seen; no colour scale of values contains grey.
_UNSEEN = "0.82"
# The share of a cloud's points left out at either end of each axis: a few wrong depths would
# otherwise make the room look small.
_CUT = 0.01
_LINES_M = np.arange(-5.0, 5.01, 0.25).tolist()  # signed distances (m) with a thin line in a slice


def up_of(*T_paths: Poses) -> np.ndarray:
    """The signed axis of the world (a unit vector) that is nearest to the cameras' mean up.

    A camera's up is its -y axis. Poses may be NaN where they are unknown.
    """
    mean_up = -np.nanmean(np.concatenate(T_paths)[:, :3, 1], axis=0)
    axis = np.abs(mean_up).argmax()
    return np.sign(mean_up[axis]) * np.eye(3)[axis] + 0.0  # makes 0.0 of -0.0


def screen_axes(up: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """The axes of a picture (rows: right, upward, towards the viewer) in the world frame.

    The viewer is 45 degrees above the horizon, at the azimuth `azimuth_deg` about up.
    """
    side = np.roll(up, 1)  # the direction of azimuth 0: either horizontal axis of the world will do
    azimuth = np.radians(azimuth_deg)
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    viewer = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
    right = np.cross(up, level)
    return np.stack([right, np.cross(viewer, right), viewer])


def draw_mesh(
    axes: Axes, mesh: trimesh.Trimesh, up: np.ndarray, to_screen: np.ndarray | None = None
) -> np.ndarray:
    """Draw the faces of a room's mesh that show their front, shaded; returns the `screen_axes`.

    The front of a face is its side towards free space: a wall shows it to viewers inside the room.
    The view is that of `to_screen`, by default the one in which most of the surface shows its
    front. Horizontal lengths in the picture are true (m).
    """
    # The normals of marching cubes follow the sign of the field, which differs between densities
    # and distances. `side` is 1 if they point to free space, else -1. Most of a room's surface is
    # its shell, whose front points inwards; so the area decides.
    inwards = mesh.bounds.mean(axis=0) - mesh.triangles_center
    side = np.sign((inwards * mesh.face_normals).sum(axis=1) @ mesh.area_faces)
    if to_screen is None:
        # None of these azimuths looks along the walls of a room that is aligned with the axes.
        screens = np.stack([screen_axes(up, azimuth) for azimuth in np.arange(15.0, 360.0, 30.0)])
        cosines = side * mesh.face_normals @ screens[:, 2].T  # fronts to viewers (faces, azimuths)
        to_screen = screens[(mesh.area_faces @ cosines.clip(0)).argmax()]
    faces = mesh.faces[side * mesh.face_normals @ to_screen[2] > 0]
    corners = (mesh.vertices @ to_screen.T)[faces]
    # Normals are means over vertices, since those of single faces of marching cubes vary too much.
    normals = side * mesh.vertex_normals[faces].mean(axis=1)
    right, _, viewer = to_screen
    light = viewer + 0.5 * right + 0.6 * up  # from above the viewer's right shoulder
    shade = _AMBIENT + (1 - _AMBIENT) * (normals @ light / np.linalg.norm(light)).clip(0)
    colors = mesh.visual.vertex_colors[faces, :3].mean(axis=1) / 255 * shade[:, None]
    order = corners[..., 2].mean(axis=1).argsort()  # from the farthest face to the nearest
    look = {"edgecolors": "face", "linewidths": 0.4, "rasterized": True}
    axes.add_collection(PolyCollection(corners[order, :, :2], facecolors=colors[order], **look))
    axes.set_aspect("equal")
    axes.set_axis_off()  # no scale: all but horizontal lengths are shortened
    return to_screen


def draw_scale(*panels: Axes) -> None:
    """Draw a scale bar below all that is drawn in each panel, as 1 m: a power of ten that fits.

    Panels are in metres and have the same limits, so that all bars are at the same height.
    """
    low, high = Bbox.union([axes.dataLim for axes in panels]).get_points()
    length = 10.0 ** np.floor(np.log10(high[0] - low[0]))
    x, y = (low[0] + high[0]) / 2, low[1] - 0.05 * (high[1] - low[1])
    for axes in panels:
        axes.plot(x + length * np.array([-0.5, 0.5]), [y, y], "k-", linewidth=2)
        axes.annotate(f"{length:g} m", (x, y), (0, -12), textcoords="offset points", ha="center")


def draw_from_above(axes: Axes, T_paths: Paths) -> tuple[np.ndarray, np.ndarray]:
    """Draw paths from above, not mirrored, on axes in metres with equal scales.

    Returns the axis of the world that points up, and the page's axes, to the right and ahead, in
    the world frame (2, 3).
    """
    up = up_of(*T_paths.values())
    is_level = up == 0  # up is along one axis of the world; the two others span the page
    page = np.eye(3)[is_level]
    draw_paths(axes, T_paths, page)
    right, ahead = np.array(["x", "y", "z"])[is_level]
    axes.set(xlabel=f"{right} (m)", ylabel=f"{ahead} (m)", aspect="equal")
    # The page's right, its upward direction and up must form a right-handed frame.
    axes.yaxis.set_inverted(np.cross(*page) @ up < 0)
    return up, page


def draw_paths(axes: Axes, T_paths: Paths, to_page: np.ndarray, width: float = 1) -> None:
    """Draw paths, camera-to-world poses (m) by label, with a dot at the start of the first.

    The rows of `to_page` (2, 3) are the page's axes in the world frame. `width` scales the width of
    lines and the size of the dot.
    """
    dashes = cycle(("--", "-.", ":"))
    for label, color in method_colors(T_paths).items():
        x, y = to_page @ T_paths[label][:, :3, 3].T
        line = "-" if label == "true" else next(dashes)
        # The true path is wider, so that the others do not hide it.
        look = {"linewidth": width * (4.0 if label == "true" else 1.6), "color": color, "zorder": 3}
        axes.plot(x, y, line, label=label, **look)
    first, *_ = T_paths.values()
    start_x, start_y = to_page @ first[0, :3, 3]
    dot = {"color": "black", "markersize": 5 * width, "zorder": 4}
    # A legend has room for four labels, so that with four paths the start has none.
    axes.plot(start_x, start_y, "o", label="start" if len(T_paths) < 4 else "", **dot)


def draw_cloud(axes: Axes, cloud: pd.DataFrame, T_paths: Paths) -> np.ndarray:
    """Draw paths and coloured points from above, without a ceiling that would hide the room.

    Points more than 0.1 m above all cameras are left out, and so are the outermost ones (`_CUT`).
    Returns the page's axes, to the right and ahead, in the world frame (2, 3).
    """
    up, page = draw_from_above(axes, T_paths)
    places = cloud[["x", "y", "z"]]
    inside = (places >= places.quantile(_CUT)) & (places <= places.quantile(1 - _CUT))
    heights = (places @ up)[inside.all(axis=1)].sort_values()  # points are drawn from the floor up
    highest = max(np.nanmax(path[:, :3, 3] @ up) for path in T_paths.values())
    shown = cloud.loc[heights[heights <= highest + 0.1].index]
    colors = shown[["red", "green", "blue"]].to_numpy() / 255
    axes.scatter(*page @ shown[["x", "y", "z"]].to_numpy().T, c=colors, s=4, linewidths=0)
    return page


def draw_slice(
    axes: Axes,
    field: Field,
    points: Float[np.ndarray, "rows columns 3"],
    places: Float[np.ndarray, "rows columns 2"],
    seen: Bool[np.ndarray, "rows columns"] | None = None,
    norm: Normalize | None = None,
    **bar: object,
) -> Normalize:
    """Draw a field's values at a grid of points (m, world frame), at `places` (m) on the page.

    A signed distance is blue in free space and red in solids, with thin lines 0.25 m apart. Other
    values have a logarithmic colour scale. The surface is a black line; what is not `seen` is grey.
    All have labels for a legend. `bar` holds options of `Figure.colorbar`. Returns the colour
    scale; if that of another slice is given as `norm`, it is used and no bar is drawn.
    """
    _, values = query_field(field, points)
    level = field.surface_level
    if field.is_distance:
        limit = 0.25 * max(1, np.ceil(np.quantile(np.abs(values), 0.98) / 0.25))  # m; on a line
        own_norm, colors = Normalize(-limit, limit), "RdBu"
    else:  # four decades around the value at the surface
        own_norm, colors = LogNorm(level / 200, 50 * level, clip=True), "YlOrBr"
    look = {"shading": "nearest", "rasterized": True}  # pixels are centred on the points
    xy = np.moveaxis(places, -1, 0)  # matplotlib takes two arrays of coordinates
    image = axes.pcolormesh(*xy, values, cmap=colors, norm=norm or own_norm, **look)
    if norm is None:
        axes.figure.colorbar(image, extend="both", **{"ax": axes, "label": field.value_label} | bar)
    if field.is_distance:
        # Lines are white where the slice is dark.
        tones = ["1" if abs(line) > 0.6 * image.norm.vmax else "0.35" for line in _LINES_M]
        draw_levels(axes, places, values, _LINES_M, colors=tones, linewidths=0.4, linestyles="-")
        axes.hlines([], 0, 0, "0.35", linewidth=0.6, label="distance: every 0.25 m")
    draw_levels(axes, places, values, [level], colors="black", linewidths=1.4)
    name, _, unit = field.value_label.removesuffix(")").partition(" (")  # for "density of 20/m"
    what = "zero level" if field.is_distance else f"{name} of {level:g}{unit.removeprefix('1')}"
    axes.hlines([], 0, 0, "black", linewidth=1.4, label=what)
    if seen is not None:
        _draw_veil(axes, xy, seen, **look)
    return image.norm


def _draw_veil(axes: Axes, xy: np.ndarray, seen: np.ndarray, **look: object) -> None:
    """Cover what was not seen, where data do not support the field, with grey."""
    veil = np.full((*seen.shape, 4), float(_UNSEEN))  # red, green, blue, opacity
    veil[..., 3] = ~seen  # transparent over what was seen
    axes.pcolormesh(*xy, veil, gid="unseen", zorder=2.5, **look)  # above the slice's lines
    axes.fill([], [], color=_UNSEEN, label="hardly or never seen")


def draw_levels(
    axes: Axes, places: np.ndarray, values: np.ndarray, levels: Sequence[float], **look: object
) -> None:
    """Draw lines where the values at `places` (a grid on the page) equal one of `levels`."""
    # Some versions of matplotlib warn if no level is among the values.
    if any(values.min() < level < values.max() for level in levels):
        axes.contour(*np.moveaxis(places, -1, 0), values, levels, **look)
