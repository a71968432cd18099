"""Direct supervision of the signed distance: its targets, and the fields that they teach."""

from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import room_sequence, sequence_of

from nbtrack import read_map, write_map
from nbtrack.beyond.neus_plus import (
    FeatureGrid,
    GridNetwork,
    GridPlusMapping,
    NeusPlusMapping,
    ObservedDistance,
    distance_targets,
)
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, pixel_directions
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.fields import NetworkSettings
from nbtrack.fields.neus import guided_depths
from nbtrack.mapping.fit import map_sequence
from nbtrack.synthetic import build_room

CONFIG = NeusPlusMapping()
CAMERA = Intrinsics.from_focal(64, 48, 48.0)


def slanted_wall(n_frames: int = 1) -> RgbdSequence:
    """A wall through (0, 0, 2) whose normal is turned by 45 degrees about y: z = 2 + x."""
    depth = 2000 / (1 - (np.arange(64) + 0.5 - 32) / 48)
    return sequence_of(np.tile(depth, (n_frames, 48, 1)), CAMERA)


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
    normals = sampler.normals_camera(torch.zeros_like(rows), rows, columns)
    # Towards the camera, against the ray.
    found = -(normals * pixel_directions(sequence.intrinsics, columns, rows)).sum(dim=-1)
    expected = (1 - (columns + 0.5 - 32) / 48) / 2**0.5 * (torch.arange(6) < 3)
    torch.testing.assert_close(found, expected, atol=5e-3, rtol=0)


def test_targets_by_hand() -> None:
    """Catches swapped signs, a plane that is believed where something else is nearer or no normal
    is known, targets far behind the surface, none at it, and rays without depth that teach.

    The ray measured 2 m at a plane met head-on; samples at 1, 1.9, 2, 2.05 and 2.3 m.
    """
    zeros, ahead = torch.zeros(3, 3), torch.tensor([[0.0, 0.0, 1.0]] * 3)
    normals = -ahead * torch.tensor([[1], [0], [0]])
    rays = Rays(zeros, ahead, zeros, torch.tensor([2.0, 0.0, 2.0]), normals)
    depths = torch.tensor([1.0, 1.9, 2.0, 2.05, 2.3]).expand(3, 5)
    nearest = torch.tensor([[0.4, 0.11, 0.01, 0.06, 0.3]] * 2 + [[0.01] * 5])
    nowhere = torch.zeros(3, 5, dtype=torch.bool)
    target, known = distance_targets(rays, depths, nearest, nowhere, CONFIG)
    # At 1 m a chair is nearer (0.4 m) than the wall (1 m).
    torch.testing.assert_close(target[0, :4], torch.tensor([0.4, 0.1, 0.0, -0.05]))
    assert known[0].tolist() == [1.0, 1.0, 1.0, 1.0, 0.0]
    assert known[1].sum() == known[2, 3] == 0
    # A thin plate: a camera has seen the fourth sample's place to be free.
    target, known = distance_targets(rays, depths, nearest, depths == 2.05, CONFIG)
    assert known[0].tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]


def test_observed_distance_from_a_wall() -> None:
    """Catches wrong voxel centres, axes or units: the wall z = 2 + x is 1 / sqrt(2) m away from
    (0, 0, 1)."""
    bounds = SceneBounds((-1.5, -1.5, -0.1), (3.0, 1.5, 5.0))
    observed = ObservedDistance(slanted_wall(4), np.arange(4), bounds, torch.device("cpu"))
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.6], [0.0, 0.0, 3.0]])
    found, is_free = observed(points[None])
    torch.testing.assert_close(found, torch.tensor([[0.707, 0.0, 0.99, 0.707]]), atol=0.04, rtol=0)
    assert is_free.tolist() == [[True, False, True, False]]
    assert torch.isfinite(observed(torch.full((1, 1, 3), -9.0))[0]).all()


def test_targets_in_a_furnished_room() -> None:
    """Catches planes believed beyond their own patch, or behind thin things: what was observed is
    part of what is there, so that no distance may be taught that is clearly less than the truth;
    nor one that is more, near what was observed."""
    room, sequence = build_room("office"), room_sequence("office", 64, 20, 2)
    bounds, frames, generator = observed_bounds(sequence), np.arange(20), torch.Generator()
    observed = ObservedDistance(sequence, frames, bounds, torch.device("cpu"))
    sampler = PixelSampler(sequence, torch.device("cpu"))
    rays = sampler.draw(1000, generator, torch.from_numpy(frames), tangent_planes=True)
    depths = guided_depths(rays, bounds, CONFIG, generator)
    target, known = distance_targets(rays, depths, *observed(rays.points(depths)), CONFIG)
    points = rays.points(depths).flatten(0, 1).double().numpy()
    true_sdf = torch.from_numpy(room.sdf(points)).view_as(depths)
    error = (target - true_sdf)[known > 0]
    assert (error < -0.02).float().mean() < 0.02
    assert error[true_sdf[known > 0].abs() < 0.1].abs().mean() < 0.007


def test_distances_are_learned_sooner_than_by_rendering_alone(tmp_path: Path, monkeypatch) -> None:
    """Catches supervision that is not wired in: after a few steps it must be nearer the truth; and
    a file that does not keep grids of features."""
    monkeypatch.setattr("nbtrack.beyond.neus_plus._MIN_VOXEL", 0.1)  # a second in place of four
    few = {"iterations": 25, "n_rays": 32, "n_stratified": 8, "n_surface": 8}
    few |= {"n_surface_points": 64}
    settings = NeusPlusMapping(**few, learning_rate=3e-3)
    network = NetworkSettings(width=32, n_frequencies=32)
    kinds = {"neus": (network, settings), "neus_plus": (network, settings)}
    kinds["grid_plus"] = GridNetwork(), GridPlusMapping(**few)
    depth, errors = torch.linspace(0.5, 2.1, 17), {}
    points = torch.stack([torch.zeros(17), torch.zeros(17), depth], dim=-1)
    for name, how in kinds.items():
        made = map_sequence(name, slanted_wall(4), *how)
        found = made.field(points)[1]
        errors[name] = (found - (2 - depth) / 2**0.5).abs().mean().item()
    assert max(errors["neus_plus"], errors["grid_plus"]) < 0.5 * errors["neus"]
    write_map(tmp_path / "map.safetensors", made)
    assert torch.equal(read_map(tmp_path).field(points)[1], found)


def test_features_by_hand() -> None:
    """Catches a level that is left out or read in another's cells: at a vertex of the coarsest one
    the features are its own, and those of the vertices of the finer ones that lie there; and first
    weights of another spread: of 15 inputs."""
    box = SceneBounds((-1.0, -0.5, 0.0), (1.0, 0.5, 3.0))
    grid = FeatureGrid(GridNetwork(finest=0.1, levels=3), box, torch.Generator().manual_seed(0))
    vertex = torch.tensor([[-1.0 + 0.4, -0.5 + 0.8, 1.2]])  # number 1, 2, 3 of the coarsest
    levels = zip(grid.volumes, (4, 2, 1), strict=True)
    expected = [volume[:, k, 2 * k, 3 * k] for volume, k in levels]
    normalized = (vertex[0] - grid.low) / box.metres_per_unit - 1
    hidden = torch.nn.functional.silu(grid.layer(torch.cat([*expected, normalized])))
    torch.testing.assert_close(grid.features(vertex)[0], hidden)
    assert grid.layer.weight.std().item() == pytest.approx(15**-0.5, rel=0.15)
