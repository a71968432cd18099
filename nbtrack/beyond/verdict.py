"""How likely a pose is wrong, by what a descent says of it: logistic regression.

Source: `benchmarks/verdict.py` fits the coefficients, in the two rooms for tuning and on a real
recording, to poses that are off by more than 5 cm or 3 degrees.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

_LEAST_SHARE = 0.01  # of points; shares of none and of all would be infinitely telling
_INTERCEPT = 3.45
_COEFFICIENTS = np.array([-1.62, -1.2, 1.88, 0.18, 0.07, 0.58])


def features(said: Mapping[str, float]) -> Float[np.ndarray, "6"]:
    """Numbers that grow about linearly with the log odds of a wrong pose.

    Of what a tracker says: `fitting_ratio`, `known_ratio` (see `Descent.certainty`),
    `intensity_ratio` (median difference over the usual one), `position_std_m`, `last_step` (rad or
    m; 0 if settled) and `surprise` (how far from where the frame before led to, rad or m).
    """
    fitting, known = (
        np.clip(said[name], _LEAST_SHARE, 1 - _LEAST_SHARE)
        for name in ("fitting_ratio", "known_ratio")
    )
    return np.array([
        np.log(fitting / (1 - fitting)),
        np.log(known / (1 - known)),
        np.log(np.clip(said["intensity_ratio"], 0.5, 10)),
        np.log(np.clip(said["position_std_m"], 1e-4, 0.1) / 1e-3),
        np.log(1 + min(said["last_step"], 0.05) / 1e-3),
        np.log(np.clip(said["surprise"], 0.02, 1)),
    ])  # fmt: skip


def p_lost(said: Mapping[str, float]) -> float:
    """The probability that the pose is wrong."""
    return float(1 / (1 + np.exp(-(_INTERCEPT + _COEFFICIENTS @ features(said)))))
