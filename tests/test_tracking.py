"""The two trackers and their loop, in fields whose answers are known exactly."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.core.config import TrackingConfig
from nbtrack.core.errors import ConfigError, DataError, NumericalError
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.base import LearnedField
from nbtrack.fields.rendering import Rendering, composite, weights_from_density, weights_from_sdf
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.motion_models import motion_model
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers import TRACKERS, tracker_class

HALF = torch.tensor([1.0, 0.8, 1.2])  # half sides of the room, m
SHIFT = 0.03  # m behind the wall at which the density is half its largest


class BoxRoom(LearnedField):
    """The inside of a box with smoothly coloured walls; as a distance or as a steep density."""

    name, label, surface_level = "box", "box", 0.0

    def __init__(self, as_density: bool) -> None:
        super().__init__(SceneBounds((-1.1, -0.9, -1.3), (1.1, 0.9, 1.3)))
        self.as_density = as_density
        self.weight = torch.nn.Parameter(torch.zeros(8))

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        color = 0.5 + 0.4 * torch.sin(3 * points_world)
        sdf = (HALF - points_world.abs()).amin(dim=-1)
        # Light goes out at the wall on average: the shift was solved for numerically.
        return color, 150 * torch.sigmoid((-sdf - SHIFT) / 0.02) if self.as_density else sdf

    def composite(
        self,
        colors: Float[Tensor, "rays samples 3"],
        values: Float[Tensor, "rays samples"],
        rays: Rays,
        depths: Float[Tensor, "rays samples"],
    ) -> Rendering:
        if self.as_density:
            lengths = rays.directions_world.norm(dim=-1)
            return composite(weights_from_density(values, depths, lengths), colors, depths)
        weights = weights_from_sdf(values, torch.tensor(100.0))
        return composite(weights, colors[:, 1:], depths[:, 1:])

    def mapping_losses(self, *arguments: object) -> dict[str, Float[Tensor, ""]]:
        raise NotImplementedError


def box_sequence(offsets: list[list[float]]) -> RgbdSequence:
    """Exact images of the box room from cameras at offsets (m) from the middle, not rotated."""
    intrinsics = Intrinsics.from_focal(32, 24, 24.0)
    rows, columns = torch.meshgrid(torch.arange(24), torch.arange(32), indexing="ij")
    directions = pixel_directions(intrinsics, columns, rows)
    poses = np.tile(np.eye(4), (len(offsets), 1, 1))
    poses[:, :3, 3] = offsets
    colors, depths = [], []
    for offset in torch.tensor(offsets, dtype=torch.float32):
        depth = ((HALF * directions.sign() - offset) / directions).amin(dim=-1)
        points = offset + depth[..., None] * directions
        colors.append((255 * (0.5 + 0.4 * torch.sin(3 * points))).round().byte().numpy())
        depths.append((1000 * depth).round().short().numpy().astype(np.uint16))
    return RgbdSequence(
        "box", intrinsics, np.stack(colors), np.stack(depths), poses, np.arange(len(offsets))
    )


def config_of(name: str) -> TrackingConfig:
    """Few pixels, the paper's learning rates."""
    return TrackingConfig(n_pixels=256, lambda_color=5.0 if name == "vr" else 0.1)


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_step_reduces_a_known_offset(name: str) -> None:
    """Catches a gradient with the wrong sign: from 2 cm off, 60 steps must halve the error."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.02, -0.01, 0.015]])
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    tracked = track_sequence(name, field, sequence, StepBudget(60), config_of(name))
    start = np.linalg.norm([0.02, -0.01, 0.015])
    assert tracked.frames["translation_error_m"].iloc[1] < start / 2
    assert tracked.frames["rotation_error_deg"].iloc[1] < 1.0
    assert tracked.frames["steps"].tolist() == [0, 60]


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_no_offset_stays_put(name: str) -> None:
    """Catches drift: at the true pose, noise of random pixels may move it by millimetres only."""
    sequence = box_sequence([[0.1, 0.0, -0.1]] * 2)
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    tracked = track_sequence(name, field, sequence, StepBudget(20), config_of(name))
    assert tracked.frames["translation_error_m"].iloc[1] < 0.008
    assert tracked.frames["rotation_error_deg"].iloc[1] < 0.5


def test_one_step_of_adam_moves_by_the_learning_rates() -> None:
    """Catches swapped or scaled rates: Adam's first step is the rate, in each coordinate."""
    sequence = box_sequence([[0.05, 0.04, 0.03]] * 2)
    sampler = PixelSampler(sequence, torch.device("cpu"))
    tracker = tracker_class("sdf")(
        BoxRoom(as_density=False).requires_grad_(False), sampler, config_of("sdf"),
        torch.Generator().manual_seed(0),
    )  # fmt: skip
    tracker.start_frame(0, torch.eye(4)[None])
    tracker.step()
    assert tracker.position.detach().abs().tolist() == pytest.approx([5e-4] * 3, rel=1e-3)
    assert tracker.q_wxyz.detach()[1:].abs().tolist() == pytest.approx([1e-3] * 3, rel=1e-2)
    assert tracker.q_wxyz.norm().item() == pytest.approx(1.0, abs=1e-6)


def test_new_pixels_every_step() -> None:
    """Catches a loss on fixed pixels: two steps from one pose must see different ones."""
    sequence = box_sequence([[0.0, 0.0, 0.0]] * 2)
    sampler = PixelSampler(sequence, torch.device("cpu"))
    tracker = tracker_class("sdf")(
        BoxRoom(as_density=False), sampler, config_of("sdf"), torch.Generator().manual_seed(0)
    )
    seen = []
    tracker.loss = lambda T, rows, columns: seen.append((rows.clone(), columns.clone())) or T.sum()
    tracker.start_frame(0, torch.eye(4)[None])
    tracker.step()
    tracker.step()
    assert not torch.equal(seen[0][0], seen[1][0])
    assert len(seen[0][0]) == 256


def test_each_frame_starts_from_the_previous_estimate() -> None:
    """Catches a start from the truth: without steps, all estimates are the first pose."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    tracked = track_sequence(
        "sdf", BoxRoom(as_density=False), sequence, StepBudget(0.1), config_of("sdf")
    )
    assert tracked.frames["steps"].sum() == 0
    assert np.allclose(tracked.T_estimated, np.eye(4), atol=1e-7)
    assert tracked.frames["translation_error_m"].tolist() == pytest.approx([0, 0.1, 0.2])


def test_constant_velocity_starts_where_the_camera_would_be() -> None:
    """Catches a motion model that is named in the settings and not used: no step, no error."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    moved = [np.eye(4), *sequence.T_world_camera[[0, 2]]]
    config = replace(config_of("sdf"), motion_model="constant_velocity")
    assert np.allclose(motion_model(config.motion_model)(moved)[0][:3, 3], [0.2, 0.0, 0.0])
    still = track_sequence("sdf", BoxRoom(False), sequence, StepBudget(0.1), config)
    assert np.allclose(still.T_estimated, np.eye(4), atol=1e-7)
    unknown = replace(config, motion_model="none")
    with pytest.raises(ConfigError, match="unknown motion model 'none'"):
        track_sequence("sdf", BoxRoom(False), sequence, StepBudget(1), unknown)


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_killed_run_goes_on_as_if_it_had_not_stopped(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches pixels drawn twice, a budget that forgets its fractions, frames done again."""
    sequence = box_sequence([[0.004 * i, 0.0, 0.002 * i] for i in range(6)])
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    whole = track_sequence(name, field, sequence, StepBudget(2.4), config_of(name))
    monkeypatch.setattr("nbtrack.tracking.sequence.CHECKPOINT_SECONDS", 0.0)
    checkpoint, frames = tmp_path / "run.pt", []

    def die_at_four(frame: int, error: float) -> None:
        frames.append(frame)
        if len(frames) == 4:
            raise KeyboardInterrupt

    run = partial(track_sequence, name, field, sequence, checkpoint=checkpoint)
    with pytest.raises(KeyboardInterrupt):
        run(StepBudget(2.4), config_of(name), on_frame=die_at_four)
    resumed = run(StepBudget(2.4), config_of(name), on_frame=lambda f, e: frames.append(f))
    # Frame 4 was done, but not kept: it is the only one that is done again.
    assert frames == [1, 2, 3, 4, 4, 5]
    np.testing.assert_array_equal(resumed.T_estimated, whole.T_estimated)
    kept = ["steps", "loss", "translation_error_m"]
    pd.testing.assert_frame_equal(resumed.frames[kept], whole.frames[kept])


def test_seeds() -> None:
    """Catches hidden randomness: one seed, one trajectory; another seed, another."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])

    def run(seed: int) -> np.ndarray:
        field = BoxRoom(as_density=False).requires_grad_(False)
        return track_sequence(
            "sdf", field, sequence, StepBudget(5), config_of("sdf"), seed
        ).T_estimated

    assert np.array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_errors_name_the_frame() -> None:
    """Catches tracking on nothing and poses that are not numbers."""
    sequence = box_sequence([[0.0, 0.0, 0.0]] * 3)
    field = BoxRoom(as_density=False)
    with pytest.raises(DataError, match="too short to track"):
        track_sequence("sdf", field, sequence.select(slice(1)), StepBudget(1), config_of("sdf"))
    with pytest.raises(ConfigError, match="unknown tracker 'sfd': did you mean 'sdf'"):
        track_sequence("sfd", field, sequence, StepBudget(1), config_of("sdf"))
    field.forward = lambda points: (points * float("nan"), points[:, 0] * float("nan"))
    with pytest.raises(NumericalError, match="frame 1 of box"):
        track_sequence("sdf", field, sequence, StepBudget(2), config_of("sdf"))
    sequence.depths_mm[:] = 0
    with pytest.raises(DataError, match="no frame of box has a measured depth"):
        track_sequence("sdf", BoxRoom(as_density=False), sequence, StepBudget(1), config_of("sdf"))


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_frame_without_depth_keeps_the_expected_pose_and_is_marked(name: str) -> None:
    """Catches a run that one blind frame ends, a pose from nothing, and NaN in the results."""
    sequence = box_sequence([[0.003 * i, 0.0, 0.0] for i in range(5)])
    sequence.depths_mm[[0, 2]] = 0
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    tracked = track_sequence(name, field, sequence, StepBudget(20), config_of(name))
    assert tracked.frames["without_depth"].tolist() == [True, False, True, False, False]
    assert tracked.frames["steps"].tolist() == [0, 20, 0, 20, 20]
    np.testing.assert_array_equal(tracked.T_estimated[2], tracked.T_estimated[1])
    assert np.isfinite(tracked.T_estimated).all()
    assert tracked.frames["translation_error_m"].iloc[4] < 0.01


def test_registry_holds_the_papers_methods() -> None:
    """Catches a lost registration, or an order of rows that is not the paper's."""
    labels = [tracker.label for tracker in TRACKERS.values()]
    assert labels[:2] == ["iMAP with VR", "NeuS with SDF"]
