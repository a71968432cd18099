"""A summary of the experiment nine_rooms for both methods, which `evidence.py` writes."""

import numpy as np
import pandas as pd
from scipy.stats import binomtest, bootstrap

from nbtrack import METHODS
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

VR, SDF = METHODS["vr"], METHODS["sdf"]


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """Summarise the rows: a row for each path and rate, with intervals of 95 %.

    - `vr_over_sdf` is the geometric mean of VR's error divided by SDF's, paired by room and seed.
      A room counts once, with the mean logarithm of its seeds. The interval is a bootstrap over
      rooms.
    - The numbers of lost sequences (ATE above 0.2 m) have Wilson's interval of their share, which
      takes the seeds of a room as independent.
    """
    summaries = []
    for (path, rate_hz), cells in rows.groupby(["path", "rate_hz"]):
        ate_m = cells.pivot(index=["scene", "seed"], columns="method", values="ate_m")
        ratio = np.log(ate_m[VR.label] / ate_m[SDF.label]).groupby("scene").mean()
        interval = bootstrap((ratio,), np.mean, rng=0).confidence_interval
        mean, low, high = np.exp([ratio.mean(), *interval])
        row = {"path": path, "rate_hz": rate_hz, "rooms": len(ratio), "sequences": len(ate_m)}
        row |= {"vr_over_sdf": mean, "from": low, "to": high, "vr_ahead": (ratio < 0).sum()}
        for method in (VR, SDF):
            of_method = cells[cells["method"] == method.label]
            motion_m = of_method["path_m"] / of_method["frames"]
            row[f"{method.tracker}_reach_over_motion"] = (of_method["reach_m"] / motion_m).mean()
            n_lost = int((ate_m[method.label] > LOST_THRESHOLD_M).sum())
            share = binomtest(n_lost, len(ate_m)).proportion_ci(method="wilson")
            name = f"{method.tracker}_lost"
            row |= {name: n_lost, f"{name}_from": share.low, f"{name}_to": share.high}
        summaries.append(row)
    return pd.DataFrame(summaries)
