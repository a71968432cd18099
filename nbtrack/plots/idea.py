"""The idea of the paper in one picture: many queries along a ray against one at its end."""

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from nbtrack.core.arrays import Pose
from nbtrack.core.camera import pixel_directions
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import Rays
from nbtrack.fields import Field, LearnedField
from nbtrack.plots.scene import draw_slice
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
    point_camera = frame.points(torch.tensor([row]), torch.tensor([column]))[0]
    x, _, z = point_camera[0].tolist()
    pose = torch.from_numpy(T_world_camera).float()
    for axes, field in ((left, density), (right, distance)):
        _draw_row(axes, field, frame, T_world_camera, row)
        axes.plot([0, x], [0, z], color="0.2", linewidth=0.8)
    _draw_samples(left, density, pose, point_camera / z)
    _draw_query(right, distance, pose, point_camera)
    for axes in (left, right):
        axes.legend(loc="upper left", frameon=True)
    return left.figure


def _draw_row(axes: Axes, field: Field, frame: Frame, T_world_camera: Pose, row: int) -> None:
    """A field's values on the plane of a row of pixels, the camera, and what the row measured."""
    columns = torch.arange(frame.camera.width)
    points, _ = frame.points(torch.full_like(columns, row), columns)
    sides = pixel_directions(frame.camera, columns[[0, -1]], torch.full((2,), row)).numpy()
    far = 1.15 * points[:, 2].max().item()
    across = np.arange(far * sides[0, 0], far * sides[1, 0], _STEP)
    x, z = np.meshgrid(across, np.arange(0.0, far, _STEP))
    grid = np.stack([x, z * sides[0, 1], z], axis=-1)
    grid_world = grid @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    draw_slice(axes, field, grid_world, grid[..., [0, 2]], location="bottom", aspect=30)
    axes.plot(points[:, 0], points[:, 2], ".", color="#009e73", markersize=3)
    axes.plot(0, 0, "k^", markersize=9)
    axes.set_ylim(bottom=-0.2)
    axes.set(xlabel="to the right of the camera (m)", ylabel="ahead (m)", aspect="equal")
    axes.set_title(field.label)


def _draw_samples(axes: Axes, field: LearnedField, pose: Tensor, ray: Tensor) -> None:
    """The samples of a ray (1 x 3, camera frame, z = 1), by their weights."""
    unknown = torch.zeros(1, 3)
    rays = Rays(pose[None, :3, 3], ray @ pose[:3, :3].T, unknown, unknown[:, 0])
    depths = field.hierarchical_depths(rays, _N_STRATIFIED, _N_IMPORTANCE)
    sizes = 8 + 400 * field.render(rays, depths).weights[0].detach()
    label = f"{len(sizes)} samples, by weight"
    x, z = depths[0] * ray[0, 0], depths[0]
    axes.scatter(x, z, s=sizes, label=label, color="#3b6fb6", **_DOT)


def _draw_query(axes: Axes, field: Field, pose: Tensor, point_camera: Tensor) -> None:
    """The measured point (1 x 3, m), its distance, and the way against its gradient."""
    point_world = transform_points(pose, point_camera).requires_grad_()
    d = field(point_world)[1]
    (gradient,) = torch.autograd.grad(d.sum(), point_world)
    foot = point_camera - d.detach() * (gradient @ pose[:3, :3])
    start, end = (point[0, [0, 2]].tolist() for point in (point_camera, foot))
    arrow = {"arrowstyle": "-|>", "linewidth": 2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrow, zorder=5)
    label = f"one query: d = {100 * d.item():.0f} cm"
    axes.scatter(*start, s=25, label=label, color="#e08214", **_DOT)
