"""The tracker as a library: one image after another, sound or not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_lm import furnished
from test_tracking import BoxRoom, box_sequence, config_of

from nbtrack.core.config import PRESETS, TrackingConfig
from nbtrack.core.errors import ConfigError, DataError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields.grid import bake_field
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.live import LiveTracker
from nbtrack.tracking.sequence import track_sequence

LM = replace(PRESETS["paper"].tracking["lm"], n_restarts=2)


def walk(n_frames: int = 6) -> RgbdSequence:
    """A camera that moves by 6 mm a frame in the box."""
    return box_sequence([[0.006 * i, 0.003 * i, 0.0] for i in range(n_frames)])


def live(sequence: RgbdSequence, name: str = "lm", **settings: object) -> LiveTracker:
    """A tracker at the sequence's first pose."""
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    settings = {"steps": 20, "config": LM if name == "lm" else config_of(name)} | settings
    return LiveTracker(field, sequence.intrinsics, sequence.T_world_camera[0], name, **settings)


def error_m(found: np.ndarray, sequence: RgbdSequence, index: int) -> float:
    return float(np.linalg.norm(found[:3, 3] - sequence.T_world_camera[index, :3, 3]))


@pytest.mark.parametrize("name", ["lm", "sdf", "vr"])
def test_the_same_poses_as_of_a_recording(name: str) -> None:
    """Catches a second loop that drifts away from the first one: poses are equal to the bit."""
    sequence = walk()
    config = LM if name == "lm" else config_of(name)
    field = BoxRoom(as_density=name == "vr").requires_grad_(False)
    recorded = track_sequence(name, field, sequence, StepBudget(5.5), config, seed=3)
    tracker = live(sequence, name, steps=5.5, seed=3)
    for index in range(1, len(sequence)):
        frame = tracker.track(sequence.colors[index], sequence.depths_mm[index])
        assert frame.steps == recorded.frames["steps"][index]
    np.testing.assert_array_equal(tracker.T_world_camera, recorded.T_estimated)


def test_units_and_types_are_what_they_say() -> None:
    """Catches metres taken for millimetres: both kinds of depth and colour give one pose."""
    sequence = walk(2)
    color, depth_mm = sequence.colors[1], sequence.depths_mm[1]
    kinds = [
        (color, depth_mm), (color, depth_mm / 1000), (color / 255, (depth_mm / 1000)),
        (color.astype(np.float32) / 255, (depth_mm / 1000).astype(np.float32)),
    ]  # fmt: skip
    poses = [live(sequence).track(*kind).T_world_camera for kind in kinds]
    for pose in poses[1:]:
        np.testing.assert_array_equal(pose, poses[0])
    read_only = color.copy()
    read_only.flags.writeable = False
    pose = live(sequence).track(read_only, depth_mm).T_world_camera
    np.testing.assert_array_equal(pose, poses[0])


WRONG_IMAGES = {
    "depth as integers": (lambda c, d: (c, d.astype(np.int32)), "depth is int32: give uint16"),
    "millimetres as float": (lambda c, d: (c, d.astype(float)), "floating point is in metres"),
    "colour as integers": (lambda c, d: (c.astype(np.int64), d), "color is int64: give uint8"),
    "colour to 255 as float": (lambda c, d: (c.astype(float), d), "floating point is in"),
    "grey": (lambda c, d: (c[..., 0], d), "color is of shape"),
    "alpha": (lambda c, d: (np.dstack([c, c[..., 0]]), d), "color is of shape"),
    "other size": (lambda c, d: (c, d[::2, ::2]), "depth is of shape (12, 16), but the camera"),
}


@pytest.mark.parametrize("case", WRONG_IMAGES)
def test_wrong_images_are_refused_and_tracking_goes_on(case: str) -> None:
    """Catches silent repair of units, and a tracker that a refused image leaves broken."""
    spoil, message = WRONG_IMAGES[case]
    sequence = walk(2)
    tracker = live(sequence)
    with pytest.raises(DataError) as raised:
        tracker.track(*spoil(sequence.colors[1], sequence.depths_mm[1]))
    assert message in str(raised.value)
    frame = tracker.track(sequence.colors[1], sequence.depths_mm[1])
    assert error_m(frame.T_world_camera, sequence, 1) < 0.005


def test_wrong_settings() -> None:
    """Catches two budgets, a pose that is none, and a tracker on a field it cannot work on."""
    sequence, field = walk(2), BoxRoom(as_density=False)
    place = (sequence.intrinsics, np.eye(4))
    with pytest.raises(ConfigError, match="one budget"):
        LiveTracker(field, *place, steps=3, rate_hz=10)
    with pytest.raises(ConfigError, match="did you mean 'sdf'"):
        LiveTracker(field, *place, tracker="sfd")
    with pytest.raises(DataError, match="no rigid transform"):
        LiveTracker(field, sequence.intrinsics, np.full((4, 4), np.nan))
    with pytest.raises(DataError, match="no rigid transform"):
        LiveTracker(field, sequence.intrinsics, np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(ConfigError, match="renders, which a baked field cannot"):
        LiveTracker(bake_field(field, 0.2), *place, tracker="vr")


def test_a_baked_field_and_a_restart() -> None:
    """Catches a grid that live tracking cannot ask, and velocities that outlive a restart."""
    sequence = walk(3)
    tracker = live(sequence, config=replace(LM, bake_voxel=0.05))
    for index in (1, 2):
        tracker.track(sequence.colors[index], sequence.depths_mm[index])
    tracker.restart(sequence.T_world_camera[1])
    frame = tracker.track(sequence.colors[2], sequence.depths_mm[2])
    assert error_m(frame.T_world_camera, sequence, 2) < 0.02
    assert len(tracker.T_world_camera) == 2


def exact_walk() -> tuple[torch.nn.Module, RgbdSequence]:
    """A furnished room with exact distances, and three frames in it, again and again."""
    field, sequence = furnished()
    return field, sequence.select(np.array([0, 1, 2, 1, 0, 1, 2, 1]))


def _blacken(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros_like(color), depth


def _whiten(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full_like(color, 255), depth


def _blind(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return color, np.zeros_like(depth)


def _nan_depth(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return color, np.full(depth.shape, np.nan)


def _nan_color(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full(color.shape, np.nan), depth


def _some_nan(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    color, depth = color / 255, depth / 1000
    color[::3], depth[:, ::4] = np.nan, np.nan
    depth[:, 1::8], depth[:, 2::16] = np.inf, -1.0
    return color, depth


def _occluded(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    color, depth = color.copy(), depth.copy()
    color[:, : color.shape[1] // 2], depth[:, : depth.shape[1] // 2] = 40, 450
    return color, depth


def _dropout(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    gone = np.random.default_rng(0).random(depth.shape) < 0.3
    return color, np.where(gone, np.uint16(0), depth)


def _noise(color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return color, np.random.default_rng(0).integers(300, 9000, depth.shape).astype(np.uint16)


LOST = 0.2  # m: the paper's rule of what counts as lost, and must not pass for good
# How the frame is spoilt, and whether it must be flagged; None: either verdict may be honest.
SPOILT = {
    "black": (_blacken, False), "white": (_whiten, False), "no depth": (_blind, True),
    "NaN depth": (_nan_depth, True), "NaN colour": (_nan_color, True),
    "some NaN": (_some_nan, None), "half occluded": (_occluded, None),
    "30 % dropout": (_dropout, None), "noise": (_noise, True),
}  # fmt: skip


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_frame_is_survived_and_flagged(case: str) -> None:
    """Catches NaN in poses, a bad pose that passes for a good one, and a run that ends there."""
    spoil, must_flag = SPOILT[case]
    field, sequence = exact_walk()
    tracker = LiveTracker(
        field, sequence.intrinsics, sequence.T_world_camera[0], steps=60, config=LM
    )
    for index in range(1, 6):
        color, depth = sequence.colors[index], sequence.depths_mm[index]
        color, depth = spoil(color, depth) if index == 3 else (color, depth)
        frame = tracker.track(color, depth)
        assert np.isfinite(frame.T_world_camera).all()
        if index == 3:
            assert must_flag is None or frame.lost is must_flag
            assert frame.lost or error_m(frame.T_world_camera, sequence, 3) < LOST
    assert not frame.lost
    assert error_m(frame.T_world_camera, sequence, 5) < 0.01


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_the_papers_trackers_go_on_past_a_blind_frame(name: str) -> None:
    """Catches a live run that a frame without depth ends, or lets pass unmarked."""
    sequence = walk(4)
    tracker = live(sequence, name)
    frames = [
        tracker.track(sequence.colors[i], sequence.depths_mm[i] * np.uint16(i != 2))
        for i in (1, 2, 3)
    ]
    assert [frame.lost for frame in frames] == [False, True, False]
    assert [frame.steps for frame in frames] == [20, 0, 20]
    assert np.isfinite(tracker.T_world_camera).all()


def test_a_gap_of_two_seconds_is_found_again_or_flagged() -> None:
    """Catches a jump that passes for tracking: 12 cm and 11 degrees between two frames."""
    field, sequence = furnished()
    jumped = sequence.T_world_camera[2].copy()
    jumped[:3, 3] += 0.12
    turn = torch.linalg.matrix_exp(0.15 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
    jumped[:3, :3] = turn.double().numpy() @ jumped[:3, :3]
    tracker = LiveTracker(field, sequence.intrinsics, jumped, steps=80, config=TrackingConfig(
        n_pixels=512, motion_model="better_of_both"))  # fmt: skip
    frame = tracker.track(sequence.colors[2], sequence.depths_mm[2])
    assert frame.lost or error_m(frame.T_world_camera, sequence, 2) < 0.02
    assert np.isfinite(frame.T_world_camera).all()
