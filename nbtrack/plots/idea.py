"""What both trackers ask a map for: samples along a ray, or measured points."""

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from torch import Tensor
from torch.nn.functional import normalize

from nbtrack.core.arrays import Pose
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import Rays
from nbtrack.fields import LearnedField
from nbtrack.plots.scene import draw_slice
from nbtrack.plots.style import WIDTH, method_colors, new_axes, styled

_STEP = 0.01  # m, between the grid points of a slice
_BEFORE, _BEHIND, _ASIDE = 0.2, 0.45, 0.45  # m, drawn before the camera, behind the measured point
_N_STRATIFIED, _N_IMPORTANCE = 32, 12  # iMAP's samples along a ray
_DOT = {"edgecolors": "black", "linewidths": 0.5, "zorder": 4}
_HALO = withStroke(linewidth=3, foreground="white")
_COLORS = method_colors(["VR", "SDF", "true"])


@styled
def plot_idea(
    field: LearnedField,
    frame: Frame,
    T_world_camera: Mapping[str, Pose],
    pixel: tuple[int, int],
    title: str = "",
    before: float = np.inf,
) -> Figure:
    """What a tracker asks a map at the measured pixel of a frame nearest to `pixel` (row, column).

    Each panel has one of the estimates `T_world_camera` (m) of the frame's pose, by its title. A
    slice lies in the plane of all rays of the pixel's row, from the camera; the pixel's ray runs to
    the right, and with `before` only that much (m) of it before the measured point is drawn. In a
    map of a density it shows the samples of iMAP along this ray, the larger the more they weigh,
    and the distance that they render. In one of a signed distance d it shows the row's measured
    points, one query each, and from each a step of length |d| against the gradient.
    """
    points_camera, point_camera = _points_of_row(frame, *pixel)
    distance = point_camera.norm().item()
    x = np.arange(max(-_BEFORE, distance - before), distance + _BEHIND, _STEP)
    n, texts = len(T_world_camera), 1.15 if any(T_world_camera) else 1.1  # inches of height
    height = texts + 0.82 * WIDTH / n * 2 * _ASIDE / (x[-1] - x[0])  # both axes have one scale
    panels = new_axes(title, height, 1, n, sharey=True)[0]
    page_camera = _page_camera(point_camera / distance)
    places = np.stack(np.meshgrid(x, np.arange(-_ASIDE, _ASIDE + _STEP, _STEP)), axis=-1)
    norm, bar = None, {"ax": panels, "aspect": 25, "pad": 0.015}  # the first's scale, for all
    for axes, (name, T) in zip(panels, T_world_camera.items(), strict=True):
        grid_world = places @ page_camera.numpy() @ T[:3, :3].T + T[:3, 3]
        norm = draw_slice(axes, field, grid_world, places, norm=norm, **bar)
        _draw_camera(axes)
        if field.is_distance:
            _draw_queries(axes, field, T, points_camera, page_camera)
        else:
            _draw_samples(axes, field, T, point_camera)
        # Without points: it only names the surface, which `draw_slice` drew, in the legend.
        axes.plot([], [], "k-", label=f"surface of {field.label}")
        axes.set(xlim=x[[0, -1]], ylim=(-_ASIDE, _ASIDE), aspect="equal", title=name)
        axes.set(xlabel="along the ray (m)", ylabel="to its left (m)")
        axes.label_outer()
    return panels[0].figure.legend_below()


def _points_of_row(frame: Frame, row: int, column: int) -> tuple[Tensor, Tensor]:
    """Points (n, 3; m) of the row of the measured pixel nearest to a pixel, and its own (3,)."""
    pixels = frame.measured_pixels()
    away = (pixels - torch.tensor([[row], [column]])).abs().sum(dim=0)
    in_row = pixels[:, pixels[0] == pixels[0, away.argmin()]]
    points_camera, _ = frame.points(*in_row)
    return points_camera, points_camera[(in_row[1] - column).abs().argmin()]


def _page_camera(along: Tensor) -> Tensor:
    """The page's axes in the camera's frame, (2, 3): a ray's unit vector, and to its left."""
    x_camera = along.new_tensor([1.0, 0, 0])
    left = along * along[0] - x_camera  # minus x, without its part along the ray
    return torch.stack([along, left / left.norm()])


def _draw_camera(axes: Axes) -> None:
    """The camera at the page's origin, and its ray; what lies beyond the axes is cut off."""
    axes.axhline(0, color="0.2", linewidth=0.8)
    # With white, since the slice may be dark here.
    axes.fill([0, 0.2, 0.2], [0, 0.12, -0.12], facecolor="white", edgecolor="black", linewidth=1.5)
    look = {"ha": "center", "va": "top", "path_effects": [_HALO], "clip_on": True}
    axes.text(0.1, -0.17, "camera", **look)


def _draw_samples(axes: Axes, field: LearnedField, T: Pose, point_camera: Tensor) -> None:
    """iMAP's samples on the ray to a measured point (m), and the distance that they render.

    `T` is the camera's pose (camera to world, m). Distances on the page are along the ray, not z.
    """
    pose = torch.from_numpy(T).float()
    direction = point_camera[None] / point_camera[2]  # of z = 1 in the camera, so that depth is z
    not_used = pose.new_zeros(1, 3)  # observed colour and depth, which rendering does not ask for
    rays = Rays(pose[None, :3, 3], direction @ pose[:3, :3].T, not_used, not_used[:, 0])
    with torch.no_grad():
        depths = field.hierarchical_depths(rays, _N_STRATIFIED, _N_IMPORTANCE)
        rendered = field.render(rays, depths)
    distances = depths[0] * direction.norm().item()
    sizes = 12 + 400 * rendered.weights[0]  # areas in square points; none vanishes
    label = f"{len(distances)} samples, by weight"
    axes.scatter(distances, 0 * distances, s=sizes, label=label, color=_COLORS["VR"], **_DOT)
    measured, found = point_camera.norm().item(), rendered.depth.item() * direction.norm().item()
    axes.axvline(found, linestyle="--", color=_COLORS["VR"], label="rendered distance")
    axes.scatter(measured, 0, s=60, label="measured point", color=_COLORS["true"], **_DOT)
    axes.annotate("", (found, 0.1), (measured, 0.1), arrowprops={"arrowstyle": "<->"})
    error = f"error {100 * abs(found - measured):.0f} cm  "
    axes.text(min(measured, found), 0.1, error, ha="right", va="center")


def _draw_queries(
    axes: Axes, field: LearnedField, T: Pose, points_camera: Tensor, page_camera: Tensor
) -> None:
    """Measured points (m) on the page, and from each a step of length |d| against the gradient.

    `T` is the camera's pose (camera to world, m), and the rows of `page_camera` the page's axes.
    """
    pose = torch.from_numpy(T).float()
    points_world = transform_points(pose, points_camera).requires_grad_()
    _, sdf = field(points_world)
    (gradient,) = torch.autograd.grad(sdf.sum(), points_world)
    # The last factor turns steps from the world into the camera's frame.
    ends_camera = points_camera - sdf.detach()[:, None] * normalize(gradient) @ pose[:3, :3]
    start = (points_camera @ page_camera.T).numpy()
    end = (ends_camera @ page_camera.T).numpy()
    axes.scatter(*start.T, s=20, label="measured points", color=_COLORS["true"], **_DOT)
    # For the legend, which would not show arrows.
    axes.plot([], [], color=_COLORS["SDF"], label="|d| against the gradient")
    look = {"color": _COLORS["SDF"], "angles": "xy", "scale_units": "xy", "scale": 1, "zorder": 5}
    axes.quiver(*start.T, *(end - start).T, units="inches", width=0.022, **look)
