"""Both trackers' losses of one frame around its true pose, to look at and to play with."""

import numpy as np
import pandas as pd
import torch
import trimesh
from matplotlib.figure import Figure

from nbtrack.core.arrays import Transform
from nbtrack.core.camera import pixel_directions
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import Rays
from nbtrack.fields import Field, LearnedField
from nbtrack.fields.base import rendered_losses
from nbtrack.plots.style import DASHED, method_colors, new_axes, styled
from nbtrack.tracking.paper import sdf_loss

_OFFSETS_CM = np.arange(-20, 21, 2)
_N_PIXELS = 128  # enough for smooth curves, and fast enough for a slider


def move_sideways(frame: Frame, x_cm: float, y_deg: float) -> Transform:
    """The true camera-to-world pose (m), moved along the camera's x and turned about its y."""
    T_camera_moved = trimesh.transformations.rotation_matrix(np.radians(y_deg), [0, 1, 0])
    T_camera_moved[0, 3] = x_cm / 100
    return torch.from_numpy(frame.T_world_camera @ T_camera_moved).float()


@torch.no_grad()
def pose_losses(
    density: LearnedField, distance: Field, frame: Frame, y_deg: float = 0.0
) -> pd.DataFrame:
    """Losses of the same pixels by the camera's offset along its x (cm), turned about its y.

    SDF's is Eq. 2 in a map of a signed distance, VR's is iMAP's in one of a density, with nothing
    random. The third column is the mean density at the observed points.
    """
    measured = frame.measured_pixels()
    rows, columns = measured[:, :: 1 + measured.shape[1] // _N_PIXELS]
    directions_camera = pixel_directions(frame.camera, columns, rows)
    color, depth = frame.at(rows, columns)
    losses = []
    for x_cm in _OFFSETS_CM:
        T_world_camera = move_sideways(frame, x_cm, y_deg)
        points = transform_points(T_world_camera, directions_camera * depth[:, None])
        field_color, sdf = distance(points)
        directions = directions_camera @ T_world_camera[:3, :3].T
        rays = Rays(T_world_camera[:3, 3].expand_as(directions), directions, color, depth)
        rendered = density.render_hierarchically(rays, 32, 12)
        terms = rendered_losses(rendered, rays, 5.0, 1.0, over_std=True)
        of_sdf = sdf_loss(sdf, field_color, color, 1.0, 0.3)
        of_pose = of_sdf, sum(terms.values()), density(points)[1].mean()
        losses.append([value.item() for value in of_pose])
    names = ["SDF's loss (no unit)", "VR's loss (no unit)", "mean density (1/m)"]
    return pd.DataFrame(losses, pd.Index(_OFFSETS_CM, name="x_cm"), names)


@styled
def plot_pose_losses(
    density: LearnedField, distance: Field, frame: Frame, x_cm: float = 0.0, y_deg: float = 0.0
) -> Figure:
    """Where the losses of `pose_losses` are at a moved pose (dot), and their curves along x.

    Curves have the colour of the map's method, pale without a turn; the dashed line is the true
    pose. With sliders: `interact(plot_pose_losses, density=fixed(...), ..., x_cm=(-20, 20))`.
    """
    straight = pose_losses(density, distance, frame)
    turned = pose_losses(density, distance, frame, y_deg)
    title = f"The camera {x_cm:g} cm along its x and turned by {y_deg:g}° about its y"
    panels = new_axes(title, 2.9, 1, 3)[0]
    colors = method_colors(["NeuS", "iMAP"])
    for axes, name, method in zip(panels, turned, ["NeuS", "iMAP", "iMAP"], strict=True):
        axes.plot(straight[name], color=colors[method], alpha=0.4, label="not turned")
        axes.plot(turned[name], color=colors[method], label=f"turned by {y_deg:g}°")
        pose = np.interp(x_cm, turned.index, turned[name])
        axes.plot(x_cm, pose, "o", color="0.3", label="this pose")
        axes.axvline(0, label="the true pose", **DASHED)
        axes.set(xlabel="camera off along x (cm)", ylabel=name)
    figure = axes.figure.legend_below()
    for line in figure.legends[0].get_lines():  # of any method
        line.set_color("0.3")
    return figure
