"""The second-order tracker, in rooms whose distance is exact."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.frame import Frame
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field
from nbtrack.synthetic import build_room, render_frame
from nbtrack.tracking import LmSettings, LmTracker, StepBudget, track_sequence
from nbtrack.tracking.metrics import pose_errors
from nbtrack.tracking.registration import moved

CAMERA = Intrinsics.from_focal(64, 48, 40.0)
ROWS, COLUMNS = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
DIRECTIONS = pixel_directions(CAMERA, COLUMNS, ROWS).double().numpy()


class ExactRoom(Field):
    """A synthetic room's exact distance, with a smooth colour that is known everywhere."""

    name, label, surface_level = "exact", "exact", 0.0

    def __init__(self, name: str) -> None:
        self.room = build_room(name)
        low, high = self.room.bounds
        super().__init__(SceneBounds(tuple(low.tolist()), tuple(high.tolist())))

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        return color_at(points_world), _ExactDistance.apply(points_world, self.room)


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


def color_at(points_world: Tensor) -> Tensor:
    return 0.5 + 0.2 * torch.sin(3 * points_world)


class Corridor(Field):
    """Four endless grey walls along y, 2 m apart: nothing says where along y one is."""

    name, label, surface_level = "corridor", "corridor", 0.0

    def __init__(self) -> None:
        super().__init__(SceneBounds((-1.1, -50.0, -1.1), (1.1, 50.0, 1.1)))

    def forward(self, points_world: Tensor) -> tuple[Tensor, Tensor]:
        sdf = 1 - points_world[:, [0, 2]].abs().amax(dim=-1)
        return 0.5 + 0 * points_world, sdf


@cache
def furnished() -> tuple[ExactRoom, RgbdSequence]:
    """The living room from three poses of one hand-held stretch; colours as `color_at` says."""
    field, ahead = ExactRoom("living_room"), np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", [[2.8], [2.82], [2.84]]).as_matrix() @ ahead
    poses[:, :3, 3] = field.bounds.center
    depths = np.stack([render_frame(field.room, CAMERA, T)[1] for T in poses])
    points = np.einsum("fij,fhwj->fhwi", poses[:, :3, :3], DIRECTIONS * depths[..., None])
    colors = 255 * color_at(torch.from_numpy(points + poses[0, :3, 3])).numpy()
    images = colors.round().astype(np.uint8), (1000 * depths).round().astype(np.uint16)
    return field, RgbdSequence("living_room", CAMERA, *images, poses, np.arange(3))


def begun(**settings: float) -> tuple[LmTracker, Frame, Tensor]:
    """A tracker in the furnished room, a frame, and its true pose."""
    field, sequence = furnished()
    T_true = torch.from_numpy(sequence.T_world_camera[0]).float()
    settings = LmSettings(**settings)
    tracker = LmTracker(field, sequence.T_world_camera[0], StepBudget(1), settings)
    return tracker, sequence[0], T_true


def run(tracker: LmTracker, frame: Frame, T_start: Tensor, steps: int) -> None:
    tracker.begin(frame, T_start[None])
    while not tracker.is_converged and steps:
        tracker.step()
        steps -= 1


def errors(tracker: LmTracker, T_true: Tensor) -> tuple[float, float]:
    """Of the position (m) and of the orientation (degrees)."""
    found, true = (T.double().numpy()[None] for T in (tracker.T_world_camera, T_true))
    (error_m,), (error_deg,) = pose_errors(found, true)
    return error_m, error_deg


@pytest.mark.parametrize("seed", range(12))
def test_every_start_in_the_basin_reaches_the_true_pose(seed: int) -> None:
    """Catches wrong steps, a basin that got smaller, and a bias: the distance here is exact.

    The stated basin: 20 cm and 12 degrees, in any direction, within 40 steps.
    """
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    twist = torch.cat([np.radians(12) * directions[0], 0.2 * directions[1]])
    tracker, frame, T_true = begun()
    run(tracker, frame, moved(T_true, twist), 40)
    position_error, rotation_error = errors(tracker, T_true)
    # Depths are whole millimetres, and sliding along the room is only weakly held.
    assert position_error < 0.005
    assert rotation_error < 0.05
    assert tracker.report()["lost"] is False


def test_a_rejected_step_leaves_the_pose_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches steps that are taken although the cost rises: here every step is a bad one."""
    tracker, frame, T_true = begun()
    tracker.begin(frame, T_true[None])
    bad = torch.tensor([0.3, 0.0, 0.0, 0.5, 0.0, 0.0], dtype=torch.float64)
    monkeypatch.setattr("nbtrack.tracking.lm._damped_step", lambda *arguments: bad)
    damping = tracker.searches[-1].damping
    tracker.step()
    torch.testing.assert_close(tracker.T_world_camera, T_true, atol=1e-6, rtol=0)
    assert tracker.searches[-1].damping > damping


def test_scales_fall_from_step_to_step() -> None:
    """Catches an acceptance test on other points or scales than those of the step."""
    tracker, frame, T_true = begun()
    tracker.begin(frame, moved(T_true, torch.tensor([0.05, 0, 0, 0.1, 0, 0.0]))[None])
    widths = []
    while not tracker.is_converged:
        tracker.step()
        widths.append(float(tracker.searches[-1].scales[0]))
    assert widths == sorted(widths, reverse=True)
    assert len(widths) < 15


def test_in_a_corridor_the_axis_is_flagged_and_the_pose_stays() -> None:
    """Catches a pose that slides along what nothing holds, and a condition that hides it."""
    across = np.abs(DIRECTIONS[..., :2]).max(axis=-1)
    # The open end is not measured.
    depth = np.where(across < 0.2, 0, 1000 / across.clip(0.2)).round().astype(np.int32)
    # The camera looks along the world's y: x to the right, its y is the world's -z.
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    gray = torch.full((48, 64, 3), 128, dtype=torch.uint8)
    tracker = LmTracker(Corridor(), T, StepBudget(1))
    offset = torch.tensor([0.02, 0.03, 0.0, 0.03, 0.05, -0.02])
    frame = Frame(CAMERA, gray, torch.from_numpy(depth))
    run(tracker, frame, moved(torch.from_numpy(T).float(), offset), 40)
    found = tracker.T_world_camera
    assert found[[0, 2], 3].abs().max() < 2e-3
    assert found[1, 3].item() == pytest.approx(0.05, abs=5e-3)  # where the search started
    assert tracker.report()["condition_number"] > 1e4
    assert tracker.report()["lost"] is True


def test_a_frame_without_depth_keeps_the_start_and_is_flagged() -> None:
    """Catches a crash, a pose from nothing, and a blind frame that passes for a good one."""
    field, sequence = furnished()
    depths = sequence.depths_mm.copy()
    depths[1] = 0
    tracker = LmTracker(field, np.eye(4), StepBudget(20), LmSettings(motion_model="previous_pose"))
    tracked = track_sequence(tracker, replace(sequence, depths_mm=depths))
    assert tracked.frames["lost"].tolist()[1:] == [True, False]
    np.testing.assert_allclose(tracked.T_estimated[1], tracked.T_estimated[0], atol=1e-6)
    assert tracked.frames["translation_error_m"].iloc[2] < 0.002


def test_a_hopeless_start_is_followed_by_restarts_from_the_last_good_pose() -> None:
    """Catches a run that one bad burst ends, resumed or not: the motion model points astray."""
    before, frame, T_true = begun()
    run(before, frame, T_true, 20)
    assert before.report()["lost"] is False
    turned = moved(T_true, torch.tensor([0.0, 0.0, 2.5, 1.0, 0.5, 0.0]))
    alone, resumed = begun(n_restarts=0)[0], begun()[0]
    run(alone, frame, turned, 200)
    assert errors(alone, T_true)[0] > 0.2
    assert alone.report()["lost"] is True
    resumed.restore(before.state())
    run(resumed, frame, turned, 200)
    assert errors(resumed, T_true)[0] < 0.01
    assert resumed.report()["lost"] is False
