"""Figures. They only draw data that are already computed.

Every function returns a figure that a notebook shows once, with axes labelled in units, the
paper's method names, and a title that states the finding.
"""

from nbtrack.plots.figures import (
    plot_along_ray,
    plot_columns,
    plot_curves,
    plot_distances,
    plot_errors,
    plot_frame,
    plot_images,
    plot_intervals,
    plot_panels,
)
from nbtrack.plots.movie import cloud_of, movie_bytes, movie_pictures
from nbtrack.plots.pose_losses import plot_steps
from nbtrack.plots.rooms import plot_map_and_slice, plot_mesh, plot_overview, plot_slice
