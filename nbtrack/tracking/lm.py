"""LM: second-order steps on signed distance and colour at observed points."""

from dataclasses import dataclass
from math import inf

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.arrays import Scalar, Transform
from nbtrack.core.settings import may_be_zero
from nbtrack.data.frame import Frame
from nbtrack.fields.base import LUMA
from nbtrack.tracking import registration
from nbtrack.tracking.registration import LEAST_SCALES, Residuals, Scales, moved, robust_cost
from nbtrack.tracking.tracker import Tracker, TrackerSettings

_LEAST_POINTS = 20  # below, a frame says too little for six unknowns
# A search begins on a quarter of the points and ends on all of them: far from the pose the coarse
# answer is as good and costs a quarter. A step below these (rad and m) ends either level.
_COARSE_SHARE = 4
_LEAST_STEPS = (5e-3, 1e-3)
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e3
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.2
# Starts are compared by widely robust costs: narrow ones say the same of all that are off.
_WIDE_SCALES = torch.tensor([0.1, 0.2])
# A pose is taken for lost with fewer inliers than this, or a position less certain than that (m).
_LEAST_INLIERS, _MOST_DEVIATION = 0.6, 0.04
_RESTART_ANGLE = 0.2  # rad, about each axis both ways from the last good pose


@dataclass(frozen=True)
class LmSettings(TrackerSettings):
    """Levenberg-Marquardt; all our choice."""

    n_pixels: int = 512  # points a frame
    motion_model: str = "better_of_both"
    lambda_intensity: float = 1.0  # weight of the intensity residual, both over their scale
    n_restarts: int = may_be_zero(8)  # where the first search ends lost
    anneal: bool = True  # robust scales fall with the residuals; else the narrowest throughout
    divide_by_slope: bool = True  # residuals are f / |grad f|, else f
    bake_voxel: float = 0.0  # m; the field is asked on a grid of such cells, 0: itself


@dataclass
class _Search:
    """One descent from one start; poses in double precision."""

    T_start: Transform
    T_world_camera: Transform
    level: int  # 0 on some of the points, 1 on all
    residuals: Residuals
    scales: Scales
    damping: float = _FIRST_DAMPING


class LmTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame; knows when it is lost.

    A step is taken only if it lowers the robust cost on the frame's points; else the damping grows.
    Robust scales follow the residuals down, so that far-off starts converge and outliers lose their
    say in the end. A search that ends lost is followed by others, from the last good pose and
    around it, while the budget lasts; the cheapest estimate counts. A frame with too few points
    keeps the start that the motion model gave.

    Source: Levenberg 1944, Marquardt 1963; residuals of the paper's Eq. 2; an answer of our own to
    its remark that SDF tracking with Adam needs more steps than 10 Hz allows.
    """

    name = "lm"
    Settings = LmSettings
    copes_without_depth = True
    remembers = ("last_good",)
    last_good: Transform | None = None  # of the latest frame not taken for lost

    def begin(self, frame: Frame, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Draw the frame's points; take up the search from the start that fits them best."""
        T_starts = T_starts.to(torch.float64, copy=True)
        u, _, vt = torch.linalg.svd(T_starts[:, :3, :3])
        T_starts[:, :3, :3] = u @ vt  # rounding gathers over thousands of frames
        self.T_kept, self.searches = T_starts[0], []
        self.anchor = T_starts[-1] if self.last_good is None else self.last_good
        points_camera, color = frame.smooth_points(self.settings.n_pixels, self.generator)
        self.is_converged = len(points_camera) < _LEAST_POINTS
        if self.is_converged:
            return
        observed = points_camera, color @ LUMA.to(color)
        n_coarse = max(_LEAST_POINTS, len(points_camera) // _COARSE_SHARE)
        self.levels = tuple(part[:n_coarse] for part in observed), observed
        searches = [self._search_at(T_start, T_start, 0) for T_start in T_starts]
        self.searches.append(_cheapest(searches, _WIDE_SCALES))

    def step(self) -> Scalar:
        """One step of Levenberg-Marquardt, taken or refused; returns the cost before it."""
        if not self.searches:
            return torch.tensor(float("nan"))
        search, weight = self.searches[-1], self.settings.lambda_intensity
        twist = _damped_step(search, weight)
        T_world_camera = moved(search.T_world_camera, twist)
        residuals = self._residuals_at(T_world_camera, search.level)
        before = robust_cost(search.residuals, search.scales, weight)
        if robust_cost(residuals, search.scales, weight) < before:
            search.T_world_camera, search.residuals = T_world_camera, residuals
            search.scales = registration.scales_of(residuals, search.scales)
            search.damping = max(search.damping * _DAMPING_DOWN, _LEAST_DAMPING)
        else:
            search.damping *= _DAMPING_UP
        is_small = bool(twist.abs().max() < _LEAST_STEPS[search.level])
        if is_small or search.damping > _MOST_DAMPING:
            self._end_level(search)
        return before

    @property
    def T_world_camera(self) -> Transform:
        """The cheapest estimate so far; without points, the first start."""
        if not self.searches:
            return self.T_kept.float()
        return _cheapest(self.searches, LEAST_SCALES).T_world_camera.float()

    def report(self) -> dict[str, float | bool]:
        """Inliers, deviations, condition number and verdict; a good pose is kept for restarts."""
        if not self.searches:
            return {"inlier_ratio": 0.0, "lost": True}
        best, weight = _cheapest(self.searches, LEAST_SCALES), self.settings.lambda_intensity
        found = registration.certainty(best.residuals, best.scales, weight)
        is_uncertain = found["position_deviation_m"] > _MOST_DEVIATION
        is_lost = found["inlier_ratio"] < _LEAST_INLIERS or is_uncertain
        if not is_lost:
            self.last_good = best.T_world_camera
        return {**found, "lost": is_lost}

    def _search_at(self, T_start: Transform, T_world_camera: Transform, level: int) -> _Search:
        residuals = self._residuals_at(T_world_camera, level)
        widest = torch.full((2,), inf) if self.settings.anneal else LEAST_SCALES
        scales = registration.scales_of(residuals, widest)
        return _Search(T_start, T_world_camera, level, residuals, scales)

    def _residuals_at(self, T_world_camera: Transform, level: int) -> Residuals:
        observed, by_slope = self.levels[level], self.settings.divide_by_slope
        return registration.residuals_at(self.field, observed, T_world_camera, by_slope)

    def _end_level(self, search: _Search) -> None:
        """Go on with all points; after that restart if even the best search is lost."""
        if search.level == 0:
            self.searches[-1] = self._search_at(search.T_start, search.T_world_camera, 1)
            return
        n_restarted = len(self.searches) - 1
        self.is_converged = n_restarted >= self.settings.n_restarts or not self.report()["lost"]
        if not self.is_converged:
            T_start = _around(self.anchor, n_restarted)
            self.searches.append(self._search_at(T_start, T_start, 0))


def _cheapest(searches: list[_Search], scales: Scales) -> _Search:
    """That with the lowest robust cost, all at equal scales, of those on the most points."""
    level = max(search.level for search in searches)
    finest = [search for search in searches if search.level == level]
    return min(finest, key=lambda search: robust_cost(search.residuals, scales, 1.0))


def _damped_step(search: _Search, weight: float) -> Float[Tensor, "6"]:
    """The twist that solves (H + pull + damping diag H) twist = -(J'Wr + pull's gradient).

    The pull is START_PULL times (1 - cos(angle) + offset^2 / 2) from the start of the search.
    """
    matrix, vector = registration.normal_equations(search.residuals, search.scales, weight)
    turned = search.T_world_camera[:3, :3] @ search.T_start[:3, :3].T
    sines = (turned - turned.T)[[2, 0, 1], [1, 2, 0]] / 2  # the axis times sin(angle)
    offset = search.T_world_camera[:3, 3] - search.T_start[:3, 3]
    vector += registration.START_PULL * torch.cat([sines, offset]).to(vector)
    diagonal = matrix.diagonal()
    diagonal += registration.START_PULL + search.damping * diagonal
    return -torch.linalg.solve(matrix, vector).to(search.T_world_camera)


def _around(T_world_camera: Transform, number: int) -> Transform:
    """The start of a restart: a pose itself, then turned about x, y and z both ways, and wider."""
    turn = torch.zeros(6).to(T_world_camera)
    if number > 0:
        round_, which = divmod(number - 1, 6)
        axis, way = divmod(which, 2)
        turn[axis] = (1 + round_) * _RESTART_ANGLE * (1 - 2 * way)
    return moved(T_world_camera, turn)
