"""Figures of rooms: a slice, a mesh, the paper's Figure 1, and an overview of a run."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import binary_opening

from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.plots import scene
from nbtrack.plots.figures import draw_errors
from nbtrack.plots.meshes import ExactDistance, extract_mesh, seen_by
from nbtrack.plots.scene import Paths
from nbtrack.plots.style import method_colors, new_axes, styled
from nbtrack.synthetic import Room

_TRUE_LINE = {"color": method_colors(["true"])["true"], "linewidth": 1.1}


@styled
def plot_slice(
    fields: Field | Sequence[Field],
    sequence: RgbdSequence,
    height: float | None = None,
    room: Room | None = None,
    title: str = "",
) -> Figure:
    """The values of a field on a horizontal plane, `height` metres up, seen from above.

    Several fields of one recording are drawn side by side, with the colour scale of the first.
    `sequence` holds the frames that the maps were made from; the default `height` is the mean of
    its cameras. If the exact `room` is known, its surface is a thin green line, and its exact
    distance is drawn before the fields, so that it sets the scale. The axes cover the camera path
    and what the frames have seen (inside the room). Spots that only a few rays have seen count as
    not seen.
    """
    drawn = [fields] if isinstance(fields, Field) else [*fields]
    if room is not None and drawn[0].is_distance:
        drawn.insert(0, ExactDistance(room, drawn[0]))
    panels = new_axes(title, 5.4 - 0.8 * (len(drawn) - 1), 1, len(drawn), sharey=True)[0]
    bar = {"ax": panels, "aspect": 25, "pad": 0.015}
    norm = None  # the first slice makes the colour scale and its bar; the others take the scale
    mean_m = np.nanmean(sequence.T_world_camera[:, :3, 3] @ scene.up_of(sequence.T_world_camera))
    height = mean_m if height is None else height
    side, away_m = "higher up" if mean_m > height else "lower down", abs(mean_m - height)
    above = f", {away_m:.1f} m {side}" if away_m > 0.05 else ""
    for axes, field in zip(panels, drawn, strict=True):
        up, page = scene.draw_from_above(axes, {f"cameras{above}": sequence.T_world_camera})
        low, high = np.array([field.bounds.minimum, field.bounds.maximum]) @ page.T
        step = (high - low).max() / 240  # m: at most about 240 points along a side
        points, places = _level_grid(page, low, high + step, step, height * up)
        is_seen = binary_opening(seen_by(points, sequence), iterations=2)  # without small spots
        norm = scene.draw_slice(axes, field, points, places, is_seen, norm, **bar)
        if room is not None:
            is_seen = is_seen & _draw_true_level(axes, room, points, places)
        axes.set_title(f"{field.label}, {height:.2f} m up")
        _end_around(axes, places[is_seen], sequence.T_world_camera[:, :3, 3] @ page.T)
    return panels[0].figure.legend_below()


def _draw_true_level(axes: Axes, room: Room, points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Draw a room's true surface on a slice; returns which points lie in free space."""
    sdf = room.sdf(points.reshape(-1, 3)).reshape(points.shape[:2])
    look = {"colors": _TRUE_LINE["color"], "linewidths": _TRUE_LINE["linewidth"], "zorder": 3}
    scene.draw_levels(axes, places, sdf, [0.0], **look)
    axes.plot([], [], label="true surface", **_TRUE_LINE)
    return sdf > 0


def _end_around(axes: Axes, *places: np.ndarray) -> None:
    """Limit axes to 0.1 m around places on the page (n, 2), and leave labels to outer axes."""
    ends = np.concatenate(places)
    (left, low), (right, high) = np.nanmin(ends, axis=0) - 0.1, np.nanmax(ends, axis=0) + 0.1
    axes.set_xbound(left, right)
    axes.set_ybound(low, high)  # unlike set_ylim, this keeps an inverted axis
    axes.label_outer()


def _level_grid(
    page: np.ndarray, low: np.ndarray, high: np.ndarray, step: float, raised: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A grid on a horizontal plane: its points, and their places on the page.

    Points are (rows, columns, 3; m, world frame), places (rows, columns, 2; m). Places lie between
    `low` and `high`, `step` metres apart. The rows of `page` are the page's axes (world frame), and
    `raised` is the vector (m) from the world's origin straight up to the plane.
    """
    x, y = (np.arange(start, end, step) for start, end in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(x, y), axis=-1)
    return places @ page + raised, places


@styled
def plot_mesh(meshes: Mapping[str, trimesh.Trimesh], T_paths: Paths, title: str = "") -> Figure:
    """Vertex-coloured meshes of a room, by label, seen from outside, with camera paths on top.

    The viewer stands where the front of most of the first mesh is seen. Faces that show their back
    are left out, so that the near walls and the ceiling do not hide the room. The projection is
    parallel; horizontal lengths in the picture are true (m). `T_paths` are camera-to-world poses
    (m) by label; "true" is green, "tracked" red.
    """
    panels = new_axes(title, 5.2 - 0.6 * len(meshes), 1, len(meshes), sharex=True, sharey=True)[0]
    to_screen = None  # the view of the first mesh, which the others share
    for axes, (label, mesh) in zip(panels, meshes.items(), strict=True):
        to_screen = scene.draw_mesh(axes, mesh, scene.up_of(*T_paths.values()), to_screen)
        scene.draw_paths(axes, T_paths, to_screen[:2])
        axes.set_title(label)
    scene.draw_scale(*panels)
    return panels[0].figure.legend_below()


@styled
def plot_map_and_slice(
    field: Field, sequence: RgbdSequence, T_paths: Paths, title: str = "", voxel: float = 0.04
) -> Figure:
    """A map as in the paper's Figure 1: its surface, a slice through its signed distance, paths.

    The first panel has the surface as in `plot_mesh`, from a grid with cells of `voxel` metres. The
    second has a horizontal slice at the cameras' mean height in the same projection; what no frame
    of `sequence` has seen is grey. Both show the paths, which are camera-to-world poses (m) by
    label; NaN if unknown. The last panel has the distances (mm) of other paths from the first.
    """
    mesh = extract_mesh(field, sequence, voxel=voxel)
    up = scene.up_of(sequence.T_world_camera)
    left, middle, right = new_axes(title, 3.4, 1, 3, width_ratios=[1.3, 1.3, 1])[0]
    left.figure.get_layout_engine().set(wspace=0.08)
    middle.sharex(left)
    middle.sharey(left)
    to_page = scene.draw_mesh(left, mesh, up)[:2]
    paths = {label: path[:, :3, 3] for label, path in T_paths.items()}
    height = np.nanmean(sequence.T_world_camera[:, :3, 3] @ up)
    level = np.eye(3)[up == 0]  # the world's horizontal axes: `up` is a signed axis of the world
    places = np.concatenate([mesh.bounds, *paths.values()]) @ level.T
    low, high = np.nanmin(places, axis=0) - voxel, np.nanmax(places, axis=0) + 2 * voxel
    points, _ = _level_grid(level, low, high, voxel, height * up)
    is_seen = seen_by(points, sequence)
    # The colour bar is that of both panels, so that they keep the same size.
    bar = {"ax": [left, middle], "shrink": 0.7, "aspect": 25}
    scene.draw_slice(middle, field, points, points @ to_page.T, is_seen, **bar)
    middle.set_axis_off()
    middle.set_aspect("equal")
    for axes, name in (left, "surface: the zero level"), (middle, "slice at the cameras' height"):
        scene.draw_paths(axes, T_paths, to_page, 0.7)
        axes.set(title=name, anchor="N")  # as high as the last panel
    scene.draw_scale(left, middle)
    left.margins(0.01)
    first, *others = paths
    for label in others:
        off_mm = 1000 * np.linalg.norm(paths[label] - paths[first], axis=1)
        right.plot(off_mm, color=method_colors(paths)[label])
    right.set(title="error by frame", xlabel="frame", ylabel="position error (mm)", ylim=(0, None))
    return left.figure.legend_below(panel=1)


@styled
def plot_overview(
    cloud: pd.DataFrame, T_paths: Paths, frames: pd.DataFrame | None, title: str
) -> Figure:
    """Coloured points (m) and camera paths from above, and the errors of a tracked run by frame.

    The cloud's columns are x, y, z (m, world frame), red, green, blue (0 to 255). `draw_cloud`
    says which points are left out. Walls should look thin and straight: if they are doubled or
    spread like a fan, the recording is read wrongly. `frames` are the rows of the run whose path is
    called "tracked". Without them, or without any known true pose, the figure has no errors.
    """
    has_errors = frames is not None and frames["translation_error_m"].notna().any()
    panels = new_axes(title, 4.2 if has_errors else 6.0, 1, 2 if has_errors else 1)[0]
    scene.draw_cloud(panels[0], cloud, T_paths)
    if has_errors:
        draw_errors(panels[1], {"tracked": frames})
        panels[1].set_xlabel("frame")
        panels[1].legend(loc="best")
    return panels[0].figure.legend_below()
