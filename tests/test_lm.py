"""The second-order tracker, in rooms whose distance is exact."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import PRESETS
from nbtrack.core.geometry import rotation_angle, rotation_vector_to_matrix
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.synthetic import build_room, render_frame
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.registration import moved
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers.lm import LevenbergMarquardtTracker

CONFIG = PRESETS["smoke"].tracking["lm"]


class ExactRoom(Field):
    """A synthetic room's exact distance, with a smooth colour that is known everywhere."""

    name, label, surface_level = "exact", "exact", 0.0

    def __init__(self, name: str) -> None:
        self.room = build_room(name)
        low, high = self.room.bounds
        super().__init__(SceneBounds(tuple(low.tolist()), tuple(high.tolist())))

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        sdf = _ExactDistance.apply(points_world, self.room)
        return color_at(points_world), sdf


class _ExactDistance(torch.autograd.Function):
    """The room's distance; its gradient by central differences."""

    @staticmethod
    def forward(context, points, room):
        exact = points.detach().double().numpy()
        offsets = 1e-5 * np.concatenate([np.eye(3), -np.eye(3)])
        around = room.sdf((exact + offsets[:, None]).reshape(-1, 3)).reshape(6, -1)
        gradient = (around[:3] - around[3:]).T / 2e-5
        context.save_for_backward(torch.from_numpy(gradient).to(points))
        return torch.from_numpy(room.sdf(exact)).to(points)

    @staticmethod
    def backward(context, grad):
        return grad[:, None] * context.saved_tensors[0], None


def color_at(points_world: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return 0.5 + 0.2 * torch.sin(3 * points_world)


class Corridor(Field):
    """Four endless grey walls along y, 2 m apart: nothing says where along y one is."""

    name, label, surface_level = "corridor", "corridor", 0.0

    def __init__(self) -> None:
        super().__init__(SceneBounds((-1.1, -50.0, -1.1), (1.1, 50.0, 1.1)))

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        sdf = 1 - points_world[:, [0, 2]].abs().amax(dim=-1)
        return 0.5 + 0 * points_world, sdf


@cache
def furnished() -> tuple[ExactRoom, RgbdSequence]:
    """The living room from three poses of one hand-held stretch; colours as `color_at` says."""
    field, intrinsics = ExactRoom("living_room"), Intrinsics.from_focal(64, 48, 40.0)
    poses, colors, depths = [], [], []
    position = np.array(field.bounds.center)
    for turn in (2.8, 2.82, 2.84):
        rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        T = np.eye(4)
        T[:3, :3] = rotation_about_up(turn) @ rotation
        T[:3, 3] = position
        _, depth, _ = render_frame(field.room, intrinsics, T)
        rows, columns = np.indices(depth.shape)
        x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx * depth
        y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy * depth
        points = np.stack([x, y, depth], -1).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        color = color_at(torch.from_numpy(points)).numpy().reshape(*depth.shape, 3)
        poses.append(T)
        colors.append((255 * color).round().astype(np.uint8))
        depths.append((1000 * depth).round().astype(np.uint16))
    return field, RgbdSequence(
        "living_room", intrinsics, np.stack(colors), np.stack(depths), np.stack(poses),
        np.arange(3),
    )  # fmt: skip


def rotation_about_up(angle: float) -> Float[np.ndarray, "3 3"]:
    return rotation_vector_to_matrix(torch.tensor([0.0, 0.0, angle])).double().numpy()


def tracker_in(
    field: Field, sequence: RgbdSequence, **settings: float
) -> LevenbergMarquardtTracker:
    sampler = PixelSampler(sequence, torch.device("cpu"))
    config = replace(CONFIG, **settings)
    return LevenbergMarquardtTracker(field, sampler, config, torch.Generator().manual_seed(0))


def run(tracker: LevenbergMarquardtTracker, T_start: Float[Tensor, "4 4"], steps: int) -> None:
    tracker.start_frame(0, T_start[None])
    for _ in range(steps):
        if tracker.is_converged:
            return
        tracker.step()


def errors(T: Float[Tensor, "4 4"], T_true: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    T, true = T.double(), torch.from_numpy(T_true)
    turn = rotation_angle(true[:3, :3].T @ T[:3, :3])
    return float((T[:3, 3] - true[:3, 3]).norm()), float(turn.rad2deg())


@pytest.mark.parametrize("seed", range(12))
def test_every_start_in_the_basin_reaches_the_true_pose(seed: int) -> None:
    """Catches wrong steps, a basin that got smaller, and a bias: the distance here is exact.

    The stated basin: 20 cm and 12 degrees, in any direction, within 40 steps.
    """
    field, sequence = furnished()
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    twist = torch.cat([np.radians(12) * directions[0], 0.2 * directions[1]])
    T_true = sequence.T_world_camera[0]
    tracker = tracker_in(field, sequence)
    run(tracker, moved(torch.from_numpy(T_true).float(), twist), 40)
    position_error, rotation_error = errors(tracker.T_world_camera, T_true)
    # Depths are whole millimetres, and sliding along the room is only weakly held.
    assert position_error < 0.005
    assert rotation_error < 0.05
    assert tracker.report()["lost"] is False


def test_a_rejected_step_leaves_the_pose_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches steps that are taken although the cost rises: here every step is a bad one."""
    field, sequence = furnished()
    tracker = tracker_in(field, sequence)
    T_true = torch.from_numpy(sequence.T_world_camera[0]).float()
    tracker.start_frame(0, T_true[None])
    bad = torch.tensor([0.3, 0.0, 0.0, 0.5, 0.0, 0.0], dtype=torch.float64)
    monkeypatch.setattr("nbtrack.tracking.trackers.lm._damped_step", lambda *arguments: bad)
    damping = tracker.search.damping
    tracker.step()
    torch.testing.assert_close(tracker.T_world_camera, T_true, atol=1e-6, rtol=0)
    assert tracker.search.damping > damping


def test_costs_fall_from_step_to_step_at_equal_scales() -> None:
    """Catches an acceptance test on other points or scales than those of the step."""
    field, sequence = furnished()
    tracker = tracker_in(field, sequence)
    T_true = torch.from_numpy(sequence.T_world_camera[0]).float()
    tracker.start_frame(0, moved(T_true, torch.tensor([0.05, 0, 0, 0.1, 0, 0.0]))[None])
    widths = []
    while not tracker.is_converged:
        tracker.step()
        widths.append(float(tracker.search.scales.distance))
    assert widths == sorted(widths, reverse=True)
    assert len(widths) < 15


def test_in_a_corridor_the_axis_is_flagged_and_the_pose_stays() -> None:
    """Catches a pose that slides along what nothing holds, and a condition that hides it."""
    intrinsics = Intrinsics.from_focal(64, 48, 40.0)
    rows, columns = np.indices((48, 64))
    x, y = (columns + 0.5 - 32) / 40, (rows + 0.5 - 24) / 40
    depth = 1 / np.maximum(np.maximum(np.abs(x), np.abs(y)), 0.2)
    gray = np.full((1, 48, 64, 3), 128, np.uint8)
    # The camera looks along the world's y: x to the right, its y is the world's -z.
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    far = np.maximum(np.abs(x), np.abs(y)) < 0.2  # the open end is not measured
    depths = np.where(far, 0, (1000 * depth).round()).astype(np.uint16)[None]
    sequence = RgbdSequence("corridor", intrinsics, gray, depths, T[None], np.arange(1))
    tracker = tracker_in(Corridor(), sequence)
    offset = torch.tensor([0.02, 0.03, 0.0, 0.03, 0.05, -0.02])
    run(tracker, moved(torch.from_numpy(T).float(), offset), 40)
    found = tracker.T_world_camera
    assert found[[0, 2], 3].abs().max() < 2e-3
    assert found[1, 3].item() == pytest.approx(0.05, abs=5e-3)  # where the search started
    certainty = tracker.uncertainty()
    assert certainty.condition_number > 1e4
    assert certainty.weakest_twist[4].abs() > 0.99
    assert tracker.report()["lost"] is True


def test_a_frame_without_depth_keeps_the_start_and_is_flagged() -> None:
    """Catches a crash, a pose from nothing, and a blind frame that passes for a good one."""
    field, sequence = furnished()
    depths = sequence.depths_mm.copy()
    depths[1] = 0
    config = replace(CONFIG, motion_model="previous_pose")
    tracked = track_sequence(
        "lm", field, replace(sequence, depths_mm=depths), StepBudget(20), config
    )
    assert tracked.frames["lost"].tolist()[1:] == [True, False]
    np.testing.assert_allclose(tracked.T_estimated[1], tracked.T_estimated[0], atol=1e-6)
    assert tracked.frames["translation_error_m"].iloc[2] < 0.002


def test_a_hopeless_start_is_followed_by_restarts_from_the_last_good_pose() -> None:
    """Catches a run that one bad burst ends: here the motion model points into a corner."""
    field, sequence = furnished()
    tracker = tracker_in(field, sequence)
    T_true = torch.from_numpy(sequence.T_world_camera[0]).float()
    run(tracker, T_true, 20)
    assert tracker.report()["lost"] is False
    turned = moved(T_true, torch.tensor([0.0, 0.0, 2.5, 1.0, 0.5, 0.0]))
    alone = tracker_in(field, sequence, n_restarts=0)
    run(alone, turned, 200)
    assert errors(alone.T_world_camera, sequence.T_world_camera[0])[0] > 0.2
    assert alone.report()["lost"] is True
    run(tracker, turned, 200)
    assert errors(tracker.T_world_camera, sequence.T_world_camera[0])[0] < 0.01
    assert tracker.report()["lost"] is False


def test_the_state_carries_the_last_good_pose() -> None:
    """Catches a resumed run that restarts elsewhere than an uninterrupted one."""
    field, sequence = furnished()
    tracker, other = tracker_in(field, sequence), tracker_in(field, sequence)
    run(tracker, torch.from_numpy(sequence.T_world_camera[0]).float(), 20)
    tracker.report()
    other.restore(tracker.state())
    torch.testing.assert_close(other.last_good, tracker.last_good)
    assert torch.equal(other.generator.get_state(), tracker.generator.get_state())
