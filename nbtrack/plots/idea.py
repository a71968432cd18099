"""What both trackers ask a map for: samples along a ray, or measured points."""

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
from nbtrack.plots.style import method_colors, new_axes, styled

_STEP = 0.01  # m, between the grid points of a slice
_BEFORE, _BEHIND, _ASIDE = 0.2, 0.45, 0.45  # m, drawn before the camera, behind the measured point
_N_STRATIFIED, _N_IMPORTANCE = 32, 12  # iMAP's samples along a ray
_DOT = {"edgecolors": "black", "linewidths": 0.5, "zorder": 4}
_HALO = withStroke(linewidth=3, foreground="white")
_COLORS = method_colors(["VR", "SDF", "true"])


@styled
def plot_idea(
    field: LearnedField, frame: Frame, T_world_camera: Pose, row: int, column: int, title: str = ""
) -> Figure:
    """What a tracker asks a map at the measured pixel of a frame that is nearest to (row, column).

    The slice lies in the plane of all rays of the pixel's row, from the camera at `T_world_camera`
    (m), an estimate that may be off; the pixel's ray runs to the right. In a map of a density it
    shows the samples of iMAP along this ray, the larger the more they weigh, and the distance that
    they render. In one of a signed distance d it shows the row's measured points, one query each,
    and from each a step of length |d| against the gradient.
    """
    axes = new_axes(title, 3.0)[0, 0]
    pixels = frame.measured_pixels()
    away = (pixels - torch.tensor([[row], [column]])).abs().sum(dim=0)
    in_row = pixels[:, pixels[0] == pixels[0, away.argmin()]]
    points_camera, _ = frame.points(*in_row)  # of the whole row
    point_camera = points_camera[(in_row[1] - column).abs().argmin()]
    distance = point_camera.norm().item()
    along = point_camera / distance
    x_camera = along.new_tensor([1.0, 0, 0])
    left = along * along[0] - x_camera  # minus x, without its part along the ray
    page_camera = torch.stack([along, left / left.norm()])  # the page's axes, (2, 3)
    x = np.arange(-_BEFORE, distance + _BEHIND, _STEP)
    places = np.stack(np.meshgrid(x, np.arange(-_ASIDE, _ASIDE + _STEP, _STEP)), axis=-1)
    grid_world = places @ page_camera.numpy() @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    draw_slice(axes, field, grid_world, places, aspect=25, pad=0.015)
    pose = torch.from_numpy(T_world_camera).float()
    axes.plot([0, distance + _BEHIND], [0, 0], color="0.2", linewidth=0.8)
    # With white, since the slice may be dark here.
    axes.fill([0, 0.2, 0.2], [0, 0.12, -0.12], facecolor="white", edgecolor="black", linewidth=1.5)
    axes.text(0.1, -0.17, "camera", ha="center", va="top", path_effects=[_HALO])
    if field.is_distance:
        _draw_queries(axes, field, pose, points_camera, page_camera)
    else:
        _draw_samples(axes, field, pose, point_camera)
    # Without points: it only names the surface, which `draw_slice` drew, in the legend.
    axes.plot([], [], "k-", label=f"surface of {field.label}")
    axes.set(xlim=(-_BEFORE, distance + _BEHIND), ylim=(-_ASIDE, _ASIDE), aspect="equal")
    axes.set(xlabel="along the ray (m)", ylabel="to its left (m)")
    return axes.figure.legend_below()


def _draw_samples(axes: Axes, field: LearnedField, pose: Tensor, point_camera: Tensor) -> None:
    """iMAP's samples on the ray to a measured point (m), and the distance that they render.

    `pose` is the camera's (camera to world, m). Distances on the page are along the ray, not z.
    """
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
    axes: Axes, field: LearnedField, pose: Tensor, points_camera: Tensor, page_camera: Tensor
) -> None:
    """Measured points (m) on the page, and from each a step of length |d| against the gradient.

    `pose` is the camera's (camera to world, m), and the rows of `page_camera` are the page's axes.
    """
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
    axes.quiver(*start.T, *(end - start).T, width=0.003, **look)
