"""The paper's claims, each judged by the run at hand."""

from collections.abc import Mapping, Sequence

import pandas as pd

from nbtrack.core.config import Preset
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

VR, SDF = "iMAP with VR", "NeuS with SDF"


def paper_claims(
    cells_1: pd.DataFrame, cells_2: pd.DataFrame, iteration_ratio: float
) -> pd.DataFrame:
    """One row a claim: what the paper says, what this run measured, and the verdict.

    The verdict is "supported" or "not supported", or "undecided" where nothing failed at all, so
    that failures cannot be compared.

    Args:
        cells_1, cells_2: long form of both tables, see `nbtrack.tables.layout`.
        iteration_ratio: seconds of a NeuS mapping iteration over those of an iMAP one, for
            equally many samples.

    Source: paper, abstract, results and conclusion.
    """
    fast = cells_1[cells_1["rate_hz"] > 2]
    fails = fast.groupby("method")["ate_m"].agg(lambda ate_m: (ate_m > LOST_THRESHOLD_M).sum())
    vr_fails, sdf_fails = int(fails[VR]), int(fails[SDF])
    slow = cells_1[cells_1["rate_hz"] == 2].pivot(index="scene", columns="method", values="ate_m")
    vr_wins = int((slow[VR] < slow[SDF]).sum())
    vr_steps, sdf_steps = _mean_steps(cells_2, "VR"), _mean_steps(cells_2, "SDF")
    rows = [
        (
            "SDF tracking fails less often at 10 and 5 Hz",
            "VR 9 of 18 cells above 0.2 m, SDF 2",
            f"VR {vr_fails}, SDF {sdf_fails} of {len(fast) // 2} cells above 0.2 m",
            None if vr_fails == sdf_fails == 0 else sdf_fails < vr_fails,
        ),
        (
            "VR is more accurate at 2 Hz",
            "VR better in 6 of 9 scenes",
            f"VR better in {vr_wins} of {len(slow)} scenes",
            vr_wins > len(slow) / 2,
        ),
        (
            "SDF takes more steps within a budget, with more pixels each",
            "VR 36.1 (n = 512), SDF 79.3 (n = 4096) in 500 ms",
            f"VR {vr_steps:.1f}, SDF {sdf_steps:.1f} in 500 ms at the n of Table I",
            sdf_steps > vr_steps,
        ),
        (
            "NeuS trains about half as fast as iMAP",
            "roughly a factor of two",
            f"a factor of {iteration_ratio:.1f} for equally many samples",
            1.5 < iteration_ratio < 3,
        ),
    ]
    words = {True: "supported", False: "not supported", None: "undecided"}
    judged = [(*row[:3], words[row[3]]) for row in rows]
    return pd.DataFrame(judged, columns=["claim", "paper", "here", "verdict"])


def in_words(claims: pd.DataFrame) -> str:
    """One sentence a claim and its verdict, with the paper's numbers and this run's."""
    return "\n".join(
        f"{row.verdict.upper()}: {row.claim}.\n    paper: {row.paper}\n    here:  {row.here}"
        for row in claims.itertuples()
    )


def iteration_ratio(
    preset: Preset,
    seconds: Mapping[str, Sequence[float]],
    fields: tuple[str, str] = ("neus", "imap"),
) -> float:
    """Mapping seconds an iteration and sample of one field over those of another.

    Args:
        seconds: by field name, the mapping seconds of all its maps.
        fields: numerator and denominator.
    """
    costs = []
    for name in fields:
        config = preset.mapping_of(name)
        samples = config.iterations * config.n_rays * (config.n_stratified + config.n_surface)
        costs.append(sum(seconds[name]) / len(seconds[name]) / samples)
    return costs[0] / costs[1]


def _mean_steps(cells_2: pd.DataFrame, tracker: str) -> float:
    """Steps within the longest budget at the middle pixel count, the n of Table I."""
    rows = cells_2[cells_2["tracker"] == tracker]
    rows = rows[rows["budget_ms"] == rows["budget_ms"].max()].sort_values("n_pixels")
    return float(rows["steps"].iloc[len(rows) // 2])
