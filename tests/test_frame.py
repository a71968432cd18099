"""One frame: a camera's images, sound or not, and a tracker that is fed them."""

import numpy as np
import pytest
import torch
from box_room import box_sequence, error_m, narrow_room, walk

from nbtrack.beyond.lm import LmSettings
from nbtrack.core.camera import Intrinsics
from nbtrack.data.frame import Frame
from nbtrack.machinery.errors import DataError
from nbtrack.tracking import StepBudget, make_tracker

SETTINGS = LmSettings(n_restarts=2)
CAMERA_OF_BUFFERS = Intrinsics.from_focal(16, 12, 14.0)
Images = tuple[np.ndarray, np.ndarray]


def test_units_and_types_are_what_they_say() -> None:
    """Catches metres taken for millimetres, and a camera's frames that are unlike the same ones of
    a recording, however they lie in memory; and saturated depth that counts as measured."""
    sequence = walk(2)
    color, depth_mm = sequence.colors[1], sequence.depths_mm[1]
    color.flags.writeable = False
    metres, expected = depth_mm / 1000, sequence[1].depth_mm
    of_other_order = np.asfortranarray(depth_mm), depth_mm.astype(">u2")
    for depth in (depth_mm, metres, metres.astype(np.float32), *of_other_order):
        frame = Frame.of_images(sequence.intrinsics, color, depth)
        assert torch.equal(frame.color, sequence[1].color)
        assert torch.equal(frame.depth_mm, expected)
        assert frame.depth_mm.is_contiguous()
    depth_mm[:, 5:] = 65535
    assert not Frame.of_images(sequence.intrinsics, color, depth_mm).depth_mm[:, 5:].any()


def _some_nan(color: np.ndarray, depth: np.ndarray) -> Images:
    depth = depth / 1000
    depth[::3], depth[:, ::4], depth[:, 1::8], depth[:, 2::16] = np.nan, np.nan, np.inf, -1.0
    return color, depth


def _occluded(color: np.ndarray, depth: np.ndarray) -> Images:
    color, depth, middle = color.copy(), depth.copy(), depth.shape[1] // 2
    color[:, :middle], depth[:, :middle] = 40, 450
    return color, depth


def _random(low: int, high: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(0).integers(low, high, shape).astype(np.uint16)


LOST = 0.2  # m: the paper's rule of what counts as lost, and must not pass for good
# How the frame is spoilt, and whether it must be flagged; None: either verdict may be honest.
SPOILT = {
    "black": (lambda c, d: (np.zeros_like(c), d), False),
    "white": (lambda c, d: (np.full_like(c, 255), d), False),
    "no depth": (lambda c, d: (c, np.zeros_like(d)), True),
    "NaN depth": (lambda c, d: (c, np.full(d.shape, np.nan)), True),
    "some NaN": (_some_nan, None),
    "half occluded": (_occluded, None),
    "30 % dropout": (lambda c, d: (c, d * (_random(0, 10, d.shape) > 2)), None),
    "noise": (lambda c, d: (c, _random(300, 9000, d.shape)), True),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_frame_is_survived_and_flagged(case: str) -> None:
    """Catches NaN in poses, a bad pose that passes for a good one, and a run that ends there."""
    spoil, must_flag = SPOILT[case]
    sequence, budget = walk(3, narrow_room(), 48), StepBudget(25)
    tracker = make_tracker("lm", narrow_room(), sequence.T_world_camera[0], budget, SETTINGS)
    for turn, index in enumerate((1, 2, 1, 0, 1)):
        images = sequence.colors[index], sequence.depths_mm[index]
        images = spoil(*images) if turn == 2 else images
        estimate = tracker.track(Frame.of_images(sequence.intrinsics, *images))
        assert np.isfinite(estimate.T_world_camera).all()
        if turn == 2:
            assert must_flag is None or estimate.lost is must_flag
            assert estimate.lost or error_m(estimate, sequence[index]) < LOST
    assert not estimate.lost
    assert error_m(estimate, sequence[index]) < 0.01


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("depth", [None, [[1.0]], torch.ones(12, 16)])
def test_images_that_are_none(depth: object) -> None:
    """Catches a traceback for what a camera's driver returns when it has no image, where types are
    not checked at each call."""
    with pytest.raises(DataError, match=f"depth is {type(depth).__name__}: give a num"):
        Frame.of_images(CAMERA_OF_BUFFERS, np.zeros((12, 16, 3), np.uint8), depth)


def test_masked_depth() -> None:
    """Catches masked depth that is taken for measured, and masked colours taken for seen."""
    color, depth = np.zeros((12, 16, 3), np.uint8), np.full((12, 16), 1500, np.uint16)
    masked = np.ma.masked_array(depth, np.arange(192).reshape(12, 16) < 16)
    frame = Frame.of_images(CAMERA_OF_BUFFERS, color, masked)
    assert (frame.depth_mm[0] == 0).all()
    assert (frame.depth_mm[1:] == 1500).all()
    with pytest.raises(DataError, match="masked"):
        Frame.of_images(CAMERA_OF_BUFFERS, np.ma.masked_equal(color, 0), depth)


def test_memory_may_be_used_again() -> None:
    """Catches frames that change with a driver's buffer, and a sequence that changes with a frame
    that it handed out."""
    camera, color = CAMERA_OF_BUFFERS, np.full((12, 16, 3), 7, np.uint8)
    depth = np.full((12, 16), 1500, np.uint16)
    frame = Frame.of_images(camera, color, depth)
    color[:], depth[:] = 0, 0
    assert (frame.color == 7).all()
    assert (frame.depth_mm == 1500).all()
    sequence = box_sequence([[0.0, 0.0, 0.0]] * 2)
    given = sequence[0]
    before = sequence.colors.copy()
    given.color[:], given.T_world_camera[:] = 0, 0
    assert (sequence.colors == before).all()
    assert np.isfinite(sequence.T_world_camera).all()
    assert (sequence.T_world_camera[0] == np.eye(4)).all()
