"""Figures of the paper's story: drawing only, from data already computed.

Every function returns a figure that a notebook shows once, with axes labelled in units, the
paper's method names, and a title that states the finding.
"""

from nbtrack.plots.ablations import plot_quality_over_time, plot_reach
from nbtrack.plots.beyond import plot_basin, plot_ingredients, plot_speed_accuracy
from nbtrack.plots.comparisons import plot_ate_bars, plot_steps
from nbtrack.plots.doll_house import mesh_viewer, plot_mesh
from nbtrack.plots.images import plot_room_overview, plot_views
from nbtrack.plots.slices import plot_slice
from nbtrack.plots.style import METHOD_COLORS, TRACKED_COLOR, TRUE_COLOR, method_colors
from nbtrack.plots.training import plot_deviation, plot_losses
from nbtrack.plots.trajectories import plot_errors, plot_trajectories

__all__ = [
    "METHOD_COLORS",
    "TRACKED_COLOR",
    "TRUE_COLOR",
    "mesh_viewer",
    "method_colors",
    "plot_ate_bars",
    "plot_basin",
    "plot_deviation",
    "plot_errors",
    "plot_ingredients",
    "plot_losses",
    "plot_mesh",
    "plot_quality_over_time",
    "plot_reach",
    "plot_room_overview",
    "plot_slice",
    "plot_speed_accuracy",
    "plot_steps",
    "plot_trajectories",
    "plot_views",
]
