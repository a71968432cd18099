"""The probability that a tracked pose is wrong: off by more than 5 cm or 3 degrees.

Two reasons are modelled, and taken to be independent:

- The pose is another local minimum of the cost. Logistic regression on four features of the result
  gives the probability. `benchmarks/verdict.py` fits its coefficients, in the two rooms for tuning
  and on a real recording.
- The pose is near the right one, but the cost hardly grows along some direction, or the budget
  ended while the pose still moved. This error is taken to be normal. Its variance is the sum of the
  position's, from the growth of the cost, and of the last step's square.
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
# The log odds of a wrong pose are the intercept plus the coefficients times the four `features`.
_INTERCEPT = 2.01
_COEFFICIENTS = np.array([-2.06, -0.28, 2.8, 1.39])
MAD_FACTOR = 3.0  # a robust scale is so many median absolute residuals (MAD)
SIGMAS = 0.6745 * MAD_FACTOR  # the same scale in standard deviations, if residuals are normal
# A standard deviation that is computed as if correlated errors were independent is too small. It is
# multiplied by this factor.
CORRELATED = 2.0
# A pose is moved so far to see whether its cost grows. In a room with a partition the cost at right
# poses grew in both directions at this distance, but within 5 cm in one alone (docs/tried.md).
_MOVED_M = 2 * WRONG_M


def features(report: Mapping[str, float]) -> Float[np.ndarray, "4"]:
    """The four features of a tracker's report from which the log odds of a wrong pose are computed.

    They are logarithms: of the odds of `fitting_ratio` and of `known_ratio` (shares that
    `LmOptimizer.certainty` explains), of `intensity_ratio` (the median intensity difference divided
    by the usual one), and of `innovation` (how far, in rad or m, the pose is from the nearest pose
    that the frames before let expect).
    """
    # Ratios of 0 and 1 would have infinite log odds. All limits are our choice.
    fitting, known = np.clip([report["fitting_ratio"], report["known_ratio"]], 0.01, 0.99)
    intensity = np.clip(report["intensity_ratio"], 0.5, 10)
    innovation = np.clip(report["innovation"], 0.02, 1)
    numbers = fitting / (1 - fitting), known / (1 - known), intensity, innovation
    return np.array([math.log(number) for number in numbers])


def p_lost(report: Mapping[str, float]) -> float:
    """The probability that the pose of a tracker's report is wrong.

    It depends on the `features` and on two other numbers of the report: `position_std_m`, and
    `last_step`, the largest component (rad or m) of the last twist, which is 0 if the pose has
    converged.
    """
    p_right = 1 / (1 + math.exp(_INTERCEPT + _COEFFICIENTS @ features(report)))
    spread = math.hypot(CORRELATED * report["position_std_m"], report["last_step"])
    return 1 - p_right * p_within(spread)


def p_within(position_std_m: float) -> float:
    """The probability that an error along one direction is below `WRONG_M`.

    The error is normal, with the standard deviation `position_std_m` (m).
    """
    return math.erf(WRONG_M / math.sqrt(2) / position_std_m)


def std_when_moved(
    costs_at: Callable[[Pose], Float[np.ndarray, "n"]],
    T_world_camera: Pose,
    covariance: Float[np.ndarray, "6 6"],
    n_directions: int,
    n_independent: int,
) -> float:
    """The position's standard deviation (m), from how much the cost grows `_MOVED_M` away.

    `costs_at` gives the cost of each of the frame's n points at a pose. Costs must be those of
    Geman and McClure, at scales of `MAD_FACTOR` medians. The pose is moved both ways along each of
    the `n_directions` least certain directions of the position, by the likeliest twist under
    `covariance` (rad and m, world axes, as `lm_solver.retract` takes twists). The smallest growth
    of the mean cost counts. A map's errors at neighbouring points are correlated, so that at most
    `n_independent` points count as independent.

    The curvature of the cost alone is not enough: ripples in the map of a flat wall have gradients,
    too, but the frame fits as well all along the wall.
    """
    variances, directions = np.linalg.eigh(covariance[3:, 3:])  # ascending: the last is the largest
    here = costs_at(T_world_camera)
    growths = []
    for k in range(1, n_directions + 1):
        # The mean of all twists with this offset along the direction, and so the likeliest of them.
        twist = _MOVED_M * covariance[:, 3:] @ directions[:, -k] / variances[-k]
        for way in (1, -1):
            growths.append((costs_at(retract(T_world_camera, way * twist)) - here).mean())
    growth = max(min(growths), 0.0) * min(len(here), n_independent)
    # The cost is taken to grow with the square of the offset. The pose prior adds to it.
    return 1 / (SIGMAS * (growth / _MOVED_M**2 + PRIOR_WEIGHT) ** 0.5)


def score_detection(
    called_lost: Bool[np.ndarray, "n"], errors_m: Float[np.ndarray, "n"]
) -> dict[str, float | None]:
    """Precision and recall of the verdict "lost" on n frames.

    A frame is lost if its error is above `LOST_THRESHOLD_M`. The precision is None if no frame was
    called lost, and the recall is None if no frame was lost.

    >>> score_detection(np.array([True, True, False]), np.array([0.3, 0.1, 0.5]))
    {'lost_precision': 0.5, 'lost_recall': 0.5}
    """
    is_lost = errors_m > LOST_THRESHOLD_M
    n_found = int((called_lost & is_lost).sum())
    # Precision is n_found divided by the frames called lost, recall by the frames that are lost.
    divisors = {"lost_precision": int(called_lost.sum()), "lost_recall": int(is_lost.sum())}
    return {name: n_found / n if n > 0 else None for name, n in divisors.items()}
