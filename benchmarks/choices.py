"""What the paper leaves open, one choice at a time (docs/choices.md); and searches."""

from dataclasses import replace

from variants import FALLING_STEPS

from nbtrack import METHODS, Method

VR, SDF = METHODS["vr"], METHODS["sdf"]


def _both(vr: Method | None = None, sdf: Method | None = None, raw: str = "") -> tuple:
    return vr or VR, sdf or SDF, raw


def _set(*settings: str) -> dict[str, Method]:
    """The two methods, each with those of the settings that concern it."""
    chosen = {
        method: tuple(s for s in settings if s.split(".")[1] in (method.field, method.tracker))
        for method in (VR, SDF)
    }
    return {m.tracker: replace(m, settings=chosen[m]) for m in (VR, SDF)}


FASTER = "learning rates times 4"
CHOICES = {
    "ours": _both(),
    "Adam kept from frame to frame": _both(
        replace(VR, tracker="vr_kept"), replace(SDF, tracker="sdf_kept")
    ),
    "the best iterate counts": _both(
        replace(VR, tracker="vr_best"), replace(SDF, tracker="sdf_best")
    ),
    "no colour": _both(**_set("tracking.vr.lambda_color=0.0", "tracking.sdf.lambda_color=0.0")),
    "raw depth in tracking": _both(raw="tracking"),
    FASTER: _both(
        **_set(
            "tracking.vr.position_rate=2e-3",
            "tracking.vr.orientation_rate=4e-3",
            "tracking.sdf.position_rate=2e-3",
            "tracking.sdf.orientation_rate=4e-3",
        )
    ),
    "first frequencies of 4 rad/m": _both(**_set("network.neus.embedding_sigma=4.0")),
    "eikonal term on all samples": _both(**_set("mapping.neus.eikonal_share=1.0")),
    "SiLU in both": _both(vr=replace(VR, field="imap_silu")),
    "raw depth throughout": _both(raw="both"),
    "first frequencies of 2.5 rad/m": _both(**_set("network.imap.embedding_sigma=2.5")),
    "three times the colour": _both(
        **_set("tracking.vr.lambda_color=15.0", "tracking.sdf.lambda_color=0.9")
    ),
}
"""One thing that the paper leaves open changed at a time: VR, SDF, and where raw depth is read."""


_FAST = "tracking.{0}.position_rate=1e-2", "tracking.{0}.orientation_rate=2e-2"


def _falling(name: str) -> Method:
    falling = f"{name}_falling"
    settings = tuple(setting.format(falling) for setting in _FAST)
    return replace(METHODS[name], tracker=falling, settings=settings)


SEARCHES = {
    METHODS["baked"]: (30, 100),
    METHODS["icp"]: (1, 100),
    _falling("sdf"): (FALLING_STEPS, 20),
    _falling("vr"): (FALLING_STEPS, 20),
}
"""With the steps of a search and how many starts: Adam's rates begin twenty times as high as the
paper's and fall to zero, so that its basin is not what 79 steps of half a millimetre can reach."""
