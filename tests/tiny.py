"""Settings so small that a whole grid is made in seconds; they show nothing but that it runs."""

TINY = (
    "scenes.n_frames=5", "scenes.width=32", "scenes.track_frames=:",
    "tables.rates_hz=[10,8]", "tables.budgets_ms=[20]",
    "mapping.imap.iterations=6", "mapping.imap.n_rays=8", "network.imap.width=16",
    "mapping.neus.iterations=6", "mapping.neus.n_rays=8", "network.neus.width=16",
    "mapping.neus_plus.iterations=6", "mapping.neus_plus.n_rays=8",
    "mapping.neus_plus.n_surface_points=16", "tracking.vr.n_pixels=8", "tracking.sdf.n_pixels=16",
    "tracking.lm.n_pixels=32", "tracking.lm.n_restarts=0",
    "tracking.vr.n_stratified=4", "tracking.icp.n_pixels=64",
    "network.imap.n_frequencies=8", "network.neus.n_frequencies=8",
    "tables.pixels.vr=[4]", "tables.pixels.sdf=[8]",
)  # fmt: skip


def tiny_words(*more: str) -> list[str]:
    """They, and more of them, for the command line."""
    return [word for setting in (*TINY, *more) for word in ("--set", setting)]
