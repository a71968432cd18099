"""The second-order tracker, in a box whose distance is exact."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import box_sequence, narrow_room, poses_at, sequence_of

from nbtrack import Field, Frame
from nbtrack.beyond.grid import Accuracy, BakedField
from nbtrack.beyond.lm import LmSettings, LmTracker
from nbtrack.beyond.lm_solver import retract
from nbtrack.beyond.views import Viewpoints, view_of
from nbtrack.core.camera import Intrinsics
from nbtrack.tracking import StepBudget
from nbtrack.tracking.metrics import pose_errors

(T_TRUE,) = poses_at([[0.05, -0.03, 0.1]], [0.1, -0.2, 0.05])  # in no axis of the world
FRAME = box_sequence(T_TRUE[None], narrow_room(), 48)[0]
ROOM = BakedField(narrow_room(), 0.04)
# Off by less than makes an outlier of a point.
BLENDED = FRAME.color // 4 * 3 + FRAME.color.flip(1) // 4
FAR = np.array([0.0, 1.2, 0.5, 0.3, 0.2, 0.5])  # rad, m: a start that leads nowhere


def begun(field: Field = ROOM, **settings: float) -> LmTracker:
    return LmTracker(field, T_TRUE, StepBudget(1), LmSettings(**settings))


def run(tracker: LmTracker, T_start: np.ndarray, steps: int, frame: Frame = FRAME) -> bool:
    """Whether the tracker then says that it is lost."""
    tracker.estimates = [T_start]
    return tracker.track(frame, StepBudget(steps)).lost


def errors(tracker: LmTracker) -> tuple[float, float]:
    """Of the position (m) and of the orientation (degrees)."""
    found = tracker.T_world_camera.double().numpy()[None]
    (error_m,), (error_deg,) = pose_errors(found, T_TRUE[None])
    return error_m, error_deg


@pytest.mark.parametrize("seed", range(8))
def test_every_start_in_the_basin_reaches_the_true_pose(seed: int) -> None:
    """Catches wrong steps, a basin that got smaller, and a bias: the distance here is exact.

    The stated basin: 20 cm and 12 degrees, in any direction, within 40 steps.
    """
    directions = np.random.default_rng(seed).normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    twist = np.concatenate([np.radians(12) * directions[0], 0.2 * directions[1]])
    tracker = begun()
    assert not run(tracker, retract(T_TRUE, twist), 40)
    assert errors(tracker)[0] < 0.002  # depths are whole millimetres
    assert errors(tracker)[1] < 0.05


def test_depth_with_rows_missing_is_searched_too() -> None:
    """Catches a camera whose every pixel lacks a neighbour's depth, as if it saw nothing."""
    depth_mm = FRAME.depth_mm.clone()
    depth_mm[::2] = 0
    tracker = begun()
    assert not run(tracker, retract(T_TRUE, FAR / 10), 40, replace(FRAME, depth_mm=depth_mm))
    assert errors(tracker)[0] < 0.005


@pytest.mark.parametrize("twist", [np.zeros(6), FAR], ids=["near", "restarted"])
def test_without_colour_no_picture_counts(twist: np.ndarray) -> None:
    """Catches intensities that choose between starts, stages or restarts, or that make a verdict,
    where their weight is 0: of an inverted and a dark picture everything must be the same."""
    results = []
    for color in (FRAME.color, 255 - FRAME.color, FRAME.color // 50):
        tracker, frame = begun(lambda_intensity=0.0), replace(FRAME, color=color)
        assert not run(tracker, T_TRUE, 20, frame)
        run(tracker, retract(T_TRUE, twist), 200, frame)
        results.append((tracker.T_world_camera.tolist(), tracker.report()))
    assert results[0] == results[1] == results[2]


def test_a_hopeless_start_is_followed_by_restarts_from_the_last_good_pose() -> None:
    """Catches a run that one bad burst ends, resumed or not: the motion model points astray; and a
    last good pose, or being lost, that outlives a restart elsewhere: what a subclass says that it
    remembers is reset without its doing."""
    before, alone, resumed = begun(), begun(n_restarts=0), begun()
    assert not run(before, T_TRUE, 20)
    assert not run(alone, T_TRUE, 20)
    turned = retract(T_TRUE, FAR)
    assert run(alone, turned, 200)
    assert errors(alone)[0] > 0.2
    resumed.restore(before.state())
    assert not run(resumed, turned, 200)
    assert errors(resumed)[0] < 0.01
    assert (alone.was_lost, alone.last_good is None) == (True, False)
    alone.restart(T_TRUE)
    assert (alone.was_lost, alone.last_good) == (False, None)


def test_a_field_is_asked_on_a_grid_of_the_voxel_that_is_set() -> None:
    """Catches a setting without effect, and a grid, perhaps corrected, that is sampled again."""
    assert torch.equal(begun().field.volume, ROOM.volume)
    tracker = begun(narrow_room(), voxel=0.1)
    assert isinstance(tracker.field, BakedField)
    assert tracker.field.voxel == 0.1


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 5), (3, 2)])
def test_images_without_an_inside_are_lost_frames(size: tuple[int, int]) -> None:
    """Catches pixels drawn beside the image, where every one is at its border."""
    camera = Intrinsics(size[1], size[0], 2.0, 2.0, size[1] / 2, size[0] / 2)
    estimate = begun().track(sequence_of(np.full((1, *size), 1000.0), camera)[0])
    assert estimate.lost
    np.testing.assert_allclose(estimate.T_world_camera, T_TRUE, atol=1e-12)


def test_a_fast_camera_that_stops_is_found() -> None:
    """Catches a start that is chosen by its cost alone, where the motion model is half a metre
    ahead of a camera that has stopped: coarse stages from both starts tell them apart; and a pose
    that counts as unexpected because of the other start."""
    tracker = begun(n_restarts=0)
    ahead = retract(T_TRUE, np.array([0.0, 0.5, 0.0, 0.3, 0.0, 0.5]))
    tracker.begin(FRAME, torch.from_numpy(np.stack([ahead, T_TRUE])))
    np.testing.assert_allclose(tracker.best.problem.T_start, T_TRUE, atol=1e-12)
    assert errors(tracker)[0] < 0.01
    assert tracker.report()["innovation"] < 0.01


def test_a_pose_that_still_moves_when_the_budget_ends_is_lost() -> None:
    """Catches a pose on its way along a wall that passes for found: most points fit on the wall."""
    offset, tracker = retract(T_TRUE, np.array([0.0, 0.05, 0.0, 0.1, 0.05, 0.1])), begun()
    assert run(tracker, offset, 1)
    assert tracker.report()["last_step"] > 0.01
    assert not run(begun(), offset, 40)


def test_intensities_speak_against_a_pose_by_what_is_usual(monkeypatch) -> None:
    """Catches a pose on a surface that the map made up: points fit there, but intensities are off
    by several times what is usual in the map; and a dark picture that is taken for one."""
    told = {}
    for usual_mad in (0.002, 0.02):
        monkeypatch.setattr(ROOM, "accuracy", Accuracy(intensity_mad=usual_mad))
        for name, color in {"same": FRAME.color, "blended": BLENDED, "dark": 0 * BLENDED}.items():
            tracker = begun(n_restarts=0, lambda_intensity=1e-6)  # which no pose follows
            run(tracker, T_TRUE, 20, replace(FRAME, color=color))
            told[name, usual_mad] = tracker.report()["p_lost"]
    assert told["blended", 0.002] > 4 * told["blended", 0.02]
    assert told["blended", 0.002] > 4 * told["same", 0.002]
    assert told["dark", 0.002] < 0.01


def test_a_lost_camera_is_looked_for_at_its_last_good_pose_too() -> None:
    """Catches a camera that stood still, lost for good: hypotheses lie near mapped poses alone."""
    field = BakedField(narrow_room(), 0.04)
    T_mapped = retract(T_TRUE, np.array([0, 0, 0, 5.0, 5, 5]))
    field.viewpoints = Viewpoints(T_mapped[None], view_of(FRAME)[None])
    tracker = begun(field)
    assert not run(tracker, T_TRUE, 20)
    assert not run(tracker, retract(T_TRUE, FAR), 60)
    assert errors(tracker)[0] < 0.01


def test_a_doubtful_pose_is_confirmed_or_others_are_tried() -> None:
    """Catches descents that go on although one has confirmed a doubtful pose, or end although none
    has: something stands before most of the walls, so that the search ends half a metre astray."""
    further = {}
    for columns in (40, 36):
        depth_mm, steps = FRAME.depth_mm.clone(), []
        depth_mm[:, :columns] = (0.7 * depth_mm[:, :columns]).to(depth_mm.dtype)
        for n_restarts in (0, 8):
            seen = replace(FRAME, depth_mm=depth_mm)
            steps.append(begun(n_restarts=n_restarts).track(seen, StepBudget(60)).steps)
        further[columns] = steps[1] - steps[0]
    assert further == {40: 1, 36: 8}


def test_hypotheses_stand_upright() -> None:
    """Catches random poses that are turned about another axis than the vertical, or about the
    camera's own: how far a camera is pitched does not change, only where it looks."""
    found = begun()._random_poses(poses_at(np.zeros((2, 3)), [[0.4, 0.0, 0.0], [-0.4, 0.0, 0.0]]))
    np.testing.assert_allclose(found[:, 1, 1], np.cos(0.4))
    for axis in (1, 2):  # down and ahead, to either side
        assert len(np.unique(np.sign(found[:, 0, axis]))) == 2


def test_poses_keep_their_digits() -> None:
    """Catches double poses that pass through single precision at every frame, and a frame without
    depth of which the tracker says nothing."""
    T_start = retract(T_TRUE, np.array([0, 0, 0, 1 / 3, 1 / 7, -1 / 9]))
    blank = replace(FRAME, depth_mm=0 * FRAME.depth_mm)  # where nothing is seen the start stays
    estimate = LmTracker(ROOM, T_start, StepBudget(1)).track(blank)
    np.testing.assert_allclose(estimate.T_world_camera, T_start, rtol=0, atol=1e-15)
    assert estimate.report == {"inlier_ratio": 0.0, "p_lost": 1.0, "lost": True}
