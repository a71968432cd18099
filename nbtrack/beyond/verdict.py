"""How likely a pose is wrong, by what a descent says of it.

Off by more than 5 cm or 3 degrees it may be for two reasons. It may be another pose altogether:
logistic regression, whose coefficients `benchmarks/verdict.py` fits, in the two rooms for tuning
and on a real recording. Or it is near the right one, but nothing holds it along some direction, or
the budget ended while it still moved: that error is taken to be normal, with the standard deviation
that the curvature of the cost tells, and the last step's length.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float

from nbtrack.beyond.lm_solver import PRIOR_WEIGHT, retract
from nbtrack.core.arrays import Pose
from nbtrack.tracking.metrics import LOST_THRESHOLD_M

WRONG_M = 0.05
WRONG_DEG = 3.0
# Of the log odds of a wrong pose; the coefficients are those of the four `features`.
_INTERCEPT = 2.01
_COEFFICIENTS = np.array([-2.06, -0.28, 2.8, 1.39])
# Scales of robust costs are 3 medians of |r|: two standard deviations, were residuals normal.
MAD_FACTOR = 3.0
SIGMAS = 0.6745 * MAD_FACTOR
CORRELATED = 2.0  # by how much stds that take errors for independent are too small
# Where a pose is held, its cost grows both ways, but within 5 cm often one way alone.
_MOVED_M = 2 * WRONG_M


def features(said: Mapping[str, float]) -> Float[np.ndarray, "4"]:
    """Numbers that grow about linearly with the log odds of a wrong pose.

    Of what a tracker says: `fitting_ratio`, `known_ratio` (see `LmOptimizer.certainty`),
    `intensity_ratio` (median difference over the usual one) and `innovation` (how far from where
    the frames before led to, rad or m).
    """
    # Shares of 0 and 1 would have infinite log odds.
    fitting, known = np.clip([said["fitting_ratio"], said["known_ratio"]], 0.01, 0.99)
    intensity = np.clip(said["intensity_ratio"], 0.5, 10)
    innovation = np.clip(said["innovation"], 0.02, 1)
    numbers = fitting / (1 - fitting), known / (1 - known), intensity, innovation
    return np.array([math.log(number) for number in numbers])


def p_lost(said: Mapping[str, float]) -> float:
    """The probability that the pose is wrong, by its features, `position_std_m` and `last_step`.

    The last step is in rad or m, 0 where the pose has settled.
    """
    p_right = 1 / (1 + math.exp(_INTERCEPT + _COEFFICIENTS @ features(said)))
    spread = math.hypot(CORRELATED * said["position_std_m"], said["last_step"])
    return 1 - p_right * p_within(spread)


def p_within(position_std_m: float) -> float:
    """The probability that a normal error along one direction, of this std, is below `WRONG_M`."""
    return math.erf(WRONG_M / math.sqrt(2) / position_std_m)


def std_when_moved(
    costs_at: Callable[[Pose], Float[np.ndarray, "n"]],
    T_world_camera: Pose,
    covariance: Float[np.ndarray, "6 6"],
    n_directions: int,
    n_independent: int,
) -> float:
    """The position's standard deviation (m), by how the points' costs grow `_MOVED_M` away.

    The pose moves both ways along the position's least certain directions, and turns as the
    covariance (world frame, rad and m, as `lm_solver.retract` takes twists) says; the smallest
    growth counts. Curvature alone is not enough: ripples in the map of a flat wall have gradients,
    too, but the frame fits as well all along the wall. Errors of a map are alike at neighbouring
    points, so that at most `n_independent` points count. Costs are Geman-McClure's, at scales
    of `MAD_FACTOR` medians.
    """
    variances, directions = np.linalg.eigh(covariance[3:, 3:])  # the least certain come last
    here = costs_at(T_world_camera)
    growths = []
    for k in range(1, n_directions + 1):
        # Of all twists that move the position so far along the direction, the likeliest.
        twist = _MOVED_M * covariance[:, 3:] @ directions[:, -k] / variances[-k]
        for way in (1, -1):
            growths.append((costs_at(retract(T_world_camera, way * twist)) - here).mean())
    growth = max(min(growths), 0.0) * min(len(here), n_independent)
    # Of a cost that grows with the square of the offset, and of the pose prior.
    return 1 / (SIGMAS * (growth / _MOVED_M**2 + PRIOR_WEIGHT) ** 0.5)


def score_detection(
    called_lost: Bool[np.ndarray, "n"], errors_m: Float[np.ndarray, "n"]
) -> dict[str, float | None]:
    """Precision and recall of verdicts: lost are frames with errors above `LOST_THRESHOLD_M`.

    The precision is None where none was called lost, the recall None where none was.

    >>> score_detection(np.array([True, True, False]), np.array([0.3, 0.1, 0.5]))
    {'lost_precision': 0.5, 'lost_recall': 0.5}
    """
    is_lost = errors_m > LOST_THRESHOLD_M
    both = int((called_lost & is_lost).sum())
    counts = {"lost_precision": int(called_lost.sum()), "lost_recall": int(is_lost.sum())}
    return {name: both / count if count > 0 else None for name, count in counts.items()}
