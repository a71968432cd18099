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

_TRUE_LINE = {"colors": method_colors(["true"])["true"], "linestyles": "--"}


@styled
def plot_slice(
    fields: Field | Sequence[Field],
    sequence: RgbdSequence,
    height: float | None = None,
    room: Room | None = None,
    title: str = "",
) -> Figure:
    """A field's values on the horizontal plane `height` metres up, drawn as `draw_slice` does.

    Fields of one recording stand side by side, in the colour scale of the first. `sequence` are the
    frames that the maps were made of; `height` is by default the cameras' mean. `room` is the exact
    scene, if it is known: its surface is dashed green, and its distance stands before those of the
    fields. The axes end around the path and what the frames have seen, within the room. What single
    rays saw between others counts as not seen.
    """
    drawn = [fields] if isinstance(fields, Field) else [*fields]
    if room is not None and drawn[0].is_distance:
        drawn.insert(0, ExactDistance(room, drawn[0]))
    # Lower with more panels, which are narrower.
    panels = new_axes(title, 5.4 - 0.8 * (len(drawn) - 1), 1, len(drawn), sharey=True)[0]
    norm, bar = None, {"ax": panels, "aspect": 25, "pad": 0.015}  # the first field's, for all
    of_cameras = (sequence.T_world_camera[:, :3, 3] @ scene.up_of(sequence.T_world_camera)).mean()
    height = of_cameras if height is None else height
    above = f", {of_cameras - height:.1f} m higher up" if abs(of_cameras - height) > 0.05 else ""
    for axes, field in zip(panels, drawn, strict=True):
        up, page = scene.draw_from_above(axes, {f"cameras{above}": sequence.T_world_camera})
        low, high = np.array([field.bounds.minimum, field.bounds.maximum]) @ page.T
        step = (high - low).max() / 240  # m
        points, places = _level_grid(page, low, high + step, step, height * up)
        shown = binary_opening(seen_by(points, sequence), iterations=2)
        norm = scene.draw_slice(axes, field, points, places, shown, norm, **bar)
        what = f": {field.value_label.partition(' ')[0]} of {field.surface_level:g}"
        # Without points: it only names the lines drawn above in the legend.
        axes.plot([], [], "k-", label="surface" if field.is_distance else f"surface{what}")
        if room is not None:
            shown = shown & _draw_true_level(axes, room, points, places)
        axes.plot([], [], "s", color=scene.UNSEEN, label="hardly or never seen")
        axes.set_title(f"{field.label}, {height:.2f} m up")
        _end_around(axes, places[shown], sequence.T_world_camera[:, :3, 3] @ page.T)
    return panels[0].figure.legend_below()


def _draw_true_level(axes: Axes, room: Room, points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A room's true surface, dashed, on a slice; returns which of its points lie in the room."""
    sdf = room.sdf(points.reshape(-1, 3)).reshape(points.shape[:2])
    scene.draw_levels(axes, places, sdf, [0.0], zorder=3, **_TRUE_LINE)
    axes.plot([], [], "--", color=_TRUE_LINE["colors"], label="true surface")
    return sdf > 0


def _end_around(axes: Axes, *places: np.ndarray) -> None:
    """End axes 0.1 m around places on the page (n, 2); side by side only the first labels y."""
    x, y = np.concatenate(places).T
    axes.set_xbound(x.min() - 0.1, x.max() + 0.1)
    axes.set_ybound(y.min() - 0.1, y.max() + 0.1)  # an axis that is turned around stays so
    axes.label_outer()


def _level_grid(
    page: np.ndarray, low: np.ndarray, high: np.ndarray, step: float, raised: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (rows, columns, 3; m, world frame) of a level plane, and their places on a page.

    The rows of `page` are its axes in the world. Places run from `low` to `high` on it, `step`
    metres apart; `raised` is the vector (m) from the world's origin up to the plane.
    """
    sides = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*sides), axis=-1)
    return places @ page + raised, places


@styled
def plot_mesh(meshes: Mapping[str, trimesh.Trimesh], T_paths: Paths, title: str = "") -> Figure:
    """Vertex-coloured meshes of a room by label, without the near walls and the ceiling.

    One looks from outside, from where most of the first mesh shows its front; faces that show their
    back are left out. The projection is parallel; lengths across the picture are true (m). The
    camera-to-world poses by label are drawn on top; "true" is green, "tracked" red.
    """
    panels = new_axes(title, 5.0 - 0.4 * len(meshes), 1, len(meshes), sharex=True, sharey=True)[0]
    to_screen = None  # the first mesh's view, for all
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

    The surface is drawn as `plot_mesh` draws it, from a grid of `voxel` metres. Beside it is the
    slice at the cameras' mean height in the same projection, grey where no frame of `sequence` has
    seen it. Both have camera-to-world poses (m) by label; the last panel has how far (mm) those
    after the first are from the first, pose by pose.
    """
    mesh = extract_mesh(field, sequence, voxel=voxel)
    up = scene.up_of(sequence.T_world_camera)
    room, level, errors = new_axes(title, 3.3, 1, 3, width_ratios=[1.3, 1.3, 0.9])[0]
    level.sharex(room)
    level.sharey(room)
    to_page = scene.draw_mesh(room, mesh, up)[:2]
    paths = {label: path[:, :3, 3] for label, path in T_paths.items()}
    height = (sequence.T_world_camera[:, :3, 3] @ up).mean()
    points = _level_points(np.concatenate([mesh.bounds, *paths.values()]), voxel, up, height)
    shown = seen_by(points, sequence)
    bar = {"ax": [room, level], "shrink": 0.7, "aspect": 25}  # beside both: they share a size
    scene.draw_slice(level, field, points, points @ to_page.T, shown, **bar)
    level.set_axis_off()
    level.set_aspect("equal")
    for axes, name in (room, "surface: the zero level"), (level, "slice at the cameras' height"):
        scene.draw_paths(axes, T_paths, to_page, 0.7)
        axes.set_title(name)
    scene.draw_scale(room, level)
    first, *others = paths
    for label in others:
        off_mm = 1000 * np.linalg.norm(paths[label] - paths[first], axis=1)
        errors.plot(off_mm, color=method_colors(paths)[label])
    errors.set(title="error", xlabel="frame", ylabel=f"off the {first} path (mm)", ylim=(0, None))
    return room.figure.legend_below()


def _level_points(shown: np.ndarray, step: float, up: np.ndarray, height: float) -> np.ndarray:
    """Points (rows, columns, 3; m, world frame) of a level plane, where some points (m) lie.

    Of those `shown` may be paths, which lead beyond what was seen.
    """
    level = np.eye(3)[up == 0]  # the two level axes of the world
    places = shown @ level.T
    low, high = places.min(axis=0) - step, places.max(axis=0) + 2 * step
    return _level_grid(level, low, high, step, height * up)[0]


@styled
def plot_overview(
    cloud: pd.DataFrame, T_paths: Paths, frames: pd.DataFrame | None, title: str
) -> Figure:
    """Coloured points (m) and paths from above, and the errors of a tracked run by frame.

    The cloud's columns are x, y, z (m, world frame), red, green, blue (0 to 255); what is higher
    than all cameras is left out. Walls should be thin and straight: doubled or fanned ones mean
    that a recording is read wrongly. `frames` are those of the run that is called "tracked";
    without them, or without a known true pose, there are no errors.
    """
    has_errors = frames is not None and frames["translation_error_m"].notna().any()
    panels = new_axes(title, 4.2 if has_errors else 6.0, 1, 2 if has_errors else 1)[0]
    scene.draw_cloud(panels[0], cloud, T_paths)
    if has_errors:
        draw_errors(panels[1], {"tracked": frames})
        panels[1].set_xlabel("frame")
        panels[1].legend(loc="best")
    return panels[0].figure.legend_below()
