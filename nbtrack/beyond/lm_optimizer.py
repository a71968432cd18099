"""The search for a frame's pose from one start: steps of Levenberg-Marquardt in two stages."""

import numpy as np
from jaxtyping import Float

from nbtrack.beyond import lm_solver
from nbtrack.beyond.lm_residuals import Grid, Problem, Stage, residual_terms
from nbtrack.beyond.observed import Observed
from nbtrack.beyond.verdict import MAD_FACTOR, SIGMAS, std_when_moved
from nbtrack.core.arrays import Pose

_MAX_DAMPING = 1e3  # ends a stage
# Robust scales (m, luma) at which the ends of descents are compared, also that of a coarse stage
# with its start, which it may have left for a worse pose.
NEAR_SCALES = np.array([0.02, 0.05])
# From afar distances say where the camera is; intensities mislead: their basin is as wide as the
# texture.
COARSE = Stage(is_fine=False, mad_factor=10.0, min_step=1e-2)
FINE = Stage(is_fine=True, mad_factor=MAD_FACTOR, min_step=3e-4)


class LmOptimizer:
    """A search from a start, on some of a frame's points, then on all, in double precision.

    The caller takes steps until `is_ended`, refines, and takes steps until `is_ended` again.

    A step is taken only if it lowers the robust cost; else the damping grows. Robust scales follow
    the residuals down, so that far-off starts converge and outliers are down-weighted in the end.
    """

    def __init__(
        self, grid: Grid, coarse: Observed, fine: Observed, lambda_intensity: float, T_start: Pose
    ) -> None:
        """Begin the coarse stage, on its points; `fine` are those of the fine stage: all."""
        self.T_world_camera = T_start
        self.last_step = np.inf  # rad or m, whichever is more
        self.fine_problem = Problem(fine, grid, FINE, lambda_intensity, T_start)
        self._begin_stage(Problem(coarse, grid, COARSE, lambda_intensity=0.0, T_start=T_start))
        self._start_cost = self.cost(NEAR_SCALES)  # at the start, of the coarse points

    def step(self) -> float:
        """One step, taken or refused; returns the robust cost before it."""
        step = lm_solver.try_step(
            self.problem, self.T_world_camera, self.terms, self.scales, self.damping, self.twist
        )
        self.T_world_camera = step.T_world_camera
        self.terms = step.terms
        self.twist = step.twist
        self.last_step = step.length
        if step.is_better:
            self._narrow_scales()
            self.damping = max(0.2 * self.damping, 1e-9)
        else:
            self.damping *= 10
        self.is_ended = step.length < self.problem.stage.min_step or self.damping > _MAX_DAMPING
        return step.cost_before

    def run_stage(self, max_steps: int = 60) -> None:
        """Take steps of the present stage until it ends, at most `max_steps`."""
        for _ in range(max_steps):
            if self.is_ended:
                return
            self.step()

    def refine(self) -> None:
        """Go on with all points from where the coarse stage ended, or from the start if better."""
        if self.cost(NEAR_SCALES) > self._start_cost:
            self.T_world_camera = self.problem.T_start
        self._begin_stage(self.fine_problem)

    def run(self) -> None:
        """Take the search to its end: the rest of its stage, and the fine one if that is left."""
        self.run_stage()
        if not self.problem.stage.is_fine:
            self.refine()
            self.run_stage()

    @property
    def is_finished(self) -> bool:
        """Whether the fine stage has ended: further steps would change nothing."""
        return self.is_ended and self.problem.stage.is_fine

    def cost(self, scales: Float[np.ndarray, "2"]) -> float:
        """The robust cost of both residuals at given scales, by which searches are compared.

        Intensities have the weight of the fine stage, in the coarse one too.
        """
        weight = self.fine_problem.lambda_intensity
        return lm_solver.robust_cost(self.terms.residuals, self.terms.reliability, scales, weight)

    def certainty(self) -> dict[str, float]:
        """The share of points that fit, and how well the curvature of their cost holds the pose.

        `known_ratio` is the mean reliability of the points, `fitting_ratio` the share of those that
        fit, each counted by its reliability: where little was mapped, few can fit at any pose.
        Intensities count by their differences from the median of all; `intensity_mad` is the median
        of those (MAD), 0 where they have no weight.
        """
        distance, intensity = self.terms.residuals
        reliability = self.terms.reliability
        # A picture that is darker as a whole is no sign of a wrong pose.
        has_weight = self.fine_problem.lambda_intensity > 0
        off = np.abs(intensity - _median(intensity)) if has_weight else np.zeros_like(intensity)
        is_near = np.abs(distance) < self.problem.grid.accuracy.inlier_distance
        is_inlier = is_near & (reliability > 0) & (off < 0.25)  # of luma in [0, 1]
        known_ratio = float(reliability.mean())
        return {
            "inlier_ratio": float(is_inlier.mean()),
            "known_ratio": known_ratio,
            "fitting_ratio": float((reliability * is_inlier).mean()) / max(known_ratio, 1e-6),
            "intensity_mad": float(_median(off)),
            "position_std_m": self._position_std_m(),
        }

    def _position_std_m(self) -> float:
        """The position's standard deviation along its least certain direction.

        The larger of those by curvature and by `std_when_moved`. Residuals are taken to be
        independent, which a map's errors are not: it is a lower bound.
        """
        H, _ = lm_solver.normal_equations(self.terms, self.scales, self.problem.lambda_intensity)
        # In rad and m. H is in units of the scales, which are `SIGMAS` standard deviations.
        covariance = np.linalg.inv(H + lm_solver.PRIOR_WEIGHT * np.eye(6)) / SIGMAS**2
        by_curvature = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:]).max())
        # If more points counted as independent, as 384, some wrong poses before a flat wall would
        # pass (docs/tried.md).
        pose = self.T_world_camera
        moved_std_m = std_when_moved(self._costs_at, pose, covariance, 1, n_independent=256)
        return float(max(by_curvature, moved_std_m))

    def _costs_at(self, T_world_camera: Pose) -> Float[np.ndarray, "n"]:
        """The points' costs at another pose, at the scales of this one."""
        terms = residual_terms(self.problem, T_world_camera)
        return lm_solver.point_costs(terms, self.scales, self.problem.lambda_intensity)

    def _begin_stage(self, problem: Problem) -> None:
        """Begin a stage at the pose so far, with scales and damping anew."""
        self.problem = problem
        self.damping = 1e-4
        self.is_ended = False
        self.twist = np.zeros(6)  # of the step before
        self.terms = residual_terms(problem, self.T_world_camera)
        self.scales = np.full(2, np.inf)  # they only fall, here to those of the residuals
        self._narrow_scales()

    def _narrow_scales(self) -> None:
        """Let the robust scales follow the residuals down; they never grow in a stage."""
        sigma, factor = self.problem.grid.accuracy.residual_sigma, self.problem.stage.mad_factor
        self.scales = lm_solver.robust_scales(self.terms.residuals, self.scales, sigma, factor)


def _median(values: Float[np.ndarray, "n"]) -> float:
    """One of the values: of an even number the upper one of the two in the middle."""
    return np.partition(values, len(values) // 2)[len(values) // 2]
