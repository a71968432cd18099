"""Fields, trackers and methods beyond the paper, which are registered here as by a plug-in."""

from nbtrack.fields import FIELDS
from nbtrack.mapping.files import FORMS
from nbtrack.tracking import TRACKERS
from nbtrack.tracking.methods import METHODS, Method

FIELDS |= {
    "neus_plus": "nbtrack.beyond.neus_plus:NeuSPlusField",
    "grid_plus": "nbtrack.beyond.neus_plus:GridPlusField",
    "volsdf": "nbtrack.beyond.other_fields:VolSdfField",
    "occupancy": "nbtrack.beyond.other_fields:OccupancyField",
    "points": "nbtrack.beyond.points:PointCloud",
}
TRACKERS |= {"lm": "nbtrack.beyond.lm:LmTracker", "icp": "nbtrack.beyond.icp:IcpTracker"}
FORMS["corrected"] = "nbtrack.beyond.correction:CorrectedField"

_COLOR_ONLY = ("tracking.vr.lambda_depth=0",)
_NEUS_CORRECTED = ("correction.neus=0.04",)
# In the rooms for tuning 1400 iterations had 0.9 to 1.0 times the error (docs/tried.md).
_CORRECTED = ("correction.neus_plus=0.04", "mapping.neus_plus.iterations=600")
_SPARSE = (*_CORRECTED, "tracking.lm.n_pixels=512")
_MIDDLE = (*_CORRECTED, "tracking.lm.n_pixels=2048")
_DENSE = (*_CORRECTED, "tracking.lm.n_pixels=4096")
_SHAPE = (*_MIDDLE, "tracking.lm.lambda_intensity=0")
_GRID_CORRECTED = ("correction.grid_plus=0.04", "tracking.lm.n_pixels=2048")

METHODS |= {
    "vr_plus": Method("NeuS+ with VR", "neus_plus", "vr"),
    "vr_grid": Method("NeuS+ grid with VR", "grid_plus", "vr"),
    "vr_volsdf": Method("VolSDF with VR", "volsdf", "vr"),
    "sdf_volsdf": Method("VolSDF with SDF", "volsdf", "sdf"),
    "vr_occupancy": Method("Occupancy with VR", "occupancy", "vr"),
    "color_plus": Method("NeuS+ with VR, colour only", "neus_plus", "vr", _COLOR_ONLY),
    "color_volsdf": Method("VolSDF with VR, colour only", "volsdf", "vr", _COLOR_ONLY),
    "color_occupancy": Method("Occupancy with VR, colour only", "occupancy", "vr", _COLOR_ONLY),
    "sdf_plus": Method("NeuS+ with SDF (Adam)", "neus_plus", "sdf"),
    "sdf_grid": Method("NeuS+ grid with SDF", "grid_plus", "sdf"),
    "baked": Method("NeuS+ baked (LM)", "neus_plus", "lm"),
    "corrected": Method("NeuS+ corrected (LM)", "neus_plus", "lm", _MIDDLE),
    "corrected_sparse": Method("NeuS+ corrected (LM), sparse", "neus_plus", "lm", _SPARSE),
    "corrected_dense": Method("NeuS+ corrected (LM), dense", "neus_plus", "lm", _DENSE),
    "corrected_geometry": Method("NeuS+ corrected (LM), without colour", "neus_plus", "lm", _SHAPE),
    "grid_corrected": Method("NeuS+ grid corrected (LM)", "grid_plus", "lm", _GRID_CORRECTED),
    "neus_corrected": Method("NeuS corrected (LM)", "neus", "lm", _NEUS_CORRECTED),
    "sdf_corrected": Method("NeuS corrected with SDF (Adam)", "neus", "sdf", _NEUS_CORRECTED),
    "icp": Method("ICP", "points", "icp"),
    "icp_middle": Method("ICP, 2048", "points", "icp", ("tracking.icp.n_pixels=2048",)),
    "icp_dense": Method("ICP, dense", "points", "icp", ("tracking.icp.n_pixels=4096",)),
}
