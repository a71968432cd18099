"""A figure of the paper's idea: how volume rendering and signed distances use a map in tracking."""

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
from nbtrack.machinery.errors import ConfigError
from nbtrack.plots.scene import draw_slice
from nbtrack.plots.style import WIDTH, method_colors, new_axes, styled

_STEP = 0.01  # m, between the grid points of the slice
# How far (m) the figure reaches: behind the camera, beyond the measured point, and to either side
# of the ray.
_BEHIND_CAMERA, _BEYOND, _ASIDE = 0.2, 0.45, 0.45
_PANELS_SHARE = 0.82  # of the figure's width; labels and the colour bar have the rest
_N_STRATIFIED, _N_IMPORTANCE = 32, 12  # iMAP's numbers of samples along a ray
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
    """Slices through a map along a pixel's ray, with what a tracker asks the map there.

    The pixel is the measured one nearest to `pixel` (row, column). Each panel, by its title, has an
    estimate of the frame's pose (m). Its slice is the plane of all rays of the pixel's row; the
    pixel's ray runs to the right, and `before` limits how much of it (m) is drawn before the
    measured point. For a density it shows iMAP's samples along the ray, the larger the more they
    weigh, and the distance that they render. For a signed distance d it shows the row's measured
    points, at which d is asked for, and from each the step -d along the unit gradient of d.
    """
    points_camera, point_camera = _points_of_row(frame, *pixel)
    distance = point_camera.norm().item()
    x = np.arange(max(-_BEHIND_CAMERA, distance - before), distance + _BEYOND, _STEP)
    text_height = 1.3 if any(T_world_camera) else 1.1  # inches; more if a panel has a title
    panel_width = _PANELS_SHARE * WIDTH / len(T_world_camera)
    height = text_height + panel_width * 2 * _ASIDE / (x[-1] - x[0])
    panels = new_axes(title, height, 1, len(T_world_camera), sharey=True)[0]
    page_camera = _page_camera(point_camera / distance)
    places = np.stack(np.meshgrid(x, np.arange(-_ASIDE, _ASIDE + _STEP, _STEP)), axis=-1)
    bar = {"ax": panels, "aspect": 25, "pad": 0.015}
    norm = None  # the first slice makes the colour scale and its bar; the others take the scale
    for axes, (name, T) in zip(panels, T_world_camera.items(), strict=True):
        grid_world = places @ page_camera.numpy() @ T[:3, :3].T + T[:3, 3]
        norm = draw_slice(axes, field, grid_world, places, norm=norm, **bar)
        _draw_camera(axes)
        if field.is_distance:
            _draw_queries(axes, field, T, points_camera, page_camera)
        else:
            _draw_samples(axes, field, T, point_camera)
        axes.set(xlim=x[[0, -1]], ylim=(-_ASIDE, _ASIDE), aspect="equal", title=name)
        axes.set(xlabel="along the ray (m)", ylabel="to its left (m)")
        axes.label_outer()
    return panels[0].figure.legend_below()


def _points_of_row(frame: Frame, row: int, column: int) -> tuple[Tensor, Tensor]:
    """The points (m, camera frame) of a row's measured pixels (n, 3), and of one of them (3,).

    This one is the measured pixel nearest to (row, column); the row is that of this pixel. Raises
    ConfigError if the frame has no depth.
    """
    pixels = frame.measured_pixels()
    if not pixels.numel():
        raise ConfigError("the frame has no depth: choose another one")
    away = (pixels - pixels.new_tensor([[row], [column]])).abs().sum(dim=0)
    row, column = pixels[:, away.argmin()]
    in_row = pixels[:, pixels[0] == row]
    points_camera, _ = frame.points(*in_row)
    return points_camera, points_camera[in_row[1] == column][0]


def _page_camera(along: Tensor) -> Tensor:
    """The page's axes in the camera frame (2, 3): the unit vector along a ray, and its left."""
    x_camera = along.new_tensor([1.0, 0, 0])
    left = along * along[0] - x_camera  # -x without its component along the ray
    return torch.stack([along, left / left.norm()])


def _draw_camera(axes: Axes) -> None:
    """Draw the camera at the page's origin, and its ray; axes may cut off the camera."""
    axes.axhline(0, color="0.2", linewidth=0.8)
    # White inside, since the slice may be dark here.
    axes.fill([0, 0.2, 0.2], [0, 0.12, -0.12], facecolor="white", edgecolor="black", linewidth=1.5)
    look = {"ha": "center", "va": "top", "path_effects": [_HALO], "clip_on": True}
    axes.text(0.1, -0.17, "camera", **look)


def _draw_samples(axes: Axes, field: LearnedField, T: Pose, point_camera: Tensor) -> None:
    """Draw iMAP's samples on the ray to a measured point (m), and the distance that they render.

    `T` is camera to world (m). Distances on the page are along the ray; they are no z-depths.
    """
    pose = torch.from_numpy(T).float()
    direction = point_camera[None] / point_camera[2]  # with z = 1 in the camera frame
    unused = pose.new_zeros(1, 3)  # in place of the measured colour and depth
    rays = Rays(pose[None, :3, 3], direction @ pose[:3, :3].T, unused, unused[:, 0])
    with torch.no_grad():
        rendered = field.render_hierarchically(rays, _N_STRATIFIED, _N_IMPORTANCE)
    distances = rendered.depths[0] * direction.norm().item()
    sizes = 12 + 400 * rendered.weights[0]  # areas in square points; all samples are visible
    label = f"{len(distances)} samples, by weight"
    axes.scatter(distances, 0 * distances, s=sizes, label=label, color=_COLORS["VR"], **_DOT)
    measured_m = point_camera.norm().item()
    rendered_m = rendered.depth.item() * direction.norm().item()
    axes.axvline(rendered_m, linestyle="--", color=_COLORS["VR"], label="rendered distance")
    axes.scatter(measured_m, 0, s=60, label="measured point", color=_COLORS["true"], **_DOT)
    axes.annotate("", (rendered_m, 0.1), (measured_m, 0.1), arrowprops={"arrowstyle": "<->"})
    error = f"error {100 * abs(rendered_m - measured_m):.0f} cm  "
    axes.text(min(measured_m, rendered_m), 0.1, error, ha="right", va="center")


def _draw_queries(
    axes: Axes, field: LearnedField, T: Pose, points_camera: Tensor, page_camera: Tensor
) -> None:
    """Draw measured points (m), and from each the step -d along the unit gradient of d.

    `T` is camera to world (m); the rows of `page_camera` are the page's axes (camera frame).
    """
    pose = torch.from_numpy(T).float()
    points_world = transform_points(pose, points_camera).requires_grad_()
    _, sdf = field(points_world)
    (gradient,) = torch.autograd.grad(sdf.sum(), points_world)
    # The last factor turns the steps from the world frame into the camera frame.
    ends_camera = points_camera - sdf.detach()[:, None] * normalize(gradient) @ pose[:3, :3]
    start = (points_camera @ page_camera.T).numpy()
    end = (ends_camera @ page_camera.T).numpy()
    axes.scatter(*start.T, s=20, label="measured points", color=_COLORS["true"], **_DOT)
    # An entry in the legend, which cannot show the arrows of `quiver`.
    arrow = {"marker": r"$\rightarrow$", "markersize": 18, "linestyle": "none"}
    axes.plot([], [], color=_COLORS["SDF"], label="−d along the gradient", **arrow)
    look = {"color": _COLORS["SDF"], "angles": "xy", "scale_units": "xy", "scale": 1, "zorder": 5}
    axes.quiver(*start.T, *(end - start).T, units="inches", width=0.022, **look)
