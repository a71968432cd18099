"""What goes beyond the paper: fields, trackers and methods that join as a user's own file does."""

import nbtrack.beyond.methods  # joins the registry
from nbtrack.beyond.correction import CorrectedField, correct_map
from nbtrack.beyond.feature_grid import GridPlusField
from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.icp import IcpSettings, IcpTracker
from nbtrack.beyond.lm import LmSettings, LmTracker
from nbtrack.beyond.neus_plus import NeuSPlusField, NeusPlusMapping
from nbtrack.beyond.other_fields import OccupancyField, VolSdfField
from nbtrack.beyond.points import PointCloud, PointMapping
from nbtrack.fields import FIELDS
from nbtrack.mapping.files import FORMS
from nbtrack.tracking import TRACKERS

for kind in (NeuSPlusField, GridPlusField, VolSdfField, OccupancyField, PointCloud):
    FIELDS[kind.name] = kind
for tracker in (LmTracker, IcpTracker):
    TRACKERS[tracker.name] = tracker
FORMS["corrected"] = CorrectedField
