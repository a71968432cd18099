"""Random pixels as rays: they carry the right measurement, and look where something is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import Formula, poses_at, sequence_of

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics, backproject
from nbtrack.core.geometry import transform_points
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.fields import NeusMapping
from nbtrack.fields.base import NEAR, rays_end
from nbtrack.fields.neus import guided_depths

CAMERA = Intrinsics.from_focal(16, 12, 14.0)
CPU = torch.device("cpu")
BOX = SceneBounds((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))
CONFIG = NeusMapping(n_stratified=16, n_surface=8, surface_band=0.15)


def random_sequence(n_frames: int):
    rng = np.random.default_rng(0)
    shape = (n_frames, CAMERA.height, CAMERA.width)
    poses = poses_at(*rng.normal(size=(2, n_frames, 3)))
    colors = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    return sequence_of(rng.integers(0, 1 << 16, shape), CAMERA, colors, poses)


def rays_ahead(n_rays: int, depth) -> Rays:
    """Rays from the origin that fan out in x, with z = 1."""
    slope = torch.linspace(-0.4, 0.4, n_rays)
    directions = torch.stack([slope, torch.zeros(n_rays), torch.ones(n_rays)], dim=-1)
    return Rays(torch.zeros(n_rays, 3), directions, torch.zeros(n_rays, 3), depth)


def test_ray_ends_at_the_observed_point(generator: torch.Generator) -> None:
    """Catches rows for columns, the pose of another frame, a direction of length one, and signed
    16 bit: 40,000 mm must not become -25.5 m, nor 65,535 no measurement."""
    sequence = random_sequence(4)
    sequence.depths_mm[2, 0, :4] = [0, 32_767, 40_000, 65_535]
    columns, rows = torch.cartesian_prod(torch.arange(16), torch.arange(12)).T
    rays = PixelSampler(sequence, CPU).rays(torch.full((192,), 2), rows, columns)
    depth_m = torch.from_numpy(sequence.depth(2))[rows, columns]
    torch.testing.assert_close(rays.depth, depth_m)
    torch.testing.assert_close(rays.color, torch.from_numpy(sequence.color(2))[rows, columns])
    color, depth = sequence[2].at(rows, columns)
    assert torch.equal(rays.depth, depth)
    assert torch.equal(rays.color, color)
    assert len(sequence[2].measured_pixels()[0]) == torch.count_nonzero(depth_m)
    T_world_camera = torch.from_numpy(sequence.T_world_camera[2]).float()
    points_world = transform_points(T_world_camera, backproject(CAMERA, columns, rows, depth_m))
    found = rays.points(rays.depth[:, None])[:, 0]
    torch.testing.assert_close(found, points_world, rtol=1e-4, atol=1e-4)


def test_draw_covers_only_the_given_frames() -> None:
    """Catches held-out frames that are mapped, corners or frames that are never drawn, and draws
    from the global generator, which no seed of a run reaches."""
    sequence = random_sequence(5)
    sampler, frames = PixelSampler(sequence, CPU), torch.tensor([1, 3])
    generators = (torch.Generator().manual_seed(seed) for seed in (0, 0, 1))
    rays, again, other = (sampler.draw(6000, generator, frames) for generator in generators)
    assert torch.equal(rays.directions_world, again.directions_world)
    assert not torch.equal(rays.directions_world, other.directions_world)
    expected = torch.from_numpy(sequence.T_world_camera[[1, 3], None, :3, 3]).float()
    first, second = (rays.origins_world == expected).all(dim=-1)
    assert (first ^ second).all()
    assert first.float().mean().item() == pytest.approx(0.5, abs=0.03)
    # 2 x 16 x 12 pixels, 15 draws each: all of them turn up.
    both = torch.cat([rays.origins_world, rays.directions_world], dim=1)
    assert len(torch.unique(both, dim=0)) == 2 * 16 * 12


@pytest.mark.parametrize("has_room", [False, True])
def test_images_stay_on_the_host_where_the_device_is_full(has_room: bool, monkeypatch) -> None:
    """Catches a long sequence that is copied to a small device: images stay, as 5 bytes a pixel."""
    asked, device = [], torch.device("meta")
    monkeypatch.setattr("nbtrack.data.pixels.has_room_for", lambda *a: asked.append(a) or has_room)
    sampler = PixelSampler(random_sequence(3), device)
    images = {sampler.colors.device.type, sampler.depths_mm.device.type}
    assert images == {"meta" if has_room else "cpu"}
    assert sampler.T_world_camera.device == device
    assert asked == [(device, 5 * 3 * CAMERA.width * CAMERA.height)]


def test_guided_depths(generator: torch.Generator) -> None:
    """Catches samples behind the surface's band, too few in a part of it or right behind the
    surface, an unsorted ray, a missing depth taken for a surface at the camera (such rays go to the
    box, 3 m), and negative ranges when a pose has left the box."""
    rays = rays_ahead(40, torch.linspace(0.5, 2.5, 40))
    depths = guided_depths(rays, BOX, CONFIG, generator)
    assert depths.shape == (40, 24)
    assert (depths.diff(dim=-1) >= 0).all()
    assert depths.min() >= NEAR
    assert (depths.amax(dim=-1) <= rays.depth + 0.15 + 1e-5).all()
    assert ((depths - rays.depth[:, None]).abs() <= 0.15 + 1e-5).sum(dim=-1).min() >= 8
    part = ((depths - rays.depth[:, None]) / 0.15 + 1) * 4  # one in each eighth of the band
    assert all((part.floor() == k).any(dim=-1).all() for k in range(8))
    assert (depths > rays.depth[:, None]).sum(dim=-1).float().mean() > 4.5  # four of them behind it
    # One stratified sample falls into each of 16 parts, so none is left unseen.
    assert (depths.diff(dim=-1).amax(dim=-1) <= 2 * (rays.depth + 0.15) / 16).all()
    blind = rays_ahead(40, torch.zeros(40))
    last = guided_depths(blind, BOX, CONFIG, generator).amax(dim=-1)
    assert 2.7 < last.min() <= last.max() <= 3.15 + 1e-5
    outside = replace(blind, origins_world=blind.origins_world + torch.tensor([0.0, 0.0, 9.0]))
    torch.testing.assert_close(rays_end(outside, BOX), torch.full((40,), 2 * NEAR))


@pytest.mark.parametrize("seeded", [False, True])
@pytest.mark.parametrize("signed", [False, True])
def test_hierarchical_find_the_wall(signed: bool, seeded: bool) -> None:
    """Catches a second pass beside the surface: the sections' weights lie between the samples; and
    where every sample is asked for once, answers sorted unlike their depths, and other draws.

    A gray wall at z = 2 is either dense behind it or a signed distance. The first pass leaves 9 cm
    between its samples; 12 of the second must be around the wall.
    """
    distance, density = lambda p: 2.0 - p[:, 2], lambda p: 50.0 * (p[:, 2] > 2)
    field = Formula(distance if signed else density, BOX, as_density=not signed)
    origins = torch.zeros(20, 3, requires_grad=True)
    rays = replace(rays_ahead(20, torch.zeros(20)), origins_world=origins)
    again = [torch.Generator().manual_seed(1) if seeded else None for _ in range(2)]
    depths = field.render_hierarchically(rays, 32, 12, again[0]).depths
    assert depths.shape == (20, 44)
    assert not depths.requires_grad
    assert (depths.diff(dim=-1) >= 0).all()
    assert ((depths - 2.0).abs() < 0.25).sum(dim=-1).min() >= 12
    both = field.render(rays, depths), field.render_hierarchically(rays, 32, 12, again[1])
    assert (both[0].depth - 2.0).abs().mean() < 0.05
    for name in ("color", "depth", "depth_variance", "weights"):
        torch.testing.assert_close(*(getattr(r, name) for r in both), atol=1e-6, rtol=1e-5)
    if signed:  # the other wall is a step, without a derivative
        slopes = [torch.autograd.grad(r.depth.sum(), rays.origins_world)[0] for r in both]
        torch.testing.assert_close(*slopes, atol=1e-5, rtol=1e-4)
