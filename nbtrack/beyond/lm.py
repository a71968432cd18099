"""The tracker LM: second-order steps on signed distance and intensity, restarts, relocalisation.

All numbers are our choice.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product

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
from nbtrack.machinery.settings import limited, one_of
from nbtrack.tracking.budget import Budget
from nbtrack.tracking.starts import rigid
from nbtrack.tracking.tracker import Estimate, Tracker, TrackerSettings

_MIN_POINTS = 20  # a frame with fewer points is not tracked: they hold six unknowns too badly
# Starts are compared at wide robust scales (m, luma). At narrow ones all wrong poses cost the same.
_WIDE_SCALES = np.array([0.1, 0.2])
# Starts that differ by more (m, rad) are compared after their coarse stages, since the costs at the
# starts do not show which one leads to the true pose. A fast camera that may have stopped has such
# starts.
_FAR_APART = 0.06
_LOST = 0.5  # a frame is lost if its pose is wrong with at least this probability
_DOUBTFUL = 0.1  # a pose is in doubt if it is wrong with at least this probability
# The first descent counts as at most so many steps. The last of them does whatever is left of it.
_MAX_FIRST_STEPS = 20
# If a map has views, a lost camera is searched for at the poses of the `_TRIED` most similar views,
# and at the cheapest `_TRIED` of `_RANDOM` random poses. A few steps are taken from each, and
# descents follow from there, the cheapest first.
_TRIED = 20
_RANDOM = 1000


@dataclass(frozen=True)
class LmSettings(TrackerSettings):
    """Settings of the Levenberg-Marquardt tracker."""

    n_pixels: int = 512  # points a frame
    motion_model: str = one_of("better_of_both", "previous_pose", "constant_velocity")
    voxel: float = 0.04  # m; a field that is no grid is sampled in cells of this size
    # Weight of the intensity residual against that of the distance, each divided by its scale.
    lambda_intensity: float = 1.0
    n_restarts: int = limited(8, 0, 1000)  # descents at most that follow one whose pose is in doubt


class LmTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame, with a verdict of being lost.

    It works on a grid on the host. Other fields with a signed distance are sampled once, in cells
    of `settings.voxel`. A frame is tracked as follows:

    1. A descent begins at the best start. The starts are those of the motion model and, after a
       lost frame, the last good pose. They are compared by their costs. Starts that are far apart
       are compared by the costs after their coarse stages, which count as no steps.
    2. If the resulting pose is in doubt, other descents follow while the budget lasts. Each counts
       as one step. They begin at the poses of similar views if the map has views, else at the last
       good pose and around it. A pose that explains the frame clearly better replaces the one
       before.

    A frame with too few points keeps the motion model's first start.

    Source: Levenberg 1944, Marquardt 1963; residuals of the paper's Eq. 2, as `lm_residuals` states
    them. Our own answer to the paper's remark that SDF tracking with Adam needs more steps than
    10 Hz allows.
    """

    name = "lm"
    Settings = LmSettings
    converges = True
    copes_without_depth = True
    remembers = ("last_good", "was_lost")
    last_good: Transform | None = None  # the pose of the latest frame that was not lost
    was_lost: bool = False  # whether the frame before was lost

    def prepare(self, field: Field) -> BakedField:
        """Return the map as a grid on the host; ConfigError if it would be too large."""
        baked = field if isinstance(field, BakedField) else BakedField(field, self.settings.voxel)
        on_host = baked.cpu()
        self.grid = grid_of(on_host)
        # A descent on one point compiles all its functions, or loads them from the disk, before any
        # result depends on them, and inner functions before those that call them. Otherwise the
        # process that compiles them would round sums in another way than later processes.
        any_point = Observed(np.zeros((1, 3)), np.zeros(1), np.empty((0, 3)))
        LmOptimizer(self.grid, any_point, any_point, 1.0, T_start=np.eye(4)).certainty()
        return on_host

    def restart_anywhere(self) -> None:
        """Let the next frame be searched for as a lost one, near all poses of the mapped frames."""
        self.check_finds(in_corrected=self.field.viewpoints is not None)
        self.restart(self.field.viewpoints.T_world_camera[0])  # any pose would do: none is trusted
        self.was_lost = True  # after `restart`, which resets it

    def track(self, frame: Frame, budget: Budget | None = None) -> Estimate:
        """Track a frame as any tracker does, and keep its pose as the last good one if not lost."""
        estimate = super().track(frame, budget)
        self.was_lost = estimate.lost
        if not estimate.lost:
            # Not the pose of `estimate`, which the user may change.
            self.last_good = torch.from_numpy(self.estimates[-1])
        return estimate

    def begin(self, frame: Frame, T_starts: Transforms) -> None:
        """Draw the frame's points, and begin the descent at the start that fits them best."""
        n_expected, starts = len(T_starts), T_starts.double().numpy()
        if self.was_lost and self.last_good is not None:
            starts = np.concatenate([starts, self.last_good.numpy()[None]])
        starts = rigid(starts)
        # The poses near which the camera should be; `innovation` is the distance from them. They
        # are the motion model's starts. After a lost frame these mean little, and the last good
        # pose, if there is one, takes their place.
        self.trusted = starts[n_expected:] if self.was_lost else starts[:n_expected]
        self.T_start = starts[0]
        self.best = None  # the descent whose pose is the estimate
        self.remaining_steps = iter(())  # none, unless the frame has enough points
        observed = draw_points(frame, self.settings.n_pixels, self.generator)
        if len(observed.points) < _MIN_POINTS:  # as where every second row lacks depth
            observed = draw_points(frame, self.settings.n_pixels, self.generator, np.inf)
        n_points = len(observed.points)
        self.is_converged = n_points < _MIN_POINTS
        if self.is_converged:
            return
        # A descent begins on a part of the points, which takes less time, and ends on all of them.
        coarse = with_normals(frame, observed, max(128, n_points // 8))
        # A picture without contrast is dark, covered or overexposed: its intensities are not used.
        has_contrast = observed.intensity.std() > 0.01
        self.intensity_weight = self.settings.lambda_intensity if has_contrast else 0.0
        # `descent_from(T)` begins a descent for this frame's pose at the start T.
        self.descent_from = partial(LmOptimizer, self.grid, coarse, observed, self.intensity_weight)
        descents = [self.descent_from(T) for T in starts]
        if np.abs(starts - starts[0]).max() > _FAR_APART:  # compared after their coarse stages
            for descent in descents:
                descent.run_stage(max_steps=30)
        self.best, *_ = _by_cost(descents)
        # The last start of the motion model: the previous pose, or that of constant velocity.
        self.remaining_steps = self._steps(frame, T_expected=starts[n_expected - 1])

    def step(self) -> float:
        """Take a step of the first descent, or do a whole other descent.

        Returns the robust cost before it, and NaN if no step is left.
        """
        return next(self.remaining_steps, float("nan"))

    @property
    def T_world_camera(self) -> Transform:
        """The estimate so far; the first start if the frame has too few points."""
        return torch.from_numpy(self.T_start if self.best is None else self.best.T_world_camera)

    def report(self) -> dict[str, float | bool]:
        """The probability that the pose is wrong, the verdict `lost`, and the numbers behind both.

        `verdict` and `LmOptimizer.certainty` explain the numbers.
        """
        if self.best is None:
            return {"inlier_ratio": 0.0, "p_lost": 1.0, "lost": True}
        numbers = self.best.certainty()
        # At least a quarter of a grey level: the median error of rounding to 256 levels.
        usual_mad = max(self.field.accuracy.intensity_mad, 0.25 / 255)
        innovations = _apart(self.trusted, self.best.T_world_camera)
        ratio = numbers["intensity_mad"] / usual_mad
        numbers["intensity_ratio"] = ratio if self.intensity_weight else 1.0
        numbers["last_step"] = 0.0 if self.best.is_finished else float(self.best.last_step)
        numbers["innovation"] = float(innovations.min(initial=1.0))  # rad, m; 1 if none is trusted
        probability = p_lost(numbers)
        return {**numbers, "p_lost": probability, "lost": probability >= _LOST}

    def _steps(self, frame: Frame, T_expected: Pose) -> Iterator[float]:
        """Do the steps of the best descent, then other descents while its pose is in doubt.

        After each step or descent the robust cost before it is yielded. `is_converged` is set
        before the last cost is yielded, so that the caller asks for no more. `T_expected` is where
        other descents begin if no frame was good yet.
        """
        cost = self.best.step()
        for _ in range(_MAX_FIRST_STEPS - 1):
            if self.best.is_finished:
                break
            if self.best.is_ended:
                self.best.refine()
            yield cost
            cost = self.best.step()
        self.best.run()  # whatever is left of this descent belongs to the last of its steps
        if self.settings.n_restarts and self.report()["p_lost"] >= _DOUBTFUL:
            yield cost
            others = self._other_starts(frame, T_expected)
            for n_tried, T_start in enumerate(others, start=1):
                cost = self.best.cost(NEAR_SCALES)
                is_confirmed = self._descend_from(T_start)
                # The descents end if the pose is not in doubt. If two of them have found it, they
                # end already if it is not lost.
                enough = _LOST if is_confirmed else _DOUBTFUL
                if n_tried == len(others) or self.report()["p_lost"] < enough:
                    break
                yield cost
        self.is_converged = True
        yield cost

    def _descend_from(self, T_start: Pose) -> bool:
        """Run a whole descent from a start. It becomes the best one if its cost is 3 % lower.

        Returns whether it confirms the pose of the best descent so far: it ended at the same pose.
        """
        other, best_so_far = self.descent_from(T_start), self.best
        other.run()
        if other.cost(NEAR_SCALES) < 0.97 * best_so_far.cost(NEAR_SCALES):
            self.best = other
        return bool(_apart(other.T_world_camera, best_so_far.T_world_camera) < 0.01)  # rad, m

    def _other_starts(self, frame: Frame, T_expected: Pose) -> list[Pose]:
        """Poses at which descents may begin after the first one, the likeliest first.

        With views in the map they are those of `_starts_by_views`. Otherwise they are the last good
        pose, or `T_expected` if there is none yet, and this pose turned about its centre. At most
        `n_restarts` are returned, but all if no pose is trusted, since the camera may be anywhere.
        """
        anchor = T_expected if self.last_good is None else self.last_good.numpy()
        if self.field.viewpoints is None:
            # The anchor is turned about x, y and z, both ways, by growing angles. The twist of a
            # turn has the rotation vector (rad) in its first three numbers. Not all are returned.
            angles = 0.2 * np.arange(1, self.settings.n_restarts)  # rad
            turns = product(angles, np.eye(6)[:3], (1, -1))
            starts = [anchor, *(retract(anchor, way * angle * axis) for angle, axis, way in turns)]
        else:
            starts = self._starts_by_views(frame, anchor, self.field.viewpoints)
        return starts[: self.settings.n_restarts] if len(self.trusted) else starts

    def _starts_by_views(self, frame: Frame, anchor: Pose, viewpoints: Viewpoints) -> list[Pose]:
        """Poses after a few steps from several starts, the pose with the lowest cost first.

        The starts are the anchor, the poses whose views are most similar to the frame's, and the
        cheapest ones of many random poses.
        """
        alike = retrieve(view_of(frame), viewpoints, _TRIED)
        random = [self.descent_from(T) for T in self._random_poses(viewpoints.T_world_camera)]
        tried = [self.descent_from(T) for T in (anchor, *alike)] + _by_cost(random)[:_TRIED]
        for descent in tried:
            descent.run_stage(max_steps=6)
        return [descent.T_world_camera for descent in _by_cost(tried)]

    def _random_poses(self, T_world_camera: Poses) -> Poses:
        """Random poses near known poses, turned by any angle about the vertical.

        The vertical is the mean of the known poses' y axes.
        """
        # The seed comes from the tracker's generator, so that a resumed run draws the same poses.
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=self.generator)))
        poses = T_world_camera[random.integers(len(T_world_camera), size=_RANDOM)]
        down = T_world_camera[:, :3, 1].mean(axis=0)
        turns = random.uniform(0, 2 * np.pi, (_RANDOM, 1)) * down / np.linalg.norm(down)
        poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += random.normal(scale=0.3, size=(_RANDOM, 3))  # m
        return poses


def _by_cost(descents: list[LmOptimizer]) -> list[LmOptimizer]:
    """Descents in the order of their robust costs at `_WIDE_SCALES`, the lowest first."""
    return sorted(descents, key=lambda descent: descent.cost(_WIDE_SCALES))


def _apart(T_first: Pose | Poses, T_second: Pose) -> np.ndarray:
    """The distance of poses from another pose: about the larger of angle (rad) and offset (m)."""
    return np.abs(np.linalg.inv(T_first) @ T_second - np.eye(4)).max(axis=(-2, -1))
