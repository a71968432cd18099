"""The second-order tracker, in a box whose distance is exact."""

import numpy as np
import pytest
import torch
from box_room import BoxRoom, box_sequence, narrow_room, walk
from torch import Tensor

from nbtrack.data.frame import Frame
from nbtrack.tracking import LmSettings, LmTracker, StepBudget
from nbtrack.tracking.metrics import pose_errors
from nbtrack.tracking.registration import Residuals, damped_step, moved

FRAME, T_TRUE = walk(1, narrow_room(), 48)[0], torch.eye(4)


def begun(**settings: float) -> LmTracker:
    return LmTracker(narrow_room(), np.eye(4), StepBudget(1), LmSettings(**settings))


def run(tracker: LmTracker, T_start: Tensor, steps: int, frame: Frame = FRAME) -> bool:
    """Whether the tracker then says that it is lost."""
    tracker.begin(frame, T_start[None])
    while not tracker.is_converged and steps:
        tracker.step()
        steps -= 1
    return tracker.report()["lost"]


def errors(tracker: LmTracker) -> tuple[float, float]:
    """Of the position (m) and of the orientation (degrees)."""
    found = tracker.T_world_camera.double().numpy()[None]
    (error_m,), (error_deg,) = pose_errors(found, np.eye(4)[None])
    return error_m, error_deg


@pytest.mark.parametrize("seed", range(12))
def test_every_start_in_the_basin_reaches_the_true_pose(seed: int) -> None:
    """Catches wrong steps, a basin that got smaller, and a bias: the distance here is exact.

    The stated basin: 20 cm and 12 degrees, in any direction, within 40 steps.
    """
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    twist = torch.cat([np.radians(12) * directions[0], 0.2 * directions[1]])
    tracker = begun()
    assert not run(tracker, moved(T_TRUE, twist), 40)
    assert errors(tracker)[0] < 0.002  # depths are whole millimetres
    assert errors(tracker)[1] < 0.05


def test_a_rejected_step_leaves_the_pose_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches steps that are taken although the cost rises: here every step is a bad one."""
    tracker = begun()
    tracker.begin(FRAME, T_TRUE[None])
    bad = torch.tensor([0.3, 0.0, 0.0, 0.5, 0.0, 0.0], dtype=torch.float64)
    monkeypatch.setattr("nbtrack.tracking.registration.damped_step", lambda *arguments: bad)
    damping = tracker.search.damping
    tracker.step()
    torch.testing.assert_close(tracker.T_world_camera.float(), T_TRUE, atol=1e-6, rtol=0)
    assert tracker.search.damping > damping


def test_in_a_corridor_the_axis_is_flagged_and_the_pose_stays() -> None:
    """Catches a pose that slides along what nothing holds, and a condition that hides it."""
    corridor = BoxRoom(half=(1.0, 1.0, 50.0), contrast=0.0)
    sequence = box_sequence([[0.0, 0.0, 0.0]], corridor, 72)
    sequence.depths_mm[sequence.depths_mm > 5000] = 0  # the open end is not measured
    tracker = LmTracker(corridor, np.eye(4), StepBudget(1))
    offset = torch.tensor([0.02, 0.0, 0.03, 0.03, -0.02, 0.05])
    assert run(tracker, moved(T_TRUE, offset), 40, sequence[0])
    position = tracker.T_world_camera[:3, 3]
    assert position[:2].abs().max() < 2e-3
    assert position[2].item() == pytest.approx(0.05, abs=5e-3)  # where the search started
    assert tracker.report()["condition_number"] > 1e4


def test_a_hopeless_start_is_followed_by_restarts_from_the_last_good_pose() -> None:
    """Catches a run that one bad burst ends, resumed or not: the motion model points astray."""
    before, alone, resumed = begun(), begun(n_restarts=0), begun()
    assert not run(before, T_TRUE, 20)
    turned = moved(T_TRUE, torch.tensor([0.0, 1.2, 0.5, 0.3, 0.2, 0.5]))
    assert run(alone, turned, 200)
    assert errors(alone)[0] > 0.2
    resumed.restore(before.state())
    assert not run(resumed, turned, 200)
    assert errors(resumed)[0] < 0.01


def test_the_pull_goes_back_to_the_start() -> None:
    """Catches a pull that enters the curvature alone: where the frame says nothing, a step must
    undo turn and offset from the start of the search, but for the sine of the angle."""
    turn, offset = torch.tensor([0.0, 0.0, 0.2]), torch.tensor([0.1, -0.3, 0.0])
    T_start = torch.eye(4, dtype=torch.float64)
    T_there = moved(T_start, torch.cat([turn, offset]).double())
    nothing = Residuals(torch.zeros(2, 1), torch.zeros(2, 1, 6), torch.zeros(1))
    found = damped_step(nothing, torch.ones(2), 1.0, T_start, T_there, 0.0)
    torch.testing.assert_close(found.float(), -torch.cat([turn.sin(), offset]))
