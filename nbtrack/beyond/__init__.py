"""What goes beyond the paper: fields, trackers and methods that join as a plug-in does."""

import nbtrack.beyond.methods  # joins the registry
from nbtrack.fields import FIELDS
from nbtrack.mapping.files import FORMS
from nbtrack.tracking import TRACKERS

FIELDS |= {
    "neus_plus": "nbtrack.beyond.neus_plus:NeuSPlusField",
    "grid_plus": "nbtrack.beyond.feature_grid:GridPlusField",
    "volsdf": "nbtrack.beyond.other_fields:VolSdfField",
    "occupancy": "nbtrack.beyond.other_fields:OccupancyField",
    "points": "nbtrack.beyond.points:PointCloud",
}
TRACKERS |= {"lm": "nbtrack.beyond.lm:LmTracker", "icp": "nbtrack.beyond.icp:IcpTracker"}
FORMS["corrected"] = "nbtrack.beyond.correction:CorrectedField"
