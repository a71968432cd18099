"""What a recording says of a map, in a box whose distance is exact."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, box_sequence, narrow_room, poses_at

from nbtrack.checks.in_map import map_misfit, outside_map_share
from nbtrack.core.bounds import SceneBounds
from nbtrack.data.sequence import RgbdSequence

ROOM = BoxRoom(half=(1.5, 1.2, 2.0))


def seen(n_frames: int = 12) -> RgbdSequence:
    """From before the middle, turned to all sides a little: most see four or five walls."""
    random = np.random.default_rng(0)
    turns = random.normal(scale=0.2, size=(n_frames, 3))
    poses = poses_at(random.uniform(-0.2, 0.2, (n_frames, 3)) - [0, 0, 0.4], turns)
    return box_sequence(poses, narrow_room(), 24)  # with three walls a motion does the same


def longer(sequence: RgbdSequence, share: float) -> RgbdSequence:
    depths_mm = np.rint((1 + share) * sequence.depths_mm).astype(np.uint16)
    return replace(sequence, depths_mm=depths_mm)


@pytest.mark.parametrize("off", [0, 2, 3, -3])
def test_what_misfits_is_told_with_its_size(off: float) -> None:
    """Catches a scale that is taken for a motion of the camera; the poses are off by what a tracker
    would make of it."""
    sequence = longer(seen(), off / 100)
    estimated = sequence.T_world_camera.copy()
    estimated[:, :3, 3] += np.random.default_rng(1).normal(scale=0.01, size=(12, 3))
    said = map_misfit(narrow_room(), sequence, estimated)
    assert bool(said) == bool(off)
    if off:
        assert float(re.search(r"by ([-+][\d.]+)%", said)[1]) == pytest.approx(off, abs=1)


def test_nothing_is_told_before_a_wall() -> None:
    """Catches the slopes of a rough map taken for depths that are too long: a wall 1 m away waves
    by 0.5 mm across the view; the depths are too long by 3 %, as a step back would make them."""

    def distance(points: torch.Tensor) -> torch.Tensor:
        return 1 + 0.0005 * (10 * points[:, 0]).sin() - points[:, 2]

    flat = BoxRoom(half=(9.0, 9.0, 1.0))
    poses = poses_at(np.outer(np.linspace(-0.2, 0.2, 12), [1, 0, 0]))
    sequence = longer(box_sequence(poses, flat, 48), 0.03)
    assert map_misfit(Formula(distance, flat.bounds), sequence, poses) == ""


def test_frames_outside_of_what_was_mapped() -> None:
    """Catches a camera in a part that no map holds, without a word: the map ends at x = 0, and half
    of the frames look to where it is not, known by their true poses alone."""
    towards_x = np.outer([1] * 5 + [-1] * 5, [0, np.pi / 2, 0])
    poses = poses_at(np.zeros((10, 3)), towards_x)
    half = BoxRoom(half=(1.5, 1.2, 2.0))
    half.bounds = SceneBounds((-1.6, -1.3, -2.1), (0.0, 1.3, 2.1))
    astray = np.tile(poses[9], (10, 1, 1))
    assert outside_map_share(half, box_sequence(poses, ROOM, 48), astray) == 0.5
    assert outside_map_share(ROOM, seen(), seen().T_world_camera) == 0
