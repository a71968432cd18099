"""How far a tracked trajectory is from the true one: the paper's error and its companions."""

from dataclasses import asdict, dataclass
from math import isfinite

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from nbtrack.core.errors import DataError, NumericalError

LOST_THRESHOLD_M = 0.2
"""Above this translation error (m) a frame counts as lost. Source: the paper's Table I, in red."""


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Errors over the tracked frames of one run; NaN where no frame was tracked."""

    ate_rmse_m: float  # root mean square translation error, unaligned: the paper's equation
    ate_rmse_aligned_m: float  # the same after the best rigid motion (no scale)
    rotation_rmse_deg: float  # root mean square angle between true and estimated orientation
    median_error_m: float  # of the unaligned translation errors
    max_error_m: float  # of the unaligned translation errors
    frames: int  # tracked frames; the given first one is not among them
    lost_frames: int  # tracked frames with a translation error above LOST_THRESHOLD_M

    def to_dict(self) -> dict[str, float | int | None]:
        """The fields by name, for JSON: a number that is not finite becomes None."""
        return {key: value if isfinite(value) else None for key, value in asdict(self).items()}


def trajectory_metrics(
    T_estimated: Float[np.ndarray, "m 4 4"], T_true: Float[np.ndarray, "n 4 4"]
) -> TrajectoryMetrics:
    """All errors of one trajectory.

    Args:
        T_estimated: camera-to-world poses (m) of every frame, the given first one included. Row 0
            is dropped here, because its pose was handed to the tracker and has no error to measure.
        T_true: true poses of the same frames and with the same camera axes, so n = m.

    Raises:
        DataError: the two hold different numbers of poses, or none.
        NumericalError: a pose is not finite; names the row.

    Source: paper, evaluation protocol (`ate_rmse_m`). Aligned error, rotation, median and maximum
    are our choice: with them one can tell a map that is offset from a tracker that drifts.
    """
    errors = translation_errors(T_estimated, T_true)[1:]
    angles_deg = rotation_errors_deg(T_estimated, T_true)[1:]
    if len(errors) == 0:
        return TrajectoryMetrics(*[float("nan")] * 5, frames=0, lost_frames=0)
    positions = np.asarray(T_estimated, dtype=np.float64)[1:, :3, 3]
    true_positions = np.asarray(T_true, dtype=np.float64)[1:, :3, 3]
    aligned = align_rigidly(positions, true_positions)
    return TrajectoryMetrics(
        ate_rmse_m=_root_mean_square(errors),
        ate_rmse_aligned_m=_root_mean_square(np.linalg.norm(aligned - true_positions, axis=1)),
        rotation_rmse_deg=_root_mean_square(angles_deg),
        median_error_m=float(np.median(errors)),
        max_error_m=float(errors.max()),
        frames=len(errors),
        lost_frames=int((errors > LOST_THRESHOLD_M).sum()),
    )


@dataclass(frozen=True)
class LossDetection:
    """How well a tracker's own verdict agrees with the threshold on the true error."""

    precision: float  # share of the frames called lost that were; NaN where none was called so
    recall: float  # share of the lost frames that were called so; NaN where none was lost

    def to_dict(self) -> dict[str, float | None]:
        """The fields by name, for JSON: a number that is not finite becomes None."""
        named = {"lost_precision": self.precision, "lost_recall": self.recall}
        return {key: value if isfinite(value) else None for key, value in named.items()}


def score_detection(
    called_lost: Bool[np.ndarray, "m"], errors_m: Float[np.ndarray, "m"]
) -> LossDetection:
    """Precision and recall of a tracker's verdicts against `LOST_THRESHOLD_M`.

    >>> score_detection(np.array([True, True, False]), np.array([0.3, 0.1, 0.5]))
    LossDetection(precision=0.5, recall=0.5)
    """
    is_lost = errors_m > LOST_THRESHOLD_M
    both = int((called_lost & is_lost).sum())
    called, lost = int(called_lost.sum()), int(is_lost.sum())
    return LossDetection(
        both / called if called else float("nan"), both / lost if lost else float("nan")
    )


def translation_errors(
    T_estimated: Float[np.ndarray, "m 4 4"], T_true: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "m"]:
    """Distance (m) between estimated and true camera position of every frame, row 0 included.

    Raises:
        DataError, NumericalError: as `trajectory_metrics`.

    Source: paper, evaluation protocol: the norm inside the sum.
    """
    estimated, true = _checked(T_estimated, T_true)
    return np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)


def rotation_errors_deg(
    T_estimated: Float[np.ndarray, "m 4 4"], T_true: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "m"]:
    """Angle (degrees, 0 to 180) from the true to the estimated orientation, row 0 included.

    Raises:
        DataError, NumericalError: as `trajectory_metrics`.
    """
    estimated, true = _checked(T_estimated, T_true)
    difference = true[:, :3, :3].transpose(0, 2, 1) @ estimated[:, :3, :3]
    return np.degrees(Rotation.from_matrix(difference).magnitude())


def align_rigidly(
    points: Float[np.ndarray, "m 3"], targets: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 3"]:
    """Points (m) after the rotation and translation that bring them closest to their targets.

    Least squares over all pairs, without scale. Where points lie on a line or in one place, the
    best rotation is not unique, but the distances that remain are.

    Source: Horn 1987 and Umeyama 1991, by singular value decomposition.
    """
    center, target_center = points.mean(axis=0), targets.mean(axis=0)
    u, _, vt = np.linalg.svd((targets - target_center).T @ (points - center))
    # The best orthogonal matrix may be a mirror; flipping the weakest axis makes it a rotation.
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return (points - center) @ rotation.T + target_center


def _root_mean_square(values: Float[np.ndarray, "m"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _checked(
    T_estimated: Float[np.ndarray, "m 4 4"], T_true: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "m 4 4"], Float[np.ndarray, "m 4 4"]]:
    """Both trajectories in double precision, equally long and finite."""
    if len(T_estimated) != len(T_true) or len(T_true) == 0:
        raise DataError(
            f"{len(T_estimated)} estimated and {len(T_true)} true poses; allowed: equally many, "
            "at least one; pass the poses of the same frames"
        )
    for name, poses in (("estimated", T_estimated), ("true", T_true)):
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if len(bad):
            raise NumericalError(
                f"the {name} pose of frame {bad[0]} is not finite ({len(bad)} such frames); "
                "allowed: finite poses; leave such frames out or check the tracking loss there"
            )
    return np.asarray(T_estimated, dtype=np.float64), np.asarray(T_true, dtype=np.float64)
