"""Figures of both trackers' losses around a frame's true pose, and of the steps of trackers."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import torch
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nbtrack.core.arrays import Pose, Transform
from nbtrack.core.camera import pixel_directions
from nbtrack.core.geometry import transform_points
from nbtrack.data.frame import Frame
from nbtrack.fields import Field, LearnedField
from nbtrack.plots.meshes import query_field
from nbtrack.plots.style import DASHED, method_colors, new_axes, styled
from nbtrack.tracking import SdfTracker, StepBudget, Tracker, VrTracker

_SDF_LOSS, _VR_LOSS = "SDF's loss (no unit)", "VR's loss (no unit)"
_DISTANCE, _DENSITY = "mean |d| (cm)", "mean density (1/m)"
_OFFSETS_CM = np.arange(-20, 21, 2)
_COLORS = dict(zip((_SDF_LOSS, _VR_LOSS), method_colors(["SDF", "VR"]).values(), strict=True))


def move_sideways(frame: Frame, x_cm: float, y_deg: float) -> Transform:
    """The true camera-to-world pose (m), moved along the camera's x axis and turned about its y."""
    T_camera_moved = trimesh.transformations.rotation_matrix(np.radians(y_deg), [0, 1, 0])
    T_camera_moved[0, 3] = x_cm / 100
    return torch.from_numpy(frame.T_world_camera @ T_camera_moved).float()


@torch.no_grad()
def pose_losses(
    density: LearnedField, distance: Field, frame: Frame, y_deg: float = 0.0
) -> pd.DataFrame:
    """Losses of both trackers for a frame, over offsets of the camera from its true pose.

    The camera is moved along its x axis (the index, in cm) and turned about its y axis by `y_deg`.
    The columns are SDF's loss in the map `distance`, VR's loss in the map `density`, and the means
    of |d| and of the density at the measured points. Losses are those of trackers with default
    settings, for the same pixels at all poses and without randomness.
    """
    pixels = frame.measured_pixels()
    # At most 128 pixels, which give smooth curves and are fast enough for a slider.
    rows, columns = pixels[:, :: 1 + pixels.shape[1] // 128]
    directions_camera = pixel_directions(frame.camera, columns, rows)
    color, depth = frame.at(rows, columns)
    points_camera = directions_camera * depth[:, None]
    T_true, budget = frame.T_world_camera, StepBudget(1)  # to construct trackers; losses need none
    sdf, vr = SdfTracker(distance, T_true, budget), VrTracker(density, T_true, budget)
    vr.generator = None  # without a generator samples along rays are not random
    losses = []
    for x_cm in _OFFSETS_CM:
        T_world_camera = move_sideways(frame, x_cm, y_deg)
        sdf_loss = sdf.loss(T_world_camera, directions_camera, color, depth)
        vr_loss = vr.loss(T_world_camera, directions_camera, color, depth)
        points_world = transform_points(T_world_camera, points_camera)
        mean_cm = 100 * distance(points_world)[1].abs().mean().item()
        mean_density = density(points_world)[1].mean().item()
        losses.append([sdf_loss.item(), vr_loss.item(), mean_cm, mean_density])
    columns = [_SDF_LOSS, _VR_LOSS, _DISTANCE, _DENSITY]
    return pd.DataFrame(losses, pd.Index(_OFFSETS_CM, name="x_cm"), columns)


@styled
def plot_pose_losses(
    density: LearnedField, distance: Field, frame: Frame, y_deg: float = 0.0
) -> Figure:
    """Both losses of `pose_losses` along x.

    Each loss has two curves: with the camera turned by `y_deg`, and a pale one without a turn. For
    a slider: `interact(plot_pose_losses, density=fixed(...), ..., y_deg=(-10, 10))`.
    """
    straight = pose_losses(density, distance, frame)
    turned = pose_losses(density, distance, frame, y_deg)
    sdf_cm, vr_cm = turned[[_SDF_LOSS, _VR_LOSS]].idxmin()
    title = f"Turned by {y_deg:g}° about y, SDF's loss is lowest at {sdf_cm} cm, VR's at {vr_cm} cm"
    panels = new_axes(title.replace("-", "−"), 2.9, 1, 2)[0]  # minus signs for hyphens
    for axes, (name, color) in zip(panels, _COLORS.items(), strict=True):
        axes.plot(straight[name], color=color, alpha=0.4, label="not turned")
        axes.plot(turned[name], color=color, label=f"turned by {y_deg:g}°")
        axes.plot(turned[name].idxmin(), turned[name].min(), "v", color="0.3", label="lowest")
        axes.axvline(0, label="the true pose", **DASHED)
        axes.set(xlabel="camera off along x (cm)", ylabel=name, ylim=0)
        axes.legend(loc="upper left")
    return panels[0].figure


@styled
def plot_density(curves: pd.DataFrame, title: str = "") -> Figure:
    """The means of |d| and of the density of `pose_losses`, with a dot where each is best.

    A search would end where |d| is lowest, or where the density is highest.
    """
    panels = new_axes(title, 2.9, 1, 2)[0]
    sought = {_DISTANCE: "lowest", _DENSITY: "highest"}  # what a search looks for in each curve
    for axes, (name, extreme), color in zip(panels, sought.items(), _COLORS.values(), strict=True):
        best_cm = curves[name].idxmin() if extreme == "lowest" else curves[name].idxmax()
        label = f"{extreme}, at {best_cm} cm"
        axes.plot(curves[name], color=color)
        axes.plot(best_cm, curves[name][best_cm], "o", color="0.3", label=label)
        axes.axvline(0, label="the true pose", **DASHED)
        axes.set(xlabel="camera off along x (cm)", ylabel=name, ylim=0)
        axes.legend()
    return panels[0].figure


@styled
def plot_steps(trackers: Mapping[str, Tracker], frame: Frame, T_start: Pose) -> Figure:
    """The path of each tracker's steps in one frame, and its position error after each step.

    `trackers`, by label, share one map; each searches from `T_start` (m) until its budget is spent
    or it converges. The title says after how many steps each ends how far from the true position.
    Behind the paths is the mean |d| of at most 2000 measured points, with the camera moved along
    its true x and z axes and not turned. Trackers also turn.
    """
    paths_cm = {label: _path_cm(tracker, frame, T_start) for label, tracker in trackers.items()}
    errors_mm = {label: 10 * np.linalg.norm(path, axis=1) for label, path in paths_cm.items()}
    ends = (f"{k} ends {e[-1]:.0f} mm off after {len(e) - 1} steps" for k, e in errors_mm.items())
    plane, by_step = new_axes("; ".join(ends), 3.6, 1, 2, width_ratios=[1.2, 1])[0]
    first, *_ = trackers
    field = trackers[first].field
    _draw_mean_distance(plane, field, frame, np.concatenate([*paths_cm.values(), [[0, 0, 0]]]))
    for label, color in method_colors(paths_cm).items():
        look = {"color": color, "marker": ".", "markersize": 4, "label": label}
        plane.plot(paths_cm[label][:, 0], paths_cm[label][:, 2], **look)
        by_step.plot(errors_mm[label], **look)
    x_start, _, z_start = paths_cm[first][0]  # the start, which all share
    marks = {"color": "black", "linestyle": ""}
    plane.plot(x_start, z_start, "s", label="start", **marks)
    plane.plot(0, 0, "*", markersize=10, label="true pose", **marks)
    plane.set(xlabel="camera off along x (cm)", ylabel="off along z (cm)", aspect="equal")
    by_step.set(xlabel="step", ylim=0, ylabel="position error (mm)")
    plane.figure.get_layout_engine().set(wspace=0.1)
    return plane.figure.legend_below()


def _draw_mean_distance(axes: Axes, field: Field, frame: Frame, places_cm: np.ndarray) -> None:
    """Draw the mean |d| (cm) of a frame's points over offsets (cm) of the camera along x and z.

    Offsets from the true pose form a grid of 21 by 21, which reaches 1 cm beyond `places_cm` (n, 3;
    in the true camera's frame).
    """
    x, _, z = np.linspace(places_cm.min(axis=0) - 1, places_cm.max(axis=0) + 1, 21).T
    pixels = frame.measured_pixels()
    points_camera, _ = frame.points(*pixels[:, :: 1 + pixels.shape[1] // 2000])
    grid_cm = np.stack(np.meshgrid(x, 0, z, indexing="ij"), axis=-1)  # (21, 1, 21, 3): y is 0
    moved_camera = points_camera.numpy() + grid_cm[:, 0, :, None] / 100
    T_true = frame.T_world_camera
    _, sdf = query_field(field, moved_camera @ T_true[:3, :3].T + T_true[:3, 3])
    mean_cm = 100 * np.abs(sdf).mean(axis=-1)
    # Transposed, since rows of `contourf` belong to its y axis, here z.
    filled = axes.contourf(x, z, mean_cm.T, np.arange(0, mean_cm.max() + 0.25, 0.25), cmap="Greys")
    axes.figure.colorbar(filled, ax=axes, label="mean |d| (cm)")


def _path_cm(tracker: Tracker, frame: Frame, T_start: Pose) -> np.ndarray:
    """Positions at the start and after each step (steps + 1, 3; cm, in the true camera's frame)."""
    tracker.begin(frame.to(tracker.device), torch.from_numpy(T_start)[None])
    poses = [T_start]
    for _ in tracker.budget.frame():
        tracker.step()
        poses.append(tracker.T_world_camera.detach().cpu().double().numpy())
        if tracker.is_converged:
            break
    offsets = np.stack(poses)[:, :3, 3] - frame.T_world_camera[:3, 3]
    return 100 * offsets @ frame.T_world_camera[:3, :3]
