"""LM: second-order steps on signed distance and colour at observed points, and restarts."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_optimizer import NEAR_SCALES, LmOptimizer
from nbtrack.beyond.lm_residuals import grid_of
from nbtrack.beyond.lm_solver import retract
from nbtrack.beyond.observed import Observed, draw_points, with_normals
from nbtrack.beyond.verdict import p_lost
from nbtrack.beyond.views import Viewpoints, retrieve, view_of
from nbtrack.core.arrays import Pose, Poses, Transform, Transforms
from nbtrack.data.frame import Frame
from nbtrack.fields import Field
from nbtrack.machinery.settings import limited
from nbtrack.tracking.budget import Budget
from nbtrack.tracking.starts import rigid
from nbtrack.tracking.tracker import Estimate, Tracker, TrackerSettings

_MIN_POINTS = 20  # below, a frame says too little for six unknowns
# Starts are compared at wide robust scales (m, luma): at narrow ones all that are off cost alike.
_WIDE_SCALES = np.array([0.1, 0.2])
# Starts that differ by more (m, rad), as those of a fast camera that may have stopped, are compared
# after their coarse stages: the costs at the starts do not tell which leads to the true pose.
_FAR_APART = 0.06
_LOST = 0.5  # a pose is lost if it is wrong with at least this probability
_DOUBTFUL = 0.1  # and in doubt from this one on: other descents follow
# The first descent counts as at most so many steps: what is left of it is all done in the last of
# them. A descent from another start counts as one step.
_MAX_FOLLOWING = 20
# Where a map has views, a lost camera is looked for where the views most like the frame were taken,
# and at random poses. A few steps are taken from each; the cheapest are then followed.
_TRIED = 20  # views, and random poses
_RANDOM = 1000  # poses, of which the cheapest `_TRIED` are kept


@dataclass(frozen=True)
class LmSettings(TrackerSettings):
    """Settings of the Levenberg-Marquardt tracker. All defaults are our choice."""

    n_pixels: int = 512  # points a frame
    motion_model: str = "better_of_both"
    voxel: float = 0.04  # m; of the grid that a field is asked on, where it is not one
    lambda_intensity: float = 1.0  # weight of the intensity residual, both over their scale
    n_restarts: int = limited(8, 0, 1000)  # where the first descent ends lost


class LmTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame, with a verdict of being lost.

    It works on a grid on the host: one that is given, or any field with a signed distance, sampled
    once in cells of `settings.voxel`. Of the motion model's starts the better one is followed: by
    their costs, or, where they are far apart, by those after coarse stages, which count as no step.
    Where the pose that this finds is in doubt, other descents follow while the budget lasts, each a
    step: from the last good pose and around it, or, where the map has views, from hypotheses by
    what the frame looks like. A pose that explains the frame clearly better takes over. A frame
    with too few points keeps the start that this gave.

    Source: Levenberg 1944, Marquardt 1963; residuals of the paper's Eq. 2, as `lm_solver` states
    them; an answer of our own to its remark that SDF tracking with Adam needs more steps than 10 Hz
    allows.
    """

    name = "lm"
    Settings = LmSettings
    converges = True
    copes_without_depth = True
    remembers = ("last_good", "was_lost")
    last_good: Transform | None = None  # of the latest frame not taken for lost
    was_lost: bool = False  # in the frame before

    def prepare(self, field: Field) -> BakedField:
        """The map as a grid on the host; ConfigError where it would be too large."""
        baked = field if isinstance(field, BakedField) else BakedField(field, self.settings.voxel)
        on_host = baked.cpu()
        self.grid = grid_of(on_host)
        # A search on one point loads the compiled functions, the inner ones before those that call
        # them. Otherwise the process that compiles would round sums in another way than later ones.
        any_point = Observed(np.zeros((1, 3)), np.zeros(1), np.empty((0, 3)))
        LmOptimizer(self.grid, any_point, any_point, 1.0, T_start=np.eye(4)).certainty()
        return on_host

    def restart_anywhere(self) -> None:
        """Look for the camera near all poses that the map was made from; see `_other_starts`."""
        self.check_finds(in_corrected=self.field.viewpoints is not None)
        self.restart(self.field.viewpoints.T_world_camera[0])  # as good as any: it is not trusted
        self.was_lost = True  # after `restart`, which resets it

    def track(self, frame: Frame, budget: Budget | None = None) -> Estimate:
        """The camera's pose, as any tracker's; a good one is kept for where it may get lost."""
        estimate = super().track(frame, budget)
        self.was_lost = estimate.lost
        if not estimate.lost:
            self.last_good = torch.from_numpy(self.estimates[-1])  # the user has the other
        return estimate

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Draw the frame's points; take up the descent from the start that fits them best."""
        starts = T_starts.double().numpy()
        if self.was_lost and self.last_good is not None:
            starts = np.concatenate([starts, self.last_good.numpy()[None]])
        starts = rigid(starts)
        expected, last_good = np.split(starts, [len(T_starts)])  # the latter is one pose or none
        # Poses near which the camera should be: `innovation` is the distance from them.
        # After a lost frame, which says little of this one, only the last good pose counts, if any.
        self.trusted = last_good if self.was_lost else expected
        self.T_start = expected[0]
        self.best = None
        self.remaining_steps = iter(())  # none, if the frame has too few points
        observed = draw_points(frame, self.settings.n_pixels, self.generator)
        n_points = len(observed.points)
        self.is_converged = n_points < _MIN_POINTS
        if self.is_converged:
            return
        # A descent begins on a part of the points, and ends on all of them: far from the pose the
        # coarse answer is as good and costs less.
        coarse = with_normals(frame, observed, max(128, n_points // 8))
        # A picture without contrast is dark, covered or overexposed, and is not used.
        has_contrast = observed.intensity.std() > 0.01
        self.intensity_weight = self.settings.lambda_intensity if has_contrast else 0.0
        # A function of a start: the descent of this frame from there.
        self.descent_from = partial(LmOptimizer, self.grid, coarse, observed, self.intensity_weight)
        descents = [self.descent_from(T) for T in starts]
        if np.abs(starts - starts[0]).max() > _FAR_APART:
            for descent in descents:
                descent.run_stage(max_steps=30)
        self.best, *_ = _by_cost(descents)
        # The last expected pose is the previous one, unless the model is constant velocity alone.
        self.remaining_steps = self._steps(frame, expected[-1])

    def step(self) -> float:
        """One step of Levenberg-Marquardt, or one descent elsewhere; returns the cost before it."""
        return next(self.remaining_steps, float("nan"))

    @property
    def T_world_camera(self) -> Transform:
        """The estimate so far; without points, the first start."""
        return torch.from_numpy(self.T_start if self.best is None else self.best.T_world_camera)

    def report(self) -> dict[str, float | bool]:
        """What a descent says of its pose, and how likely that makes it a wrong one: the verdict.

        These are the inliers, and what `p_lost` takes.
        """
        if self.best is None:
            return {"inlier_ratio": 0.0, "p_lost": 1.0, "lost": True}
        said = self.best.certainty()
        # No intensity is more accurate than 256 grey levels, with a median error of a quarter.
        usual_mad = max(self.field.accuracy.intensity_mad, 0.25 / 255)
        innovations = _apart(self.trusted, self.best.T_world_camera)
        ratio = said["intensity_mad"] / usual_mad
        said["intensity_ratio"] = ratio if self.intensity_weight else 1.0
        said["last_step"] = 0.0 if self.best.is_finished else float(self.best.last_step)
        said["innovation"] = float(innovations.min(initial=1.0))  # rad, m; at most 1, as of none
        probability = p_lost(said)
        return {**said, "p_lost": probability, "lost": probability >= _LOST}

    def _steps(self, frame: Frame, T_expected: Pose) -> Iterator[float]:
        """Steps of the best descent, then other descents while its pose is in doubt.

        Yields the cost before each of them, after it is done. `T_expected` is where the camera
        may be if no frame was good yet. Before the last cost is yielded `is_converged` is set,
        so that the caller asks for no more.
        """
        cost = self.best.step()
        for _ in range(_MAX_FOLLOWING - 1):
            if self.best.is_finished:
                break
            if self.best.is_ended:
                self.best.refine()
            yield cost
            cost = self.best.step()
        self.best.run()  # the rest of it, if any, within the last of these steps
        if self.settings.n_restarts and self.report()["p_lost"] >= _DOUBTFUL:
            yield cost
            others = self._other_starts(frame, T_expected)
            for n_tried, T_start in enumerate(others, start=1):
                cost = self.best.cost(NEAR_SCALES)
                is_confirmed = self._descend_from(T_start)
                # A pose that another descent confirms may be doubtful, but not lost.
                max_p_lost = _LOST if is_confirmed else _DOUBTFUL
                if n_tried == len(others) or not self.report()["p_lost"] >= max_p_lost:
                    break
                yield cost
        self.is_converged = True
        yield cost

    def _descend_from(self, T_start: Pose) -> bool:
        """Run a whole descent, which becomes the best one if its pose is clearly better.

        Returns whether it ended at the pose of the best one so far, and so confirms that.
        """
        other, best_so_far = self.descent_from(T_start), self.best
        other.run()
        if other.cost(NEAR_SCALES) < 0.97 * best_so_far.cost(NEAR_SCALES):
            self.best = other
        return bool(_apart(other.T_world_camera, best_so_far.T_world_camera) < 0.01)  # rad, m

    def _other_starts(self, frame: Frame, T_expected: Pose) -> list[Pose]:
        """Where else the camera may be, the likeliest first.

        These are poses around the last good one or, before there is one, around an expected one;
        where the map has views, those of `_starts_by_views`. At most `n_restarts` are given, or all
        if no pose is trusted.
        """
        anchor = T_expected if self.last_good is None else self.last_good.numpy()
        if self.field.viewpoints is None:
            # The anchor, then turned about x, y and z both ways, by ever wider angles.
            angles = [factor * 0.2 for factor in range(1, self.settings.n_restarts)]  # rad
            axes = [sign * axis for axis in np.eye(6)[:3] for sign in (1, -1)]
            starts = [anchor] + [retract(anchor, a * axis) for a in angles for axis in axes]
        else:
            starts = self._starts_by_views(frame, anchor, self.field.viewpoints)
        return starts[: self.settings.n_restarts] if len(self.trusted) else starts

    def _starts_by_views(self, frame: Frame, anchor: Pose, viewpoints: Viewpoints) -> list[Pose]:
        """Poses after a few steps from the anchor, views like the frame, and random poses.

        Of the random ones only the cheapest are tried.
        """
        alike = retrieve(view_of(frame), viewpoints, _TRIED)
        random = [self.descent_from(T) for T in self._random_poses(viewpoints.T_world_camera)]
        tried = [self.descent_from(T) for T in (anchor, *alike)] + _by_cost(random)[:_TRIED]
        for descent in tried:
            descent.run_stage(max_steps=6)
        return [descent.T_world_camera for descent in _by_cost(tried)]

    def _random_poses(self, T_world_camera: Poses) -> Poses:
        """Random poses near known ones, turned about the vertical: the known ones' mean y axis."""
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=self.generator)))
        poses = T_world_camera[random.integers(len(T_world_camera), size=_RANDOM)]
        down = T_world_camera[:, :3, 1].mean(axis=0)
        turns = random.uniform(0, 2 * np.pi, (_RANDOM, 1)) * down / np.linalg.norm(down)
        poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += random.normal(scale=0.3, size=(_RANDOM, 3))  # m
        return poses


def _by_cost(descents: list[LmOptimizer]) -> list[LmOptimizer]:
    """Descents in the order of their robust costs, the cheapest first, all at `_WIDE_SCALES`."""
    return sorted(descents, key=lambda descent: descent.cost(_WIDE_SCALES))


def _apart(T_first: Pose | Poses, T_second: Pose) -> np.ndarray:
    """How far poses are from another one: about the larger of angle (rad) and offset (m)."""
    return np.abs(np.linalg.inv(T_first) @ T_second - np.eye(4)).max(axis=(-2, -1))
