"""A descent for a frame's pose from one start: steps of Levenberg-Marquardt in two stages.

All numbers are our choice.
"""

import numpy as np
from jaxtyping import Float

from nbtrack.beyond import lm_solver
from nbtrack.beyond.lm_residuals import Grid, Problem, Stage, residual_terms
from nbtrack.beyond.observed import Observed
from nbtrack.beyond.verdict import MAD_FACTOR, SIGMAS, std_when_moved
from nbtrack.core.arrays import Pose

_MAX_DAMPING = 1e3  # a larger damping ends a stage
# Robust scales (m, luma) at which poses are compared: those of finished descents with each other,
# and the pose after a coarse stage with the start, since a coarse stage may end at a worse pose.
NEAR_SCALES = np.array([0.02, 0.05])
# Far from the pose only distances are used: the basin of intensities is as narrow as the texture.
COARSE = Stage(is_fine=False, mad_factor=10.0, min_step=1e-2)
FINE = Stage(is_fine=True, mad_factor=MAD_FACTOR, min_step=3e-4)


class LmOptimizer:
    """A descent from a start: a coarse stage on some points of a frame, then a fine stage on all.

    The caller takes steps until `is_ended`, refines, and takes steps until `is_ended` again. The
    pose is in double precision.

    A step is taken only if it lowers the robust cost. Otherwise the damping grows. Robust scales
    shrink with the residuals, so that descents from far-off starts converge, and outliers are
    down-weighted in the end.
    """

    def __init__(
        self, grid: Grid, coarse: Observed, fine: Observed, lambda_intensity: float, T_start: Pose
    ) -> None:
        """Begin the coarse stage on the points `coarse`; the fine stage takes the points `fine`."""
        self.T_world_camera = T_start
        self.last_step = np.inf  # the last twist's largest component (rad or m)
        self.fine_problem = Problem(fine, grid, FINE, lambda_intensity, T_start)
        self._begin_stage(Problem(coarse, grid, COARSE, lambda_intensity=0.0, T_start=T_start))
        self._start_cost = self.cost(NEAR_SCALES)  # of the points `coarse`, at the start

    def step(self) -> float:
        """Try one step, which is taken or refused; returns the robust cost before it."""
        state = self.problem, self.T_world_camera, self.terms, self.scales, self.damping, self.twist
        is_taken, self.T_world_camera, self.terms, self.twist, self.last_step, cost_before = (
            lm_solver.try_step(*state)
        )
        if is_taken:
            self._narrow_scales()
            self.damping = max(0.2 * self.damping, 1e-9)
        else:
            self.damping *= 10
        is_short = self.last_step < self.problem.stage.min_step
        self.is_ended = is_short or self.damping > _MAX_DAMPING
        return cost_before

    def run_stage(self, max_steps: int = 60) -> None:
        """Take at most `max_steps` steps of the current stage, until it ends."""
        for _ in range(max_steps):
            if self.is_ended:
                return
            self.step()

    def refine(self) -> None:
        """Begin the fine stage where the coarse one ended, or at the start if this costs less."""
        if self.cost(NEAR_SCALES) > self._start_cost:
            self.T_world_camera = self.problem.T_start
        self._begin_stage(self.fine_problem)

    def run(self) -> None:
        """Finish the descent: the rest of the current stage, and the fine stage if it is left."""
        self.run_stage()
        if not self.problem.stage.is_fine:
            self.refine()
            self.run_stage()

    @property
    def is_finished(self) -> bool:
        """Whether the fine stage has ended: further steps would change nothing."""
        return self.is_ended and self.problem.stage.is_fine

    def cost(self, scales: Float[np.ndarray, "2"]) -> float:
        """The robust cost at given scales (m, luma), by which descents are compared.

        Intensities have the fine stage's weight in both stages, so that costs are comparable.
        """
        weight = self.fine_problem.lambda_intensity
        return lm_solver.robust_cost(self.terms.residuals, self.terms.reliability, scales, weight)

    def certainty(self) -> dict[str, float]:
        """Numbers that tell how well the points fit, and how well the cost holds the pose.

        - `inlier_ratio`: the share of inliers: points that fit in distance and intensity, and whose
          reliability is not 0;
        - `known_ratio`: the mean reliability of the points;
        - `fitting_ratio`: the share of inliers among points that are weighted by their reliability,
          since points of what was not mapped fit at no pose;
        - `intensity_mad`: the median absolute deviation of the intensity residuals from their
          median (luma); 0 if intensities have no weight;
        - `position_std_m`: the position's standard deviation (m).
        """
        distance, intensity = self.terms.residuals
        reliability = self.terms.reliability
        has_weight = self.fine_problem.lambda_intensity > 0
        # The median is subtracted, since a picture that is darker as a whole is no sign of a wrong
        # pose.
        off = np.abs(intensity - _median(intensity)) if has_weight else np.zeros_like(intensity)
        is_near = np.abs(distance) < self.problem.grid.accuracy.inlier_distance
        is_inlier = is_near & (reliability > 0) & (off < 0.25)  # luma in [0, 1]; our choice
        known_ratio = float(reliability.mean())
        return {
            "inlier_ratio": float(is_inlier.mean()),
            "known_ratio": known_ratio,
            "fitting_ratio": float((reliability * is_inlier).mean()) / max(known_ratio, 1e-6),
            "intensity_mad": float(_median(off)),
            "position_std_m": self._position_std_m(),
        }

    def _position_std_m(self) -> float:
        """The position's standard deviation (m) along its least certain direction.

        It is the larger one of two estimates: one by the curvature of the cost, the other by
        `std_when_moved`. The true one is larger still, since residuals are taken to be independent,
        and a map's errors are not.
        """
        H, _ = lm_solver.normal_equations(self.terms, self.scales, self.problem.lambda_intensity)
        # In rad and m. H is in units of the robust scales, which are `SIGMAS` standard deviations.
        covariance = np.linalg.inv(H + lm_solver.PRIOR_WEIGHT * np.eye(6)) / SIGMAS**2
        by_curvature = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]).max())
        # Taking 384 or 512 points for independent, some wrong poses before a flat wall were taken
        # for right (docs/tried.md).
        pose = self.T_world_camera
        moved_std_m = std_when_moved(self._costs_at, pose, covariance, 1, n_independent=256)
        return float(max(by_curvature, moved_std_m))

    def _costs_at(self, T_world_camera: Pose) -> Float[np.ndarray, "n"]:
        """The points' costs at another pose, at the robust scales of the current one."""
        terms = residual_terms(self.problem, T_world_camera)
        return lm_solver.point_costs(terms, self.scales, self.problem.lambda_intensity)

    def _begin_stage(self, problem: Problem) -> None:
        """Begin a stage at the current pose, and reset damping and robust scales."""
        self.problem = problem
        self.damping = 1e-4
        self.is_ended = False
        self.twist = np.zeros(6)  # of the last step that was taken; 0 before any
        self.terms = residual_terms(problem, self.T_world_camera)
        self.scales = np.full(2, np.inf)  # `_narrow_scales` can only reduce them
        self._narrow_scales()

    def _narrow_scales(self) -> None:
        """Reduce the robust scales as the residuals allow; they never grow in a stage."""
        sigma, factor = self.problem.grid.accuracy.residual_sigma, self.problem.stage.mad_factor
        self.scales = lm_solver.robust_scales(self.terms.residuals, self.scales, sigma, factor)


def _median(values: Float[np.ndarray, "n"]) -> float:
    """The median; of an even number of values it is the upper one of the two in the middle."""
    return np.partition(values, len(values) // 2)[len(values) // 2]
