"""LM: second-order steps on signed distance and colour at observed points."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from nbtrack.core.arrays import Poses, Transform
from nbtrack.core.progress import tell
from nbtrack.data.frame import Frame
from nbtrack.fields import Field
from nbtrack.fields.grid import BakedField
from nbtrack.tracking.registration import moved
from nbtrack.tracking.search import LmSettings, Search
from nbtrack.tracking.tracker import Tracker

_LEAST_POINTS = 20  # below, a frame says too little for six unknowns
# A search begins on some of the points, a share but so many, and ends on all of them: far from the
# pose the coarse answer is as good and costs less.
_COARSE_SHARE, _LEAST_COARSE = 8, 128
# Starts are compared by widely robust costs: narrow ones say the same of all that are off.
_WIDE_SCALES = 0.1, 0.2
_MOST_DEVIATION = 0.04  # m; a pose whose position is less certain is taken for lost
# With fewer inliers even a pose is lost to which the frame before led, within so much (m, rad).
_LEAST_INLIERS, _FOLLOWED = 0.6, 0.15
_RESTART_ANGLE = 0.2  # rad, about each axis both ways from the last good pose
# Where a map knows its cameras, a lost one is looked for at so many random poses, so far (m) from
# theirs; from the cheapest some steps are taken, before the cheapest of those are followed.
_GUESSES, _GUESS_SPREAD, _GLANCES, _GLANCE_STEPS = 1000, 0.3, 40, 6


class LmTracker(Tracker):
    """Levenberg-Marquardt on SE(3), on points drawn once a frame; knows when it is lost.

    A search that ends lost is followed by others, while the budget lasts: from the last good pose,
    then around it, or, where the map knows its own cameras, from random poses near theirs that fit
    the frame best after a few steps, which count as one. The first that is not lost counts; if all
    are, that from the motion model. A frame with too few points keeps the start that this gave.

    Source: Levenberg 1944, Marquardt 1963; residuals of the paper's Eq. 2; an answer of our own to
    its remark that SDF tracking with Adam needs more steps than 10 Hz allows.
    """

    name = "lm"
    Settings = LmSettings
    converges = True
    copes_without_depth = True
    remembers = ("last_good", "was_lost")
    last_good: Transform | None = None  # of the latest frame not taken for lost
    was_lost: bool = False  # in the frame before

    def __init__(self, field: Field, *arguments: Any, **settings: Any) -> None:
        super().__init__(field, *arguments, **settings)
        self.search_kind = search_kind(field)

    def begin(self, frame: Frame, T_starts: Float[Tensor, "starts 4 4"]) -> None:
        """Draw the frame's points; take up the search from the start that fits them best."""
        # A lost frame says little of where the next one starts.
        before = [self.last_good] if self.was_lost and self.last_good is not None else []
        T_starts = torch.stack([*T_starts.cpu().double(), *before])
        # Rounding gathers over thousands of frames: a Newton step towards the nearest rotation.
        R = T_starts.numpy()[:, :3, :3]
        R[:] = R @ (3 * np.eye(3) - R.swapaxes(1, 2) @ R) / 2
        self.T_kept, self.search, self.starts, self.verdict = T_starts[0], None, None, None
        self.anchor = T_starts[-1] if self.last_good is None else self.last_good
        points, luma = self.search_kind.draw(frame, self.settings.n_pixels, self.generator)
        self.is_converged = len(points) < _LEAST_POINTS
        if self.is_converged:
            return
        n = max(_LEAST_COARSE, len(points) // _COARSE_SHARE)
        normals = self.search_kind.normals(frame, points[:n])
        self.levels = (points[:n], luma[:n], normals), (points, luma, normals[:0])
        searches = [self._search_from(T_start) for T_start in T_starts]
        self.search = self.best = _by_cost(searches, _WIDE_SCALES)[0]
        self.was_followed = not self.was_lost

    def step(self) -> float:
        """One step of Levenberg-Marquardt, taken or refused; returns the cost before it."""
        if self.search is None:
            return float("nan")
        self.verdict = None if self.search is self.best else self.verdict
        before = self.search.step()
        if self.search.is_ended and self.search.level == 0:
            self.search.begin(1)
        elif self.search.is_ended:
            self._follow_up()
        return before

    @property
    def T_world_camera(self) -> Transform:
        """The estimate so far; without points, the first start."""
        return self.T_kept if self.search is None else torch.as_tensor(self.best.T_world_camera)

    def report(self) -> dict[str, float | bool]:
        """Inliers, deviations, condition number and verdict; a good pose is kept for restarts."""
        if self.search is None:
            self.verdict = {"inlier_ratio": 0.0, "lost": True}
        elif self.verdict is None:
            self.verdict = self._judge(self.best)
        self.was_lost = bool(self.verdict["lost"])
        if not self.was_lost:
            self.last_good = torch.as_tensor(self.best.T_world_camera)
        return self.verdict

    def _judge(self, search: Search) -> dict[str, float | bool]:
        """What a search says of its pose. One to which the frame before led needs fewer inliers."""
        found = search.certainty()
        moved_by = np.linalg.inv(np.asarray(search.start)) @ np.asarray(search.T_world_camera)
        is_near = np.abs(moved_by - np.eye(4)).max() < _FOLLOWED
        is_followed = self.was_followed and self.starts is None and is_near
        least = _LEAST_INLIERS if is_followed else self.field.least_inliers
        is_uncertain = found["position_deviation_m"] > _MOST_DEVIATION
        return {**found, "lost": found["inlier_ratio"] < least or is_uncertain}

    def _search_from(self, T_start: Transform) -> Search:
        return self.search_kind(self.field, self.levels, self.settings, T_start)

    def _follow_up(self) -> None:
        """Restart if a search has ended lost and another start is left; else the frame is done."""
        verdict = self._judge(self.search)
        if self.search is self.best or not verdict["lost"]:
            self.best, self.verdict = self.search, verdict
        if self.starts is None and verdict["lost"]:
            self.starts = self._other_starts()[: self.settings.n_restarts]
        self.is_converged = not verdict["lost"] or not self.starts
        if not self.is_converged:
            self.search = self._search_from(self.starts.pop(0))

    def _other_starts(self) -> list[Transform]:
        """Where else the camera may be, the likeliest first."""
        around = [_around(self.anchor, number) for number in range(self.settings.n_restarts)]
        cameras = getattr(self.field, "T_world_cameras", None)
        if cameras is None:
            return around
        guesses = [self._search_from(T) for T in self._guesses(cameras.cpu().double().numpy())]
        glances = _by_cost(guesses, _WIDE_SCALES)[:_GLANCES]
        for search in glances:
            for _ in range(_GLANCE_STEPS):
                search.step()
        glances = _by_cost(glances, _WIDE_SCALES)
        return around[:1] + [torch.as_tensor(search.T_world_camera) for search in glances]

    def _guesses(self, T_world_cameras: Poses) -> Float[Tensor, "_ 4 4"]:
        """Where else a camera may be: near the known ones, turned about the vertical they share."""
        seed = torch.randint(2**62, (), generator=self.generator, device=self.device)
        random = np.random.default_rng(int(seed))
        guesses = T_world_cameras[random.integers(len(T_world_cameras), size=_GUESSES)]
        down = T_world_cameras[:, :3, 1].mean(axis=0)
        turns = random.uniform(0, 2 * np.pi, (_GUESSES, 1)) * down / np.linalg.norm(down)
        guesses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix() @ guesses[:, :3, :3]
        guesses[:, :3, 3] += random.normal(scale=_GUESS_SPREAD, size=(_GUESSES, 3))
        return torch.from_numpy(guesses)


def search_kind(field: Field) -> type[Search]:
    """The compiled search for a grid on the host, where numba works; else that of torch."""
    if not isinstance(field, BakedField) or field.device.type != "cpu":
        return Search
    try:
        from nbtrack.tracking.compiled import CompiledSearch
    except (ImportError, RuntimeError) as error:
        tell(f"nbtrack: numba does not work here ({error}): tracking takes some ten times longer")
        return Search
    return CompiledSearch


def _by_cost(searches: Sequence[Search], scales: tuple[float, float]) -> list[Search]:
    """Searches in the order of their robust costs, all at equal scales."""
    return sorted(searches, key=lambda search: search.cost(scales)) if searches[1:] else [*searches]


def _around(T_world_camera: Transform, number: int) -> Transform:
    """The start of a restart: a pose itself, then turned about x, y and z both ways, and wider."""
    turn = torch.zeros(6).to(T_world_camera)
    if number > 0:
        round_, which = divmod(number - 1, 6)
        axis, way = divmod(which, 2)
        turn[axis] = (1 + round_) * _RESTART_ANGLE * (1 - 2 * way)
    return moved(T_world_camera, turn)
