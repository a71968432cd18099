"""Which methods are rows of the tables, and which method the command line means."""

from nbtrack.fields import field_class
from nbtrack.machinery.errors import ConfigError
from nbtrack.tracking import TRACKERS, tracker_class
from nbtrack.tracking.methods import METHODS, Method, find_methods

DEFAULT_METHOD = "corrected"
"""The method of the command line if none is named: the most accurate one but for its dense form."""
TABLE_1 = ("vr", "sdf")
"""The rows of the paper's Table I."""
TABLE_3 = (
    "vr", "vr_velocity", "vr_neus", "sdf", "sdf_velocity", "sdf_plus", "sdf_corrected",
    "baked", "neus_corrected", "corrected_sparse", "corrected", "corrected_dense",
    "corrected_geometry", "icp", "icp_middle", "icp_dense",
)  # fmt: skip
"""The rows of Table III: the paper's methods beside those that go beyond it."""
RATES_3_HZ = (30.0, 10.0, 5.0, 2.0)
"""The rates of Table III: the paper's three, and the 30 Hz of the camera itself."""


def method_of(name: str | None, field: str | None, tracker: str | None) -> Method:
    """The method that a user means by a name, or by a field, a tracker or both.

    A name means a row of `METHODS`. A field alone is combined with the first tracker that works in
    it, in the order lm, icp, vr, all others. A tracker alone is combined with the field of the
    first row of `METHODS` that has this tracker, or with NeuS if none has it. Without any argument
    it is `DEFAULT_METHOD`.

    Raises ConfigError for a name together with a field or tracker, for an unknown name, for a
    tracker that does not work in the field, and for a field in which no tracker works.
    """
    if name and (field or tracker):
        raise ConfigError("--method names a field and a tracker: leave --field and --tracker out")
    if field is None and tracker is None:
        return find_methods([name or DEFAULT_METHOD])[0]
    if tracker is None:
        in_order = ("lm", "icp", "vr", *TRACKERS)
        fits = [other for other in in_order if tracker_class(other).works_in(field_class(field))]
        if not fits:
            raise ConfigError(f"no tracker works on field {field!r}: register one of your own")
        tracker = fits[0]
    if field is None:
        field = next((row.field for row in METHODS.values() if row.tracker == tracker), "neus")
    return find_methods([Method(f"{field_class(field).label} with {tracker}", field, tracker)])[0]
