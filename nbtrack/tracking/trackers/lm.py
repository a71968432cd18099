"""NeuS with SDF (LM): second-order steps on signed distance and colour at observed points."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.tracking.registration import (
    LEAST_SCALES,
    Observation,
    Residuals,
    Scales,
    Uncertainty,
    inlier_ratio,
    moved,
    normal_equations,
    residuals_at,
    robust_cost,
    scales_of,
    uncertainty,
)
from nbtrack.tracking.trackers.base import Tracker, register_tracker

# A pull towards the start of the frame's search, so weak that it decides only where the frame says
# nothing, as along a corridor: one point's worth, at a twist of 0.5 rad or 0.5 m (our choice).
START_SCALE = 0.5
_LEAST_POINTS = 20  # below, a frame says too little for six unknowns
# A search begins on a quarter of the points and ends on all of them: far from the pose the coarse
# answer is as good and costs a quarter. A step below these (rad and m) ends either level.
_COARSE_SHARE = 4
_LEAST_STEPS = (5e-3, 1e-3)
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e3
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.2
# Starts are compared by widely robust costs: narrow ones say the same of all that are off.
_WIDE_SCALES = Scales(torch.tensor(0.1), torch.tensor(0.2))
# A pose is taken for lost with fewer inliers than this, or a position less certain than that (m).
_LEAST_INLIERS, _MOST_DEVIATION = 0.6, 0.04
_RESTART_ANGLE = 0.2  # rad, about each axis both ways from the last good pose


@dataclass
class _Search:
    """One descent from one start."""

    T_start: Float[Tensor, "4 4"]  # double precision, as is the next
    T_world_camera: Float[Tensor, "4 4"]
    residuals: Residuals
    scales: Scales
    level: int = 0  # 0 on some of the points, 1 on all
    damping: float = _FIRST_DAMPING
    is_done: bool = False

    @property
    def final_cost(self) -> float:
        """Robust cost at the narrowest scales: comparable between searches."""
        return float(robust_cost(self.residuals, LEAST_SCALES, 1.0))


@register_tracker
class LevenbergMarquardtTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame; knows when it is lost.

    A step is taken only if it lowers the robust cost on the frame's points; else the damping grows.
    The scales of the robust weights follow the residuals down, so that far-off starts converge
    and outliers lose their say in the end. A search that ends lost is followed by further ones,
    from the last good pose and from poses around it, as long as the budget lasts; the cheapest
    estimate counts. A frame with too few points keeps the start that the motion model gave.

    Source: Levenberg 1944 and Marquardt 1963; residuals of the paper's Eq. 2; the whole is our own
    answer to the paper's remark that SDF tracking with Adam needs more steps than 10 Hz allows.
    """

    name = "lm"
    label = "NeuS with SDF (LM)"
    short_label = "SDF (LM)"
    field_name = "neus"
    paper_steps = "sdf"
    table_order = 3
    in_paper_tables = False
    copes_without_depth = True

    last_good: Float[Tensor, "4 4"] | None = None  # of the latest frame not taken for lost

    def start_frame(self, frame: int, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Draw the frame's points; take up the search from the start that fits them best."""
        T_starts = _orthonormal(T_starts.double())
        self.T_kept, self.search, self.best = T_starts[0], None, None
        points_camera, color = self.sampler.smooth_points(
            frame, self.config.n_pixels, self.generator
        )
        if len(points_camera) < _LEAST_POINTS:
            return
        observation = Observation.of(points_camera, color)
        n_coarse = max(_LEAST_POINTS, len(points_camera) // _COARSE_SHARE)
        self.levels = (observation.first(n_coarse), observation)
        searches = [self._search_from(T_start) for T_start in T_starts]
        costs = [float(robust_cost(s.residuals, _WIDE_SCALES, 1.0)) for s in searches]
        self.search = searches[costs.index(min(costs))]
        self.anchor = T_starts[-1] if self.last_good is None else self.last_good
        self.n_restarted = 0

    def step(self) -> Float[Tensor, ""]:
        """One step of Levenberg-Marquardt, taken or refused; returns the cost before it."""
        search = self.search
        if search is None:
            return torch.tensor(float("nan"))
        weight = self.config.lambda_intensity
        twist = _damped_step(search, weight)
        T_world_camera = moved(search.T_world_camera, twist)
        residuals = self._residuals_at(T_world_camera, search.level)
        before = robust_cost(search.residuals, search.scales, weight)
        if robust_cost(residuals, search.scales, weight) < before:
            search.T_world_camera, search.residuals = T_world_camera, residuals
            search.scales = self._scales_of(residuals, search.scales)
            search.damping = max(search.damping * _DAMPING_DOWN, _LEAST_DAMPING)
        else:
            search.damping *= _DAMPING_UP
        is_small = bool(twist.abs().max() < _LEAST_STEPS[search.level])
        if is_small or search.damping > _MOST_DAMPING:
            self._end_level(search)
        return before

    @property
    def is_converged(self) -> bool:
        """Whether the search has ended, and with it all further ones that were called for."""
        return self.search is None or self.search.is_done

    @property
    def T_world_camera(self) -> Float[Tensor, "4 4"]:
        """The cheapest estimate so far; without points, the first start."""
        chosen = self._chosen()
        T_world_camera = self.T_kept if chosen is None else chosen.T_world_camera
        return T_world_camera.float()

    def uncertainty(self) -> Uncertainty | None:
        """How well the frame's points hold the present estimate; None without points."""
        chosen = self._chosen()
        if chosen is None:
            return None
        return uncertainty(
            chosen.residuals, chosen.scales, self.config.lambda_intensity, START_SCALE
        )

    def report(self) -> dict[str, float | bool]:
        """Inliers, deviations, condition number and verdict; a good pose is kept for restarts."""
        chosen = self._chosen()
        if chosen is None:
            return {"inlier_ratio": 0.0, "lost": True}
        certainty, inliers = self.uncertainty(), inlier_ratio(chosen.residuals)
        is_lost = self._is_lost(chosen)
        if not is_lost:
            self.last_good = chosen.T_world_camera
        return {
            "inlier_ratio": inliers,
            "position_deviation_m": certainty.position_deviation,
            "rotation_deviation_deg": certainty.rotation_deviation_deg,
            "condition_number": certainty.condition_number,
            "lost": is_lost,
        }

    def state(self) -> dict[str, Any]:
        """The generator, and the pose that restarts begin at."""
        return {**super().state(), "last_good": self.last_good}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `state` returned."""
        super().restore(state)
        self.last_good = state["last_good"]

    def _search_from(self, T_start: Float[Tensor, "4 4"]) -> _Search:
        residuals = self._residuals_at(T_start, level=0)
        return _Search(T_start, T_start, residuals, self._scales_of(residuals))

    def _residuals_at(self, T_world_camera: Float[Tensor, "4 4"], level: int) -> Residuals:
        by_slope = self.config.divide_by_slope
        return residuals_at(self.field, self.levels[level], T_world_camera, by_slope)

    def _scales_of(self, residuals: Residuals, before: Scales | None = None) -> Scales:
        return scales_of(residuals, before) if self.config.anneal else LEAST_SCALES

    def _end_level(self, search: _Search) -> None:
        """Go on with all points; after that keep the best search, and restart if it is lost."""
        if search.level == 0:
            search.level, search.damping = 1, _FIRST_DAMPING
            search.residuals = self._residuals_at(search.T_world_camera, level=1)
            search.scales = self._scales_of(search.residuals)
            return
        search.is_done = True
        self.best = self._chosen()
        if self.n_restarted < self.config.n_restarts and self._is_lost(self.best):
            self.search = self._search_from(_around(self.anchor, self.n_restarted))
            self.n_restarted += 1

    def _chosen(self) -> _Search | None:
        if self.best is None or self.search is self.best:
            return self.search
        return min(self.best, self.search, key=lambda search: search.final_cost)

    def _is_lost(self, search: _Search) -> bool:
        if inlier_ratio(search.residuals) < _LEAST_INLIERS:
            return True
        certainty = uncertainty(
            search.residuals, search.scales, self.config.lambda_intensity, START_SCALE
        )
        return certainty.position_deviation > _MOST_DEVIATION


def _damped_step(search: _Search, intensity_weight: float) -> Float[Tensor, "6"]:
    """The twist that solves (H + pull + damping diag H) twist = -(J'Wr + pull)."""
    matrix, vector = normal_equations(search.residuals, search.scales, intensity_weight)
    pull = 1 / START_SCALE**2
    offset = search.T_world_camera[:3, 3] - search.T_start[:3, 3]
    vector[3:] += pull * offset.to(vector)
    diagonal = matrix.diagonal()
    diagonal += pull + search.damping * diagonal
    return -torch.linalg.solve(matrix, vector).to(search.T_world_camera)


def _around(T_world_camera: Float[Tensor, "4 4"], number: int) -> Float[Tensor, "4 4"]:
    """The start of a restart: a pose itself, then turned about x, y and z both ways, and wider."""
    turn = torch.zeros(6).to(T_world_camera)
    if number > 0:
        round_, which = divmod(number - 1, 6)
        axis, way = divmod(which, 2)
        turn[axis] = (1 + round_) * _RESTART_ANGLE * (1 - 2 * way)
    return moved(T_world_camera, turn)


def _orthonormal(T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """Poses with exact rotations: rounding gathers over thousands of frames."""
    u, _, vt = torch.linalg.svd(T[:, :3, :3])
    result = T.clone()
    result[:, :3, :3] = u @ vt
    return result
