"""Direct supervision of the signed distance: its targets, and the field that they teach."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.errors import ConfigError
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import NetworkSettings, NeusPlusMapping, supervised_field
from nbtrack.fields.neus_plus import ObservedDistance, distance_targets
from nbtrack.mapping.fit import map_sequence

CONFIG = NeusPlusMapping()
CAMERA = Intrinsics.from_focal(64, 48, 48.0)


def slanted_wall(n_frames: int = 1) -> RgbdSequence:
    """A wall through (0, 0, 2) whose normal is turned by 45 degrees about y: z = 2 + x."""
    _, columns = np.indices((48, 64))
    x_over_z = (columns + 0.5 - 32) / 48
    depth = 2 / (1 - x_over_z)
    return RgbdSequence(
        "slanted", CAMERA, np.full((n_frames, 48, 64, 3), 100, np.uint8),
        np.tile((1000 * depth).round().astype(np.uint16), (n_frames, 1, 1)),
        np.tile(np.eye(4), (n_frames, 1, 1)), np.arange(n_frames),
    )  # fmt: skip


def test_plane_distance_of_a_slanted_wall() -> None:
    """Catches distances along the ray or along z, where the plane's own is smaller by the cosine;
    planes through two surfaces, through missing depth, or beyond the image.

    From depth d on a ray (x, y, 1) the plane z = 2 + x is (D - d)(1 - x) / sqrt(2) away.
    """
    sequence = slanted_wall()
    sequence.depths_mm[0, :, 40:] = 900
    sequence.depths_mm[0, 20, 10] = 0
    sampler = PixelSampler(sequence, torch.device("cpu"))
    rows, columns = torch.tensor([10, 24, 20, 10, 20, 0]), torch.tensor([20, 32, 30, 39, 11, 30])
    found = sampler.plane_distance_per_depth(torch.zeros_like(rows), rows, columns)
    expected = (1 - (columns + 0.5 - 32) / 48) / 2**0.5 * (torch.arange(6) < 3)
    torch.testing.assert_close(found, expected, atol=5e-3, rtol=0)


def test_targets_by_hand() -> None:
    """Catches swapped signs, a plane that is believed where something else is nearer, targets far
    behind the surface, and rays without a depth that teach anything.

    The ray measured 2 m at a plane met head-on; samples at 1, 1.9, 2.05 and 2.3 m.
    """
    zeros = torch.zeros(2, 3)
    rays = Rays(zeros, zeros, zeros, torch.tensor([2.0, 0.0]), torch.tensor([1.0, 0.0]))
    depths = torch.tensor([1.0, 1.9, 2.05, 2.3]).expand(2, 4)
    nearest = torch.tensor([0.4, 0.11, 0.06, 0.28]).expand(2, 4)
    target, known = distance_targets(rays, depths, nearest, 0.05, CONFIG)
    # At 1 m a chair is nearer (0.4 m) than the wall (1 m).
    torch.testing.assert_close(target[0, :3], torch.tensor([0.4, 0.1, -0.05]))
    assert known[0].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert known[1].sum() == 0


def test_observed_distance_from_a_wall() -> None:
    """Catches wrong voxel centres, axes or units: the wall z = 2 + x is 1 / sqrt(2) m away from
    (0, 0, 1)."""
    bounds = SceneBounds((-1.5, -1.5, -0.1), (3.0, 1.5, 5.0))
    frames = np.arange(4)
    observed = ObservedDistance(slanted_wall(4), frames, bounds, torch.device("cpu"))
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.1, 0.1, 0.1], [0.0, 0.0, -9.0]])
    found = observed(points)
    expected = torch.tensor([0.707, 0.0, 1.414])
    torch.testing.assert_close(found[:3], expected, atol=observed.voxel, rtol=0)
    assert torch.isfinite(found).all()


def test_distances_are_learned_sooner_than_by_rendering_alone() -> None:
    """Catches supervision that is not wired in: after a few steps it must be nearer the truth."""
    sequence, network = slanted_wall(4), NetworkSettings(width=32)
    base = NeusPlusMapping(40, n_rays=48, n_stratified=8, n_surface=8, learning_rate=3e-3)
    errors = {}
    for name in ("neus", "neus_plus"):
        field = map_sequence(name, sequence, network, replace(base, n_surface_points=128)).field
        depth = torch.linspace(0.5, 2.1, 17)
        points = torch.stack([torch.zeros(17), torch.zeros(17), depth], dim=-1)
        with torch.no_grad():
            errors[name] = (field(points)[1] - (2 - depth) / 2**0.5).abs().mean().item()
    assert errors["neus_plus"] < 0.5 * errors["neus"]


def test_supervision_chooses_the_variant_of_a_field() -> None:
    """Catches a supervision that is ignored where a field does not know it."""
    assert supervised_field("neus", "rendering") == "neus"
    assert supervised_field("neus", "rendering+sdf") == "neus_plus"
    assert supervised_field("neus_plus", "rendering+sdf") == "neus_plus"
    with pytest.raises(ConfigError, match="'imap' knows no supervision 'rendering\\+sdf'"):
        supervised_field("imap", "rendering+sdf")
    with pytest.raises(ConfigError, match="unknown field 'nues'"):
        supervised_field("nues", "rendering")
