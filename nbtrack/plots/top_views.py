"""The world seen from above: a field's values, observed points, paths, a recording.

Up is the axis of the world that the cameras' own up is nearest to: they are mostly held upright.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from nbtrack.core.arrays import Points, Poses, Transform, Values
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.mapping.meshes import query_field, seen_by
from nbtrack.plots.style import TRUE_COLOR, draw_paths, legend_below, new_axes, styled
from nbtrack.synthetic import Room

_POINTS_ALONG = 240  # grid points along the longer side of a slice
_DIMMED = 0.72  # how white the unseen becomes
_CUT = 0.01  # share of a recording's points cut off at either end: wild depths hide the room


@styled
def plot_slice(
    field: Field, sequence: RgbdSequence, height: float, room: Room | None = None, title: str = ""
) -> Figure:
    """A field's values on the horizontal plane `height` metres up.

    A signed distance is blue in free space and red in matter, a density logarithmic. Black is the
    surface (the field's `surface_level`), dashed green the true one. What no frame has seen is
    pale: there the field invents.

    Args:
        sequence: the frames that the map was made of: their path is drawn, too.
        room: the exact scene, if it is a synthetic one.
    """
    right, ahead, points = _plane(field.bounds, up_of(sequence.T_world_camera), height)
    shape, level = (len(ahead), len(right)), field.surface_level
    values, seen = query_field(field, points)[1].reshape(shape), seen_by(points, sequence)
    norm, colors, label = LogNorm(0.1, 1000.0, clip=True), "YlOrBr", "density (1/m)"
    if level == 0:
        limit = np.clip(np.quantile(np.abs(values), 0.98), 0.2, 1.5)
        norm, colors, label = Normalize(-limit, limit), "RdBu", "signed distance (m)"
    axes = new_axes(title, 5.4, layout="compressed")[0, 0]
    grid = {"shading": "nearest", "rasterized": True}  # pixels are centred on the points
    image = axes.pcolormesh(right, ahead, values, cmap=colors, norm=norm, **grid)
    axes.figure.colorbar(image, ax=axes, label=label, extend="both", aspect=25, pad=0.015)
    lines = {"surface": (values - level, 2, "black", "-")}  # below what makes the unseen pale
    if room is not None:
        lines["true surface"] = (room.sdf(points).reshape(shape), 3, TRUE_COLOR, "--")
    for name, (zero_there, zorder, color, style) in lines.items():
        axes.plot([], [], style, color=color, label=name)
        if zero_there.min() < 0 < zero_there.max():  # matplotlib warns where there is no line
            look = {"colors": color, "linestyles": style, "zorder": zorder}
            axes.contour(right, ahead, zero_there, [0.0], **look)
    veil = np.ones((*shape, 4))
    veil[..., 3] = _DIMMED * ~seen.reshape(shape)
    axes.pcolormesh(right, ahead, veil, gid="unseen", zorder=2.5, **grid)
    _draw_from_above(axes, {"camera path": sequence.T_world_camera})
    axes.set_title(f"{field.label} at height {height:.2f} m; pale: never seen")
    legend_below(axes.figure)
    return axes.figure


@styled
def plot_points(points: Mapping[str, tuple[Points, Values, Transform]], title: str = "") -> Figure:
    """Observed points by their signed distance (cm) in a map, a panel a pose.

    White points lie on the map's surface, blue ones in front of it, red ones behind it. All panels
    share one scale, cut at the 95 % quantile of the first. The dot is the camera.

    Args:
        points: by label, as "before" and "after": points (m, world frame), their signed distances
            (m), and the camera-to-world pose that placed them.
    """
    look = {"layout": "compressed", "sharex": True, "sharey": True}
    panels = new_axes(title, 4.5, 1, len(points), **look)[0]
    limit = 100 * float(next(iter(points.values()))[1].abs().quantile(0.95))
    look = {"cmap": "RdBu", "s": 6, "edgecolors": "0.6", "linewidths": 0.15}
    for axes, (label, parts) in zip(panels, points.items(), strict=True):
        places, sdf, T_world_camera = (part.cpu().numpy() for part in parts)
        page = page_axes(up_of(T_world_camera[None]))
        image = axes.scatter(*places[:, page].T, c=100 * sdf, vmin=-limit, vmax=limit, **look)
        _draw_from_above(axes, {"camera": T_world_camera[None]})
        axes.set_title(f"{label}: mean |distance| {100 * np.abs(sdf).mean():.2f} cm")
        axes.set_facecolor("0.93")
    look = {"label": "signed distance (cm)", "extend": "both", "aspect": 25}
    axes.figure.colorbar(image, ax=list(panels), **look)
    return axes.figure


@styled
def plot_trajectories(T_true: Poses, estimates: Mapping[str, Poses], title: str = "") -> Figure:
    """Paths (m) from above: camera-to-world poses by method, the true ones green."""
    axes = new_axes(title, 4.7)[0, 0]
    _draw_from_above(axes, {"true": T_true, **estimates})
    legend_below(axes.figure)
    return axes.figure


@styled
def plot_recording(cloud: pd.DataFrame, T_world_camera: Poses, title: str) -> Figure:
    """A recording's coloured points (m) and the camera's path, without what is higher than it.

    Walls should be thin and straight: doubled or fanned ones mean that something is read wrongly.

    Args:
        cloud: with columns x, y, z (m, world frame), red, green, blue (0 to 255).
    """
    up, places = up_of(T_world_camera), cloud[["x", "y", "z"]]
    inside = (places >= places.quantile(_CUT)) & (places <= places.quantile(1 - _CUT))
    heights = (places @ up)[inside.all(axis=1)].sort_values()  # drawn from the floor up
    shown = cloud.loc[heights.index[heights <= (T_world_camera[:, :3, 3] @ up).max() + 0.1]]
    axes = new_axes(title, 6.0, layout="compressed")[0, 0]
    page = shown[["x", "y", "z"]].to_numpy()[:, page_axes(up)]
    colors = shown[["red", "green", "blue"]].to_numpy() / 255
    axes.scatter(*page.T, c=colors, s=1.5, linewidths=0)
    _draw_from_above(axes, {"true": T_world_camera})
    return axes.figure


def up_of(*T_paths: Poses) -> np.ndarray:
    """The world's axis, with its sign, that is nearest to the mean up of cameras."""
    above = -np.concatenate(T_paths)[:, :3, 1].mean(axis=0)
    axis = np.abs(above).argmax()
    return np.sign(above[axis]) * np.eye(3)[axis]


def page_axes(up: np.ndarray) -> list[int]:
    """Indices of the world's axes to the right and ahead, seen from above."""
    return [axis for axis in range(3) if up[axis] == 0]


def _draw_from_above(axes: Axes, T_paths: Mapping[str, Poses]) -> None:
    """Paths, and axes in metres, equal, and turned so that nothing is mirrored."""
    up = up_of(*T_paths.values())
    right, ahead = page_axes(up)
    draw_paths(axes, T_paths, np.eye(3)[[right, ahead]])
    axes.set(xlabel=f"{'xyz'[right]} (m)", ylabel=f"{'xyz'[ahead]} (m)", aspect="equal")
    # Right, page-up and up must be right-handed.
    axes.yaxis.set_inverted(np.cross(np.eye(3)[right], np.eye(3)[ahead]) @ up < 0)


def _plane(
    bounds: SceneBounds, up: np.ndarray, height: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A regular grid `height` metres up: its coordinates to the right and ahead, and its points."""
    page = page_axes(up)
    low, high = np.array(bounds.minimum)[page], np.array(bounds.maximum)[page]
    step = (high - low).max() / _POINTS_ALONG
    right, ahead = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    points = np.tile(height * up, (len(ahead) * len(right), 1))
    points[:, page] = np.stack(np.meshgrid(right, ahead), axis=-1).reshape(-1, 2)
    return right, ahead, points
