"""Methods: a tracker in a field, with settings of its own. Each is a row of a table."""

from collections.abc import Sequence
from dataclasses import dataclass

from nbtrack.core.errors import ConfigError, look_up
from nbtrack.fields import field_class
from nbtrack.tracking import TRACKERS, check_pair, paper_steps, tracker_class


@dataclass(frozen=True)
class Method:
    """A row of Table I or III."""

    label: str
    field: str
    tracker: str
    settings: tuple[str, ...] = ()  # key=value, over the preset's and under the user's own

    def paper_steps(self, rate_hz: float | int) -> float:
        """Steps a frame on the paper's hardware: of VR for what renders, else of SDF."""
        return paper_steps("vr" if tracker_class(self.tracker).renders else "sdf", rate_hz)

    @property
    def usual_steps(self) -> float:
        """Steps a frame where nobody says how many: up to 30 of a tracker that ends by itself.

        The paper's trackers do not; they take the steps of its slowest rate, 2 Hz.
        """
        return 30 if tracker_class(self.tracker).converges else self.paper_steps(2)


Methods = Sequence[str | Method]
"""By name, or as they are."""

_COLOR_ONLY = ("tracking.vr.lambda_depth=0",)
_VR_VELOCITY = ("tracking.vr.motion_model=constant_velocity",)
_SDF_VELOCITY = ("tracking.sdf.motion_model=constant_velocity",)
_VR_METRES = ("tracking.vr.position_unit=metre",)
_SDF_METRES = ("tracking.sdf.position_unit=metre",)
_CORRECTED = ("mapping.neus.correct_voxel=0.04",)
# As good as from 1400 iterations, in half the time (benchmarks/README.md; rooms for tuning).
_PLUS = ("mapping.neus_plus.correct_voxel=0.04", "mapping.neus_plus.iterations=600")
_SPARSE, _MIDDLE, _DENSE = ((*_PLUS, f"tracking.lm.n_pixels={n}") for n in (512, 2048, 4096))
_GEOMETRY = (*_MIDDLE, "tracking.lm.lambda_intensity=0")
METHODS = {
    "vr": Method("iMAP with VR", "imap", "vr"),
    "sdf": Method("NeuS with SDF", "neus", "sdf"),
    "vr_velocity": Method("iMAP with VR, constant velocity", "imap", "vr", _VR_VELOCITY),
    "sdf_velocity": Method("NeuS with SDF, constant velocity", "neus", "sdf", _SDF_VELOCITY),
    "vr_metres": Method("iMAP with VR, rates in metres", "imap", "vr", _VR_METRES),
    "sdf_metres": Method("NeuS with SDF, rates in metres", "neus", "sdf", _SDF_METRES),
    "vr_neus": Method("NeuS with VR", "neus", "vr"),
    "vr_plus": Method("NeuS+ with VR", "neus_plus", "vr"),
    "vr_volsdf": Method("VolSDF with VR", "volsdf", "vr"),
    "sdf_volsdf": Method("VolSDF with SDF", "volsdf", "sdf"),
    "vr_occupancy": Method("Occupancy with VR", "occupancy", "vr"),
    "color": Method("iMAP with VR, colour only", "imap", "vr", _COLOR_ONLY),
    "color_neus": Method("NeuS with VR, colour only", "neus", "vr", _COLOR_ONLY),
    "color_plus": Method("NeuS+ with VR, colour only", "neus_plus", "vr", _COLOR_ONLY),
    "color_volsdf": Method("VolSDF with VR, colour only", "volsdf", "vr", _COLOR_ONLY),
    "color_occupancy": Method("Occupancy with VR, colour only", "occupancy", "vr", _COLOR_ONLY),
    "sdf_plus": Method("NeuS+ with SDF (Adam)", "neus_plus", "sdf"),
    "baked": Method("NeuS+ baked (LM)", "neus_plus", "lm"),
    "corrected": Method("NeuS+ corrected (LM)", "neus_plus", "lm", _MIDDLE),
    "corrected_sparse": Method("NeuS+ corrected (LM), sparse", "neus_plus", "lm", _SPARSE),
    "corrected_dense": Method("NeuS+ corrected (LM), dense", "neus_plus", "lm", _DENSE),
    "corrected_geometry": Method(
        "NeuS+ corrected (LM), without colour", "neus_plus", "lm", _GEOMETRY
    ),
    "neus_corrected": Method("NeuS corrected (LM)", "neus", "lm", _CORRECTED),
    "sdf_corrected": Method("NeuS corrected with SDF (Adam)", "neus", "sdf", _CORRECTED),
    "icp": Method("ICP", "points", "icp"),
    "icp_middle": Method("ICP, 2048", "points", "icp", ("tracking.icp.n_pixels=2048",)),
    "icp_dense": Method("ICP, dense", "points", "icp", ("tracking.icp.n_pixels=4096",)),
}
"""By name. A method of your own joins by `METHODS["mine"] = Method(...)`."""

DEFAULT_METHOD = "corrected"
"""What the command line takes where nothing is named: the most accurate, and fast."""
TABLE_1 = ("vr", "sdf")
"""The rows of the paper's Table I."""
TABLE_3 = (
    "vr", "vr_velocity", "vr_neus", "sdf", "sdf_velocity", "sdf_plus", "sdf_corrected",
    "baked", "neus_corrected", "corrected_sparse", "corrected", "corrected_dense",
    "corrected_geometry", "icp", "icp_middle", "icp_dense",
)  # fmt: skip
"""The paper's methods beside those that go beyond it."""
RATES_3_HZ = (30.0, 10.0, 5.0, 2.0)
"""The rates of Table III: the paper's, and that of the camera itself."""


def method_of(name: str | None, field: str | None, tracker: str | None) -> Method:
    """A row of `METHODS` by its name, or a free combination of a field and a tracker.

    A field alone takes the first of lm, icp and vr that works in it, a tracker alone the field of
    the first row with it; without anything it is `DEFAULT_METHOD`. Raises ConfigError for a name
    beside the others, and as `find_methods` does.
    """
    if name and (field or tracker):
        raise ConfigError("--method names a field and a tracker: leave --field and --tracker out")
    if field is None and tracker is None:
        return find_methods([name or DEFAULT_METHOD])[0]
    if tracker is None:
        tracker = next(t for t in ("lm", "icp", "vr") if TRACKERS[t].works_in(field_class(field)))
    if field is None:
        field = next((row.field for row in METHODS.values() if row.tracker == tracker), "neus")
    return find_methods([Method(f"{field_class(field).label} with {tracker}", field, tracker)])[0]


def find_methods(methods: Methods) -> list[Method]:
    """The methods of these names; a `Method` stands for itself.

    Raises ConfigError if a name is unknown, or its field and tracker do not go together.
    """
    chosen = []
    for method in dict.fromkeys(methods):
        chosen.append(look_up("method", method, METHODS) if isinstance(method, str) else method)
        check_pair(chosen[-1].tracker, chosen[-1].field)
    return chosen
