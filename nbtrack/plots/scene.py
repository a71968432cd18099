"""What all pictures of rooms share: a mesh or a cloud, a slice through a field's values, paths.

A room is seen from above, or from outside in a parallel projection. Up is the axis of the world
that the cameras' own up is nearest to: they are mostly held upright.
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
_ELEVATION = np.radians(45)  # of the viewer of a mesh
_AMBIENT = 0.75  # share of the light on a mesh that comes from everywhere
UNSEEN = "0.82"
"""The grey of what no frame has seen; the scales of values hold no grey."""
_CUT = 0.01  # share of a recording's points cut off at either end: wild depths hide the room
_LINES_M = np.arange(-5.0, 5.01, 0.25).tolist()  # distances with a thin line


def up_of(*T_paths: Poses) -> np.ndarray:
    """The unit vector along an axis of the world, or against it, nearest to the cameras' mean up.

    A camera's up is minus its y.
    """
    above = -np.concatenate(T_paths)[:, :3, 1].mean(axis=0)
    axis = np.abs(above).argmax()
    return np.sign(above[axis]) * np.eye(3)[axis] + 0.0  # no -0.0


def screen_axes(up: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Rows: the picture's right, its upward direction, and the way to the viewer (world frame).

    The viewer stands 45 degrees above the horizon, at `azimuth_deg` about up.
    """
    side = np.roll(up, 1)  # a horizontal axis of the world, for azimuth 0; either one will do
    azimuth = np.radians(azimuth_deg)
    level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    viewer = np.cos(_ELEVATION) * level + np.sin(_ELEVATION) * up
    right = np.cross(up, level)
    return np.stack([right, np.cross(viewer, right), viewer])


def draw_mesh(
    axes: Axes, mesh: trimesh.Trimesh, up: np.ndarray, to_screen: np.ndarray | None = None
) -> np.ndarray:
    """Draw the faces of a room's mesh that show their front, shaded, the nearest on top.

    A face's front is its side towards free space, of walls the one inside the room.

    Returns the `screen_axes` of the view: those given, else those from where most surface shows its
    front. Lengths across the picture are true (m).
    """
    # Marching cubes orients faces by the sign of the field, which differs between densities and
    # distances: 1 where normals point inwards, else -1, by most of the area, which is the shell's.
    inwards = mesh.bounds.mean(axis=0) - mesh.triangles_center
    side = np.sign((inwards * mesh.face_normals).sum(axis=1) @ mesh.area_faces)
    if to_screen is None:
        # None of the azimuths looks along the walls of a room aligned to the axes.
        screens = np.stack([screen_axes(up, azimuth) for azimuth in np.arange(15.0, 360.0, 30.0)])
        cosines = side * mesh.face_normals @ screens[:, 2].T  # to viewers, (faces, azimuths)
        to_screen = screens[(mesh.area_faces @ cosines.clip(0)).argmax()]
    faces = mesh.faces[side * mesh.face_normals @ to_screen[2] > 0]
    corners = (mesh.vertices @ to_screen.T)[faces]
    # Smoothed normals: those of single marching-cubes faces flicker.
    normals = side * mesh.vertex_normals[faces].mean(axis=1)
    right, _, viewer = to_screen
    light = viewer + 0.5 * right + 0.6 * up  # comes from above the viewer's right shoulder
    shade = _AMBIENT + (1 - _AMBIENT) * (normals @ light / np.linalg.norm(light)).clip(0)
    colors = mesh.visual.vertex_colors[faces, :3].mean(axis=1) / 255 * shade[:, None]
    order = corners[..., 2].mean(axis=1).argsort()  # from the farthest to the nearest
    look = {"edgecolors": "face", "linewidths": 0.4, "rasterized": True}
    axes.add_collection(PolyCollection(corners[order, :, :2], facecolors=colors[order], **look))
    axes.set_aspect("equal")
    axes.set_axis_off()  # a scale would be that of lengths across alone: others are shortened
    return to_screen


def draw_scale(*panels: Axes) -> None:
    """Draw a bar of 1 m, or of another power of ten, below all that is drawn on panels in metres.

    Panels share their scale, and bars are level.
    """
    low, high = Bbox.union([axes.dataLim for axes in panels]).get_points()
    length = 10.0 ** np.floor(np.log10(high[0] - low[0]))
    x, y = (low[0] + high[0]) / 2, low[1] - 0.05 * (high[1] - low[1])
    for axes in panels:
        axes.plot(x + length * np.array([-0.5, 0.5]), [y, y], "k-", linewidth=2)
        axes.annotate(f"{length:g} m", (x, y), (0, -12), textcoords="offset points", ha="center")


def draw_from_above(axes: Axes, T_paths: Paths) -> tuple[np.ndarray, np.ndarray]:
    """Draw paths from above, on axes in metres of equal scales, so that nothing is mirrored.

    Returns the world's axis that is up, and those to the right and ahead on the page, (2, 3).
    """
    up = up_of(*T_paths.values())
    is_level = up == 0  # up is along one of the world's axes; the others span the page
    page = np.eye(3)[is_level]
    draw_paths(axes, T_paths, page)
    right, ahead = np.array(["x", "y", "z"])[is_level]
    axes.set(xlabel=f"{right} (m)", ylabel=f"{ahead} (m)", aspect="equal")
    # Seen from above, the page's right, its upward direction and up must be right-handed.
    axes.yaxis.set_inverted(np.cross(*page) @ up < 0)
    return up, page


def draw_paths(axes: Axes, T_paths: Paths, to_page: np.ndarray, width: float = 1) -> None:
    """Draw trajectories by label, with a dot where the first one starts.

    The rows of `to_page`, (2, 3), are the page's axes in the world. `width` multiplies lines and
    dot.
    """
    dashes = cycle(("--", "-.", ":"))
    for label, color in method_colors(T_paths).items():
        x, y = to_page @ T_paths[label][:, :3, 3].T
        line = "-" if label == "true" else next(dashes)
        # The true path is wide, so that the others do not hide it.
        look = {"linewidth": width * (4.0 if label == "true" else 1.6), "color": color, "zorder": 3}
        axes.plot(x, y, line, label=label, **look)
    start_x, start_y = to_page @ next(iter(T_paths.values()))[0, :3, 3]
    dot = {"color": "black", "markersize": 5 * width, "zorder": 4}
    # A legend has four keys at most: beside four paths the start has no label.
    axes.plot(start_x, start_y, "o", label="start" if len(T_paths) < 4 else "", **dot)


def draw_cloud(axes: Axes, cloud: pd.DataFrame, T_paths: Paths) -> np.ndarray:
    """Draw paths from above, and coloured points, without those higher than all cameras.

    Without those, no ceiling hides the room. Returns the page's axes in the world, (2, 3): to the
    right and ahead.
    """
    up, page = draw_from_above(axes, T_paths)
    places = cloud[["x", "y", "z"]]
    inside = (places >= places.quantile(_CUT)) & (places <= places.quantile(1 - _CUT))
    heights = (places @ up)[inside.all(axis=1)].sort_values()  # drawn from the floor up
    highest = max((path[:, :3, 3] @ up).max() for path in T_paths.values())
    shown = cloud.loc[heights[heights <= highest + 0.1].index]  # up to 0.1 m above the cameras
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
    """A field's values at a grid of points (m, world frame), drawn at places on the page.

    A signed distance is blue in free space and red in matter, with thin lines 0.25 m apart; a
    density or an occupancy has a logarithmic scale. Black is the surface (the field's
    `surface_level`). What no frame has seen is grey: there the field invents. `bar` holds options
    of `Figure.colorbar`. Returns the scale; with that of another slice as `norm` no bar is drawn.
    """
    _, values = query_field(field, points)
    level = field.surface_level
    if field.is_distance:
        limit = 0.25 * max(1, np.ceil(np.quantile(np.abs(values), 0.98) / 0.25))  # m
        own_norm, colors = Normalize(-limit, limit), "RdBu"
    else:
        own_norm, colors = LogNorm(level / 200, 50 * level, clip=True), "YlOrBr"
    look = {"shading": "nearest", "rasterized": True}  # pixels are centred on the points
    page = np.moveaxis(places, -1, 0)
    image = axes.pcolormesh(*page, values, cmap=colors, norm=norm or own_norm, **look)
    if norm is None:
        bar = {"ax": axes, "label": field.value_label, "extend": "both", **bar}
        axes.figure.colorbar(image, **bar)
    if field.is_distance:
        # Light where the slice is dark.
        tones = ["1" if abs(line) > 0.6 * image.norm.vmax else "0.35" for line in _LINES_M]
        draw_levels(axes, places, values, _LINES_M, colors=tones, linewidths=0.4, linestyles="-")
    draw_levels(axes, places, values, [level], colors="black", linewidths=1.4)
    if seen is not None:
        veil = np.full((*seen.shape, 4), float(UNSEEN))
        veil[..., 3] = ~seen  # transparent over what was seen
        axes.pcolormesh(*page, veil, gid="unseen", zorder=2.5, **look)  # above the map's lines
    return image.norm


def draw_levels(
    axes: Axes, places: np.ndarray, values: np.ndarray, levels: Sequence[float], **look: object
) -> None:
    """Draw lines where values on a grid equal one of `levels`."""
    # Where they equal none, matplotlib would warn.
    if values.min() < max(levels) and min(levels) < values.max():
        axes.contour(*np.moveaxis(places, -1, 0), values, levels, **look)
