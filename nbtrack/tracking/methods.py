"""Methods, which are trackers in fields with certain settings, and the registry of their names."""

from collections.abc import Sequence
from dataclasses import dataclass

from nbtrack.fields import field_class
from nbtrack.machinery.errors import ConfigError, check_argument, look_up, typed
from nbtrack.machinery.registry import Registry
from nbtrack.tracking import paper_steps, tracker_class


@typed
@dataclass(frozen=True)
class Method:
    """A field and a tracker, by their names, and settings of both: a row of Table I or III."""

    label: str
    field: str
    tracker: str
    # `key=value` texts: they replace settings of the preset, and the user's settings replace them.
    settings: tuple[str, ...] = ()

    def paper_steps(self, rate_hz: float | int) -> float:
        """The steps per frame that this method gets at a rate (Hz).

        They are VR's on the paper's hardware for a tracker that renders, and SDF's for any other.
        """
        return paper_steps("vr" if tracker_class(self.tracker).renders else "sdf", rate_hz)

    @property
    def usual_steps(self) -> float:
        """The default number of steps per frame.

        It is 30 for trackers that end a frame when they have converged. All others, such as the
        paper's, take the steps of the paper's slowest rate, 2 Hz.
        """
        return 30 if tracker_class(self.tracker).converges else self.paper_steps(rate_hz=2)


Methods = Sequence[str | Method]
"""Methods, or their names."""

_COLOR_ONLY = ("tracking.vr.lambda_depth=0",)
_VR_VELOCITY = ("tracking.vr.motion_model=constant_velocity",)
_SDF_VELOCITY = ("tracking.sdf.motion_model=constant_velocity",)
_VR_METRES = ("tracking.vr.position_unit=metre",)
_SDF_METRES = ("tracking.sdf.position_unit=metre",)
_OF_PAPER: dict[str, Method | str] = {
    "vr": Method("iMAP with VR", "imap", "vr"),
    "sdf": Method("NeuS with SDF", "neus", "sdf"),
    "vr_velocity": Method("iMAP with VR, constant velocity", "imap", "vr", _VR_VELOCITY),
    "sdf_velocity": Method("NeuS with SDF, constant velocity", "neus", "sdf", _SDF_VELOCITY),
    "vr_metres": Method("iMAP with VR, rates in metres", "imap", "vr", _VR_METRES),
    "sdf_metres": Method("NeuS with SDF, rates in metres", "neus", "sdf", _SDF_METRES),
    "vr_neus": Method("NeuS with VR", "neus", "vr"),
    "color": Method("iMAP with VR, colour only", "imap", "vr", _COLOR_ONLY),
    "color_neus": Method("NeuS with VR, colour only", "neus", "vr", _COLOR_ONLY),
}
METHODS: Registry[Method] = Registry(_OF_PAPER)
"""The paper's methods and variants of them, by name; `beyond` adds its methods as a plug-in does.
`METHODS["mine"] = Method(...)` adds your own."""


@typed
def find_methods(methods: Methods) -> list[Method]:
    """The methods of a list of names and `Method` objects, in order. Repetitions are left out.

    Raises ConfigError if `methods` is no list, if an entry is neither a known name nor a `Method`,
    if a method's tracker does not work in its field, or if two have one label.
    """
    found = [look_up("method", m, METHODS) if isinstance(m, str) else m for m in methods]
    # Checked here, since what users register in METHODS is not checked when they register it.
    check_argument("methods", found, Sequence[Method])
    by_label = {method.label: method for method in found}
    for method in found:
        if method != by_label[method.label]:
            raise ConfigError(f"two methods have the label {method.label!r}: give one another")
        tracker_class(method.tracker).check_field(field_class(method.field))
    return list(by_label.values())
