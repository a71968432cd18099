"""NeuS with VR: the paper's open question, whether a map made by rendering favours rendering."""

from nbtrack.tracking.trackers.base import register_tracker
from nbtrack.tracking.trackers.vr import VolumeRenderingTracker


@register_tracker
class NeuSVolumeRenderingTracker(VolumeRenderingTracker):
    """The paper's VR tracker, unchanged, in the map that its SDF tracker uses.

    The paper supposes that VR is more accurate at 2 Hz because its map was trained by rendering
    too. NeuS is trained by rendering as well, so in one and the same map only the way of tracking
    differs. Source: paper, Sec. III (hypothesis on Table I); the experiment is ours.
    """

    name = "vr_neus"
    label = "NeuS with VR"
    short_label = "VR on NeuS"
    field_name = "neus"
    table_order = 2
    in_paper_tables = False
