"""The idea of the paper in one picture: many queries along a ray against one at its end."""

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from nbtrack.core.arrays import Pose
from nbtrack.core.camera import pixel_directions
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import Rays
from nbtrack.fields import Field, LearnedField
from nbtrack.plots.meshes import query_field
from nbtrack.plots.style import new_axes, styled

_STEP = 0.02  # m, between the grid points of a slice
_N_STRATIFIED, _N_IMPORTANCE = 32, 12  # samples a ray (iMAP)
_DOT = {"edgecolors": "black", "linewidths": 0.5, "zorder": 4}


@styled
def plot_idea(
    density: LearnedField,
    distance: Field,
    frame: Frame,
    T_world_camera: Pose,
    row: int,
    column: int,
    title: str = "",
) -> Figure:
    """What VR and SDF tracking ask a map for one pixel (row, column) of a frame.

    Both panels show the plane in which all rays of the pixel's row lie, from the camera at
    `T_world_camera` (m), an estimate that may be off. Left, in a map of a density: the 44 samples
    of iMAP along the ray; the larger a dot, the larger its weight. Right, in a map of a signed
    distance: the measured point, its distance d, and the way of length d against the gradient.
    """
    left, right = new_axes(title, 4.3, 1, 2, sharex=True, sharey=True)[0]
    ray = pixel_directions(frame.camera, torch.tensor([column]), torch.tensor([row]))
    for axes, field in ((left, density), (right, distance)):
        _draw_row(axes, field, frame, T_world_camera, row)
    pose = torch.from_numpy(T_world_camera).float()
    unknown = torch.zeros(1, 3)
    rays = Rays(pose[None, :3, 3], ray @ pose[:3, :3].T, unknown, unknown[:, 0])
    depths = density.hierarchical_depths(rays, _N_STRATIFIED, _N_IMPORTANCE)
    weights = density.render(rays, depths).weights[0].detach()
    x, z = depths[0] * ray[0, 0], depths[0]
    left.scatter(
        x, z, s=8 + 400 * weights, label=f"{len(z)} samples, by weight", color="#3b6fb6", **_DOT
    )
    point_camera = _draw_query(right, distance, frame, T_world_camera, row, column)
    x, z = point_camera[0], point_camera[2]
    for axes in (left, right):
        axes.plot([0, x], [0, z], color="0.2", linewidth=0.8)
        axes.legend(loc="upper left", frameon=True)
    return left.figure


def _draw_row(axes: Axes, field: Field, frame: Frame, T_world_camera: Pose, row: int) -> None:
    """A field's values on the plane of a row of pixels, the camera, and what the row measured."""
    columns = torch.arange(frame.camera.width)
    points, _ = frame.points(torch.full_like(columns, row), columns)
    sides = pixel_directions(frame.camera, columns[[0, -1]], torch.full((2,), row)).numpy()
    far = 1.15 * points[:, 2].max().item()
    z = np.arange(0.0, far, _STEP)
    x = np.arange(far * sides[0, 0], far * sides[1, 0], _STEP)
    x, z = np.meshgrid(x, z)
    grid = np.stack([x, z * sides[0, 1], z], axis=-1).reshape(-1, 3)
    grid = grid @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    values = query_field(field, grid)[1].reshape(x.shape)
    norm, colors = Normalize(-0.6, 0.6), "RdBu"
    if not field.is_distance:
        level = field.surface_level
        norm, colors = LogNorm(level / 200, 50 * level, clip=True), "YlOrBr"
    image = axes.pcolormesh(x, z, values, norm=norm, cmap=colors, rasterized=True)
    axes.contour(x, z, values, [field.surface_level], colors="black", linewidths=1.2)
    axes.figure.colorbar(image, ax=axes, label=field.value_label, location="bottom", aspect=30)
    axes.plot(points[:, 0], points[:, 2], ".", color="#009e73", markersize=3)
    axes.plot(0, 0, "k^", markersize=9)
    axes.set_ylim(bottom=-0.2)
    axes.set(xlabel="to the right of the camera (m)", ylabel="ahead (m)", aspect="equal")
    axes.set_title(f"{field.label}")


def _draw_query(
    axes: Axes, field: Field, frame: Frame, T_world_camera: Pose, row: int, column: int
) -> list[float]:
    """The measured point, its distance and the arrow; returns the point (m, camera frame)."""
    pose = torch.from_numpy(T_world_camera).float()
    point_camera = frame.points(torch.tensor([row]), torch.tensor([column]))[0][0]
    point_world = (pose[:3, :3] @ point_camera + pose[:3, 3])[None].requires_grad_()
    d = field(point_world)[1]
    (gradient,) = torch.autograd.grad(d.sum(), point_world)
    foot = point_camera - d.detach() * (pose[:3, :3].T @ gradient[0])
    start, end = (point[[0, 2]].tolist() for point in (point_camera, foot))
    arrow = {"arrowstyle": "-|>", "linewidth": 2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow, zorder=5)
    label = f"one query: d = {100 * d.item():.0f} cm"
    axes.scatter(*start, s=25, label=label, color="#e08214", **_DOT)
    return point_camera.tolist()
