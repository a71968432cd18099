"""A horizontal cut through a field: what it says, what is true, and what it made up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nbtrack.core.bounds import SceneBounds
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.mapping.meshes import query_field, seen_by
from nbtrack.plots.style import TRUE_COLOR, WIDTH, camera_positions, new_figure, styled
from nbtrack.plots.top_view import Y_UP, Direction, TopView
from nbtrack.synthetic import Room

_POINTS_ALONG = 240  # grid points along the longer side
_DIMMED = 0.72  # how white the unseen becomes
_LEAST_DENSITY, _LARGEST_DENSITY = 0.1, 1000.0  # 1/m: the logarithmic scale of densities
_PATH_COLOR = "#6a3d9a"


@dataclass(frozen=True)
class _Slice:
    """A regular grid in a horizontal plane, and what is known of its points."""

    right: Float[np.ndarray, "columns"]  # m
    ahead: Float[np.ndarray, "rows"]  # m
    values: Float[np.ndarray, "rows columns"]
    seen: Bool[np.ndarray, "rows columns"]
    true_sdf: Float[np.ndarray, "rows columns"] | None  # m


@styled
def plot_slice(
    field: Field,
    sequence: RgbdSequence,
    height: float,
    room: Room | None = None,
    title: str = "",
    up: Direction = Y_UP,
) -> Figure:
    """A field's values on the horizontal plane `height` metres up, seen from above.

    A signed distance is shown blue in free space and red in matter, a density on a logarithmic
    scale. The black line is the surface (the field's `surface_level`), the green dashed one the
    true surface. What no frame of the sequence has seen is pale: there the field invents.

    Args:
        sequence: the frames that the map was made of: their path is drawn, too.
        room: the exact scene, if it is a synthetic one.
        up: the world's up; the nearest axis is taken.
    """
    view = TopView.along(up)
    cut = _cut(field, sequence, height, room, view)
    low, high = np.array(field.bounds.minimum), np.array(field.bounds.maximum)
    shape = (high - low)[view.ahead] / (high - low)[view.right]
    figure = new_figure(
        title, float(np.clip(0.75 * WIDTH * shape, 3.2, 5.2)) + 1.2, layout="compressed"
    )
    axes = figure.subplots()
    _draw_values(axes, field, cut)
    _draw_lines(axes, field, cut)
    path = view.on_page(camera_positions(sequence.T_world_camera))
    axes.plot(*path.T, color=_PATH_COLOR, linewidth=1.4)
    axes.set_xlim(cut.right[0], cut.right[-1])
    axes.set_ylim(cut.ahead[0], cut.ahead[-1])
    view.finish(axes)
    axes.set_title(f"{field.label} at height {height:.2f} m", fontsize=9)
    axes.grid(False)
    figure.legend(handles=_legend(field, room), loc="outside lower center", ncols=5)
    return figure


def _cut(
    field: Field, sequence: RgbdSequence, height: float, room: Room | None, view: TopView
) -> _Slice:
    right, ahead = _axes_of(field.bounds, view)
    points = np.empty((len(ahead), len(right), 3))
    points[..., view.right], points[..., view.ahead] = np.meshgrid(right, ahead)
    points[..., view.vertical] = view.up_sign * height
    shape, points = points.shape[:2], points.reshape(-1, 3)
    true_sdf = None if room is None else room.sdf(points).reshape(shape)
    values = query_field(field, points)[1].reshape(shape)
    return _Slice(right, ahead, values, seen_by(points, sequence).reshape(shape), true_sdf)


def _axes_of(
    bounds: SceneBounds, view: TopView
) -> tuple[Float[np.ndarray, "columns"], Float[np.ndarray, "rows"]]:
    low, high = np.array(bounds.minimum), np.array(bounds.maximum)
    spacing = (high - low)[[view.right, view.ahead]].max() / _POINTS_ALONG
    return tuple(
        np.linspace(low[axis], high[axis], max(2, round((high[axis] - low[axis]) / spacing) + 1))
        for axis in (view.right, view.ahead)
    )


def _draw_values(axes: Axes, field: Field, cut: _Slice) -> None:
    if _is_distance(field):
        shown = np.abs(cut.values[cut.seen] if cut.seen.any() else cut.values)
        limit = float(np.clip(np.quantile(shown, 0.98), 0.2, 1.5))
        norm, colors, label = Normalize(-limit, limit), "RdBu", "signed distance (m)"
    else:
        norm = LogNorm(_LEAST_DENSITY, _LARGEST_DENSITY, clip=True)
        colors, label = "YlOrBr", "density (1/m)"
    # Pixels are centred on the grid's points.
    image = axes.pcolormesh(
        cut.right, cut.ahead, cut.values, cmap=colors, norm=norm, shading="nearest",
        rasterized=True, gid="values",
    )  # fmt: skip
    veil = np.ones((*cut.seen.shape, 4))
    veil[..., 3] = _DIMMED * ~cut.seen
    axes.pcolormesh(cut.right, cut.ahead, veil, shading="nearest", rasterized=True, gid="unseen")
    axes.figure.colorbar(image, ax=axes, label=label, extend="both", aspect=25, pad=0.015)


def _draw_lines(axes: Axes, field: Field, cut: _Slice) -> None:
    level = field.surface_level
    grid = (cut.right, cut.ahead)
    if _is_distance(field):
        distances = np.arange(0.2, 3.0, 0.2)
        axes.contour(*grid, cut.values, distances, colors="white", linewidths=0.5, alpha=0.7)
    if not cut.values.min() < level < cut.values.max():
        return  # no surface to draw, and matplotlib would warn
    invented = axes.contour(*grid, cut.values, [level], colors="0.45", linewidths=0.8)
    invented.set_gid("invented surface")
    # The line is cut where it was not seen, and drawn over its pale copy where it was.
    on_seen = np.ma.masked_array(cut.values, ~cut.seen)
    axes.contour(*grid, on_seen, [level], colors="black", linewidths=1.7).set_gid("surface")
    if cut.true_sdf is not None and cut.true_sdf.min() < 0 < cut.true_sdf.max():
        true = axes.contour(
            *grid, cut.true_sdf, [0.0], colors=TRUE_COLOR, linewidths=1.5, linestyles="dashed"
        )
        true.set_gid("true surface")


def _legend(field: Field, room: Room | None) -> list[Line2D | Patch]:
    level = "zero level" if _is_distance(field) else f"density {field.surface_level:g}/m"
    entries: list[Line2D | Patch] = [Line2D([], [], color="black", label=f"surface ({level})")]
    if room is not None:
        entries.append(Line2D([], [], color=TRUE_COLOR, linestyle="dashed", label="true surface"))
    entries.append(Line2D([], [], color=_PATH_COLOR, linewidth=1.4, label="camera path"))
    entries.append(Line2D([], [], color="0.45", linewidth=0.8, label="surface, invented"))
    entries.append(Patch(facecolor="0.94", edgecolor="0.7", label="pale: never seen"))
    return entries


def _is_distance(field: Field) -> bool:
    """Whether the field's values are signed distances: their surface is where they vanish."""
    return field.surface_level == 0
