"""Where the camera went, where a tracker thought it went, and how far apart the two are."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from nbtrack.data.sequence import FRAMES_PER_SECOND
from nbtrack.plots.style import (
    TRUE_LABEL,
    WIDTH,
    camera_positions,
    method_colors,
    new_figure,
    path_colors,
    styled,
)
from nbtrack.plots.top_view import Y_UP, Direction, TopView
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

_CENTIMETRES = 100
_MESH_COLOR = "#b9b9b9"


@styled
def plot_trajectories(
    T_true: Float[np.ndarray, "n 4 4"],
    estimates: Mapping[str, Float[np.ndarray, "_ 4 4"]],
    title: str = "",
    mesh: trimesh.Trimesh | None = None,
    up: Direction = Y_UP,
) -> Figure:
    """Paths (m) from above; the start is a dot.

    The true one is green. A single estimate is red, as in the paper's first figure; several have
    the colours of their methods.

    Args:
        estimates: camera-to-world poses by method.
        mesh: of the scene; a panel more shows the paths in its cut at their mean height.
        up: the world's up; the nearest axis is taken.
    """
    view = TopView.along(up)
    paths = {TRUE_LABEL: T_true, **estimates}
    positions = {label: camera_positions(T) for label, T in paths.items()}
    colors = path_colors(paths)
    figure = new_figure(title, 0.52 * WIDTH)
    panels = figure.subplots(1, 1 if mesh is None else 2, squeeze=False)[0]
    for axes in panels:
        for label, points in positions.items():
            width = 2.6 if label == TRUE_LABEL else 1.4
            page = view.on_page(points)
            axes.plot(*page.T, color=colors[label], label=label, linewidth=width, zorder=3)
        start = view.on_page(positions[TRUE_LABEL][:1])
        axes.plot(*start.T, "o", color="black", markersize=5, zorder=4, label="start")
        view.finish(axes)
        axes.margins(0.08)
    if mesh is not None:
        _draw_cut(panels[0], mesh, view, float(positions[TRUE_LABEL][:, view.vertical].mean()))
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@styled
def plot_errors(frames: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """Errors of every frame over time: position (cm, logarithmic) and orientation (degrees).

    Above the dashed line, 0.2 m, the paper calls the camera lost.

    Args:
        frames: by method, with columns frame_id, translation_error_m and rotation_error_deg. The
            first frame, whose pose was given, is left out.
    """
    colors = method_colors(frames)
    figure = new_figure(title, 4.9)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for label, rows in frames.items():
        tracked = rows.iloc[1:]
        seconds = tracked["frame_id"] / FRAMES_PER_SECOND
        errors_cm = _CENTIMETRES * tracked["translation_error_m"]
        above.plot(seconds, errors_cm, color=colors[label], label=label)
        below.plot(seconds, tracked["rotation_error_deg"], color=colors[label])
    above.axhline(_CENTIMETRES * LOST_THRESHOLD_M, color="0.3", linestyle="--", linewidth=1)
    above.annotate(
        "lost: above 0.2 m", (0.005, _CENTIMETRES * LOST_THRESHOLD_M), va="bottom", color="0.3",
        xycoords=("axes fraction", "data"), xytext=(0, 2), textcoords="offset points",
    )  # fmt: skip
    above.set(yscale="log", ylabel="translation error (cm)")
    low, high = above.get_ylim()
    above.set_ylim(low, max(high, 2 * _CENTIMETRES * LOST_THRESHOLD_M))
    figure.legend(loc="outside lower center", ncols=len(frames))
    above.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    below.set(ylabel="rotation error (degrees)", xlabel="time (s)")
    below.set_ylim(bottom=0)
    below.set_xlim(left=0)
    figure.align_ylabels()
    return figure


def _draw_cut(axes: Axes, mesh: trimesh.Trimesh, view: TopView, level: float) -> None:
    """Lines in which a horizontal plane cuts the mesh."""
    normal, origin = np.zeros(3), np.zeros(3)
    normal[view.vertical], origin[view.vertical] = 1.0, level
    segments = trimesh.intersections.mesh_plane(mesh, normal, origin)
    if len(segments):
        page = segments[:, :, [view.right, view.ahead]]
        lines = LineCollection(page, colors=_MESH_COLOR, linewidths=1.0, label="map's surface")
        axes.add_collection(lines)
        axes.autoscale_view()
