"""LM: second-order steps on signed distance and colour at observed points, and restarts."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_solver import Descent, Grid, retract
from nbtrack.beyond.observed import draw_points, with_normals
from nbtrack.core.arrays import Pose, Poses, Transform, Transforms
from nbtrack.core.settings import limited
from nbtrack.data.frame import Frame
from nbtrack.fields import Field
from nbtrack.tracking.tracker import Tracker, TrackerSettings

_MIN_POINTS = 20  # below, a frame says too little for six unknowns
# A descent begins on some of the points, a share but so many, and ends on all of them: far from the
# pose the coarse answer is as good and costs less.
_COARSE_SHARE, _MIN_COARSE = 8, 128
# Starts are compared by widely robust costs: narrow ones say the same of all that are off.
_WIDE_SCALES = np.array([0.1, 0.2])
# Starts that differ by more (m, rad), as of a fast camera that may have stopped, are compared after
# their coarse stages, of so many steps at most: costs of the starts themselves do not tell which
# of them leads to the true pose.
_FAR_APART, _MAX_COARSE_STEPS = 0.06, 30
_MAX_STD = 0.04  # m; a pose whose position is less certain is taken for lost
# With fewer inliers even a pose is lost to which the frame before led, within so much (m, rad).
_MIN_INLIERS, _FOLLOWED = 0.6, 0.15
_SETTLED = 2e-3  # m, rad; a longer last step says that the budget has ended too early
# With fewer inliers intensities may be off by so many times what is usual.
# (No less than what rounding to 256 grey levels leaves in the median.)
_DOUBTED, _MAX_MAD_RATIO, _ROUNDING = 0.85, 4.0, 0.25 / 255
_RESTART_ANGLE = 0.2  # rad, about each axis both ways from the last good pose
# Where a map knows its cameras, a lost one is looked for at so many random poses, so far (m) from
# theirs; from the cheapest some steps are taken, before the cheapest of those are followed.
_HYPOTHESES, _HYPOTHESIS_STD, _TRIED, _TRIED_STEPS = 1000, 0.3, 40, 6


@dataclass(frozen=True)
class LmSettings(TrackerSettings):
    """Settings of the Levenberg-Marquardt tracker. All defaults are our choice."""

    n_pixels: int = 512  # points a frame
    motion_model: str = "better_of_both"
    voxel: float = 0.04  # m; of the grid that a field is asked on, where it is not one
    lambda_intensity: float = 1.0  # weight of the intensity residual, both over their scale
    n_restarts: int = limited(8, 0, 1000)  # where the first descent ends lost


class LmTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame; knows when it is lost.

    It works on a grid on the host: one that is given, or any field with a signed distance, sampled
    once in cells of `settings.voxel`. Of the motion model's starts the better one is followed: by
    their costs, or, where they are far apart, by those after coarse stages, which count as no step.
    A descent that ends lost is followed by others, while the budget lasts: from the last good pose
    and around it, or, where the map knows its own cameras, from those of the last good pose and of
    hypotheses near the cameras that fit the frame best after a few steps, which count as one. The
    first that is not lost counts; if all are, that from the motion model. A frame with too few
    points keeps the start that this gave.

    Source: Levenberg 1944, Marquardt 1963; residuals of the paper's Eq. 2, as `lm_solver` states
    them; an answer of our own to its remark that SDF tracking with Adam needs more steps than 10 Hz
    allows.
    """

    name = "lm"
    Settings = LmSettings
    converges = True
    copes_without_depth = True
    remembers = ("last_good", "was_lost", "usual_mad")
    last_good: Transform | None = None  # of the latest frame not taken for lost
    was_lost: bool = False  # in the frame before
    usual_mad: float | None = None  # of intensities, in the latest frame beyond doubt

    def prepare(self, field: Field) -> BakedField:
        """The map as a grid on the host; ConfigError where it would be too large."""
        grid = field if isinstance(field, BakedField) else BakedField(field, self.settings.voxel)
        grid = grid if grid.device.type == "cpu" else deepcopy(grid).cpu()
        self.grid = Grid(grid)
        return grid

    def restart_anywhere(self) -> None:
        """Look for the camera near all poses that the map was made from; see `_hypotheses`."""
        cameras = self.field.T_world_cameras
        self.check_finds(in_corrected=cameras is not None)
        self.restart(cameras[len(cameras) // 2].double().numpy())
        self.was_lost = True

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Draw the frame's points; take up the descent from the start that fits them best."""
        starts = T_starts.double().numpy()
        # A lost frame says little of where the next one starts.
        if self.was_lost and self.last_good is not None:
            starts = np.concatenate([starts, self.last_good.numpy()[None]])
        # Rounding gathers over thousands of frames: a Newton step towards the nearest rotation.
        R = starts[:, :3, :3]
        R[:] = R @ (3 * np.eye(3) - R.swapaxes(1, 2) @ R) / 2
        self.T_kept, self.descent, self.starts, self.verdict = starts[0], None, None, None
        self.anchor = starts[-1] if self.last_good is None else self.last_good.numpy()
        observed = draw_points(frame, self.settings.n_pixels, self.generator)
        n_points = len(observed[0])
        self.is_converged = n_points < _MIN_POINTS
        if self.is_converged:
            return
        n_coarse = max(_MIN_COARSE, n_points // _COARSE_SHARE)
        self.points = with_normals(frame, observed, n_coarse), observed
        self.expected, self.was_followed = starts, not self.was_lost
        descents = [self._descent_from(T) for T in starts]
        if np.abs(starts - starts[0]).max() > _FAR_APART:
            for descent in descents:
                _take_steps(descent, _MAX_COARSE_STEPS)
        self.descent = self.best = _by_cost(descents)[0]

    def step(self) -> float:
        """One step of Levenberg-Marquardt, taken or refused; returns the cost before it."""
        if self.descent is None:
            return float("nan")
        self.verdict = None if self.descent is self.best else self.verdict
        before = self.descent.step()
        if self.descent.is_finished:
            self._follow_up()
        elif self.descent.is_ended:
            self.descent.refine()
        return before

    @property
    def T_world_camera(self) -> Transform:
        """The estimate so far; without points, the first start."""
        return torch.from_numpy(self.T_kept if self.descent is None else self.best.T_world_camera)

    def report(self) -> dict[str, float | bool]:
        """Inliers, stds, condition number and verdict; a good pose is kept for restarts."""
        if self.descent is None:
            self.verdict = {"inlier_ratio": 0.0, "lost": True}
        elif self.verdict is None:
            self.verdict = self._judge(self.best)
        self.was_lost = self.verdict["lost"]
        if not self.was_lost:
            self.last_good = self.T_world_camera
            if self.verdict["inlier_ratio"] >= _DOUBTED:
                self.usual_mad = self.verdict["intensity_mad"]
        return self.verdict

    def _judge(self, descent: Descent) -> dict[str, float | bool]:
        """What a descent says of its pose; where the frame before led to it, fewer inliers do.

        One that the budget ended while it still moved is lost: it may be on its way along a wall.
        So is one that has slid along a wall onto what the map made up: fewer points fit, and
        intensities, which did not hold it there, are off by several times what is usual in the
        latest frame beyond doubt, or, before there was one, in the map's own frames.
        """
        certainty = descent.certainty()
        changes = np.linalg.inv(self.expected) @ descent.T_world_camera - np.eye(4)
        is_near = np.abs(changes).max(axis=(1, 2)).min() < _FOLLOWED
        is_followed = self.was_followed and self.starts is None and is_near
        enough = _MIN_INLIERS if is_followed else self.field.min_inliers
        is_settled = descent.is_finished or (is_followed and descent.last_step < _SETTLED)
        usual_mad = self.field.intensity_mad if self.usual_mad is None else self.usual_mad
        usual_mad = max(usual_mad, _ROUNDING)
        is_odd = certainty["intensity_mad"] > _MAX_MAD_RATIO * usual_mad
        has_contrast = self.points[1][1].std() > usual_mad  # else it is dark, or overexposed
        is_odd &= certainty["inlier_ratio"] < _DOUBTED and has_contrast
        is_sure = certainty["inlier_ratio"] >= enough and certainty["position_std_m"] <= _MAX_STD
        return {**certainty, "lost": bool(is_odd or not (is_sure and is_settled))}

    def _descent_from(self, T_start: Pose) -> Descent:
        return Descent(self.grid, *self.points, self.settings.lambda_intensity, T_start)

    def _follow_up(self) -> None:
        """Restart if a descent has ended lost and another start is left; else the frame is done."""
        verdict = self._judge(self.descent)
        if self.descent is self.best or not verdict["lost"]:
            self.best, self.verdict = self.descent, verdict
        if self.starts is None and verdict["lost"] and self.settings.n_restarts:
            self.starts = self._other_starts()[: self.settings.n_restarts]
        self.is_converged = not verdict["lost"] or not self.starts
        if not self.is_converged:
            self.descent = self._descent_from(self.starts.pop(0))

    def _other_starts(self) -> list[Pose]:
        """Where else the camera may be, the likeliest first."""
        cameras = self.field.T_world_cameras
        if cameras is None:
            # The last good pose itself, then turned about x, y and z both ways, and wider.
            turns = [way * axis for axis in np.eye(6)[:3] for way in (1, -1)]
            wider = [
                factor * turn for factor in range(1, self.settings.n_restarts) for turn in turns
            ]
            twists = [np.zeros(6), *(_RESTART_ANGLE * np.array(wider))]
            return [retract(self.anchor, twist) for twist in twists]
        hypotheses = [self.anchor, *self._hypotheses(cameras.double().numpy())]
        tried = _by_cost([self._descent_from(T) for T in hypotheses])[:_TRIED]
        for descent in tried:
            _take_steps(descent, _TRIED_STEPS)
        return [descent.T_world_camera for descent in _by_cost(tried)]

    def _hypotheses(self, T_world_cameras: Poses) -> Poses:
        """Where else a camera may be: near the known ones, turned about the vertical they share."""
        seed = torch.randint(2**62, (), generator=self.generator)
        random = np.random.default_rng(int(seed))
        hypotheses = T_world_cameras[random.integers(len(T_world_cameras), size=_HYPOTHESES)]
        down = T_world_cameras[:, :3, 1].mean(axis=0)
        turns = random.uniform(0, 2 * np.pi, (_HYPOTHESES, 1)) * down / np.linalg.norm(down)
        hypotheses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix() @ hypotheses[:, :3, :3]
        hypotheses[:, :3, 3] += random.normal(scale=_HYPOTHESIS_STD, size=(_HYPOTHESES, 3))
        return hypotheses


def _by_cost(descents: Sequence[Descent]) -> list[Descent]:
    """Descents in the order of their robust costs, all at equal scales."""
    return sorted(descents, key=lambda d: d.cost(_WIDE_SCALES)) if descents[1:] else [*descents]


def _take_steps(descent: Descent, max_steps: int) -> None:
    """Steps of the stage that a descent is in."""
    for _ in range(max_steps):
        if descent.is_ended:
            return
        descent.step()
