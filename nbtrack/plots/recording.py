"""A recording at a glance: the cloud of its frames from above and from the side."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from nbtrack.data.scan import Cloud
from nbtrack.plots.style import TRUE_COLOR, camera_positions, new_figure, styled
from nbtrack.plots.top_view import TopView

_CUT = 0.01  # share of points cut off at either end of each axis: wild depths hide the room
_AXES = "xyz"


@styled
def plot_recording(
    cloud: Cloud, T_world_camera: Float[np.ndarray, "frames 4 4"], title: str
) -> Figure:
    """The coloured cloud and the camera's path: from above without the ceiling, and from the side.

    Walls should be thin and straight: doubled or fanned ones mean that something is read wrongly.

    Args:
        title: the finding, in a sentence.
    """
    figure = new_figure(title, 4.2, layout="compressed")
    up = -T_world_camera[:, :3, 1].mean(axis=0)  # cameras are mostly held upright
    view = TopView.along(tuple(up.tolist()))
    positions = camera_positions(T_world_camera)
    points, colors = cloud.points_world, cloud.colors / 255
    if len(points):
        low, high = np.quantile(points, [_CUT, 1 - _CUT], axis=0)
        inside = ((points >= low) & (points <= high)).all(axis=1)
        points, colors = points[inside], colors[inside]
    height = view.up_sign * points[:, view.vertical]
    top, side = figure.subplots(1, 2)
    # Drawn from the floor up, as one sees it; what is above the camera would cover the room.
    order = np.argsort(height)
    order = order[height[order] <= (view.up_sign * positions[:, view.vertical]).max() + 0.1]
    top.scatter(*view.on_page(points[order]).T, c=colors[order], s=1.5, linewidths=0)
    top.plot(*view.on_page(positions).T, color=TRUE_COLOR, linewidth=1)
    top.set_title("from above, without what is higher than the camera")
    view.finish(top)
    side.scatter(points[:, view.right], points[:, view.vertical], c=colors, s=1.5, linewidths=0)
    side.plot(positions[:, view.right], positions[:, view.vertical], color=TRUE_COLOR, linewidth=1)
    side.set_title("from the side; green: the camera")
    side.set(xlabel=f"{_AXES[view.right]} (m)", ylabel=f"{_AXES[view.vertical]} (m)")
    side.set_aspect("equal")
    if view.up_sign < 0:
        side.invert_yaxis()
    return figure
