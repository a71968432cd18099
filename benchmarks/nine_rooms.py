"""What the rows of the experiment nine_rooms say of both methods, for `evidence.py`."""

import numpy as np
import pandas as pd
from scipy.stats import binomtest, bootstrap

from nbtrack import METHODS
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

VR, SDF = METHODS["vr"], METHODS["sdf"]


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """Reach, accuracy and sequences lost: a row a path and rate, intervals of 95 %.

    VR's error over SDF's is paired by room and seed; a room counts once, with the mean of its
    seeds' logarithms, and rooms are drawn anew (bootstrap). Shares of sequences lost (ATE above
    0.2 m) have Wilson's interval, as if the seeds of a room were independent.
    """
    judged = []
    for (path, rate_hz), cells in rows.groupby(["path", "rate_hz"]):
        ate_m = cells.pivot(index=["scene", "seed"], columns="method", values="ate_m")
        ratio = np.log(ate_m[VR.label] / ate_m[SDF.label]).groupby("scene").mean()
        means_span = bootstrap((ratio,), np.mean, rng=0).confidence_interval
        mean, low, high = np.exp([ratio.mean(), *means_span])
        row = {"path": path, "rate_hz": rate_hz, "rooms": len(ratio), "sequences": len(ate_m)}
        row |= {"vr_over_sdf": mean, "from": low, "to": high, "vr_ahead": (ratio < 0).sum()}
        for method in (VR, SDF):
            own = cells[cells["method"] == method.label]
            motion_m = own["path_m"] / own["frames"]
            row[f"{method.tracker}_reach_over_motion"] = (own["reach_m"] / motion_m).mean()
            lost = binomtest(int((ate_m[method.label] > LOST_THRESHOLD_M).sum()), len(ate_m))
            span = lost.proportion_ci(method="wilson")
            name = f"{method.tracker}_lost"
            row |= {name: lost.k, f"{name}_from": span.low, f"{name}_to": span.high}
        judged.append(row)
    return pd.DataFrame(judged)
