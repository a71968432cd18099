"""NeuS with SDF (LM): second-order steps on signed distance and colour at observed points."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.registration import (
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
from nbtrack.trackers.base import Tracker, register_tracker

# A pull towards the start of the frame's search, so weak that it decides only where the frame says
# nothing, as along a corridor: one point's worth, at a twist of 0.5 rad or 0.5 m (our choice).
START_SCALE = 0.5
_LEAST_POINTS = 20  # below, a frame says too little for six unknowns
_LEAST_STEP = 2e-4  # rad and m: a step below ends the search
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
        self.observation = Observation.of(points_camera, color)
        searches = [self._search_from(T_start) for T_start in T_starts]
        costs = [float(robust_cost(s.residuals, _WIDE_SCALES, 1.0)) for s in searches]
        self.search = searches[costs.index(min(costs))]
        anchor = T_starts[-1] if self.last_good is None else self.last_good
        self.further_starts = _around(anchor)[: self.config.n_restarts]

    def step(self) -> Float[Tensor, ""]:
        """One step of Levenberg-Marquardt, taken or refused; returns the cost before it."""
        search = self.search
        if search is None:
            return torch.tensor(float("nan"))
        weight = self.config.lambda_intensity
        twist = _damped_step(search, weight)
        T_world_camera = moved(search.T_world_camera, twist)
        residuals = residuals_at(self.field, self.observation, T_world_camera)
        before = robust_cost(search.residuals, search.scales, weight)
        if robust_cost(residuals, search.scales, weight) < before:
            search.T_world_camera, search.residuals = T_world_camera, residuals
            search.scales = scales_of(residuals, search.scales)
            search.damping = max(search.damping * _DAMPING_DOWN, _LEAST_DAMPING)
        else:
            search.damping *= _DAMPING_UP
        is_small = bool(twist.abs().max() < _LEAST_STEP)
        search.is_done = is_small or search.damping > _MOST_DAMPING
        if search.is_done:
            self._conclude()
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
        residuals = residuals_at(self.field, self.observation, T_start)
        return _Search(T_start, T_start, residuals, scales_of(residuals))

    def _conclude(self) -> None:
        """Keep the search that just ended if it is the best; begin another if that is lost."""
        self.best = self._chosen()
        if self.further_starts and self._is_lost(self.best):
            self.search = self._search_from(self.further_starts.pop(0))

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


def _around(T_world_camera: Float[Tensor, "4 4"]) -> list[Float[Tensor, "4 4"]]:
    """A pose, and the same turned about each axis, both ways."""
    turns = torch.zeros(7, 6).to(T_world_camera)
    for axis in range(3):
        turns[1 + 2 * axis, axis] = _RESTART_ANGLE
        turns[2 + 2 * axis, axis] = -_RESTART_ANGLE
    return [moved(T_world_camera, turn) for turn in turns]


def _orthonormal(T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """Poses with exact rotations: rounding gathers over thousands of frames."""
    u, _, vt = torch.linalg.svd(T[:, :3, :3])
    result = T.clone()
    result[:, :3, :3] = u @ vt
    return result
