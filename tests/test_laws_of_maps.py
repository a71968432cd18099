"""Formulas of maps by laws that must hold, or against values worked by hand in another way."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, box_sequence, poses_at, sequence_of

from nbtrack.beyond.correction import corrected
from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.least_squares import interpolation
from nbtrack.beyond.neus_plus import NeuSPlusField, distance_targets
from nbtrack.beyond.points import min_depth_behind
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.fields import NetworkSettings, NeusMapping, make_field
from nbtrack.fields.base import NEAR, rendered_losses
from nbtrack.fields.neus import NeuSField, guided_depths
from nbtrack.machinery.errors import DataError
from nbtrack.mapping.holdout import misfit_of, usual_misfit

BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 3.0))


def rays_ahead(n: int, depth: float) -> Rays:
    """Rays from the origin along z."""
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    return Rays(torch.zeros(n, 3), ahead, torch.full((n, 3), 0.5), torch.full((n,), depth))


class Slope(NeuSField):
    """A value that rises by 3 per metre, along no axis."""

    def forward(self, points_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.sigmoid(points_world), points_world @ torch.tensor([1.0, -2.0, 2.0])


@pytest.mark.parametrize("kind", [NeuSField, NeuSPlusField])
def test_the_eikonal_term_by_hand(kind: type) -> None:
    """Catches a norm that is not squared, or not compared with one: with a slope of 3 the term is
    lambda (3 - 1)^2, and 0 where lambda is."""
    field = type("Steep", (Slope, kind), {})(NetworkSettings(16), BOX, torch.Generator())
    for weight in (0.5, 2.0):
        settings = NeusMapping(lambda_eikonal=weight)
        term = field._eikonal(torch.rand(5, 4, 3), settings, torch.Generator())
        assert term.item() == pytest.approx(4 * weight, rel=1e-5)


@pytest.mark.parametrize("wall", [1.0, 1.4, 2.2])
def test_samples_of_the_second_pass_lie_around_their_section(wall: float) -> None:
    """Catches weights of sections that are given to one of their ends alone: of eight even samples
    those beside the wall have the weight of the section between them, so that the new samples lie
    evenly around its middle."""
    field = Formula(lambda points: 50 * (wall - points[:, 2]), BOX)
    depths = field.render_hierarchically(rays_ahead(1, 0.0), 8, 16).depths[0]
    step = (3.0 - NEAR) / 8
    even = NEAR + step * (torch.arange(8) + 0.5)
    added = depths[(depths[:, None] - even).abs().amin(dim=1) > 1e-5]
    before = even[even < wall].max()
    assert len(added) == 16
    assert added.mean().item() == pytest.approx((before + step / 2).item(), abs=0.02)
    assert ((added - before - step / 2).abs() < 1.01 * step).all()


def test_near_measurements_count_more(monkeypatch) -> None:
    """Catches weights of depths that are left out, inverted or not squared: of a wall at 2 m, seen
    from 1 m as it is and from 2 m as 6 mm farther, the near view has four times the points on it,
    and each counts four times as much: the zero level moves by a seventeenth of the 6 mm."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 60_000)
    camera, shape = Intrinsics.from_focal(64, 48, 48.0), (48, 64)
    poses = poses_at([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    depths_mm = np.stack([np.full(shape, 1000.0), np.full(shape, 2006.0)])
    sequence = sequence_of(depths_mm, camera, poses=poses)
    exact = Formula(lambda points: 2.0 - points[:, 2], BOX)
    field = corrected(exact, sequence, np.arange(2), 0.1)
    seen_by_both = torch.tensor([[x, y, 2.0] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)])
    assert field(seen_by_both)[1].mean().item() == pytest.approx(0.006 / 17, rel=0.2)


def test_before_and_behind_a_wall_alike(monkeypatch) -> None:
    """Catches offsets of equations that lie more on one side of a surface, and points that weigh
    too much or little: a wall through vertices, of a map that has 0.6 of the distance, is corrected
    in mirror images. At the wall, the measured part of the Hessian's diagonal is that by hand."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 20_000)
    frames = sequence_of(np.full((1, 48, 64), 2000.0), Intrinsics.from_focal(64, 48, 48.0))
    flat = Formula(lambda points: 0.6 * (2.0 - points[:, 2]), BOX)
    across = torch.tensor([[0.1, 0.05, 2 + s] for s in (-0.13, -0.08, -0.03, 0, 0.03, 0.08, 0.13)])
    *_, distance, confidence = corrected(flat, frames, np.arange(1), 0.1).channels(across)
    torch.testing.assert_close(distance, -distance.flip(0), rtol=0, atol=1e-4)
    torch.testing.assert_close(confidence, confidence.flip(0), rtol=0, atol=2e-3)
    torch.testing.assert_close(distance[2:5], torch.tensor([0.03, 0, -0.03]), rtol=0, atol=1e-3)
    # 20,000 points on 3072 pixels are 37.5 in a cell of 0.1 m at 2 m. Averaged over the cells
    # around a vertex, the squared weights of the five offsets sum up to 3.425 * (2 / 3) ** 2.
    measured = 37.5 * 3.425 * (2 / 3) ** 2  # and 0.7 from regularisation
    assert confidence[3] == pytest.approx(0.1 + 0.9 * measured / (measured + 0.7), abs=3e-3)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_the_start_of_the_network_by_hand(factor: float) -> None:
    """Catches frequencies that are drawn per unit of the map and not per metre, another scale of
    iMAP's density, and another first width of NeuS's surfaces: 1/s = exp(-3) m."""
    far = SceneBounds((-factor,) * 3, (factor,) * 3)
    neus = make_field("neus", NetworkSettings(embedding_sigma=2.5), far, seed=0)
    spread = neus.mlp.frequencies.std().item() / far.metres_per_unit  # rad/m
    assert spread == pytest.approx(2.5, rel=0.1)
    assert neus.diagnostics()["std_m"] == pytest.approx(math.exp(-3))
    imap = make_field("imap", NetworkSettings(16), far, seed=0)
    torch.nn.init.zeros_(imap.mlp.head.weight)
    color, density = imap(torch.rand(2, 3))
    torch.testing.assert_close(density, torch.full((2,), 10 * math.log(2)))
    torch.testing.assert_close(color, torch.full((2, 3), 0.5))


@pytest.mark.parametrize("name", ["imap", "neus", "neus_plus"])
def test_a_mapping_loss_is_the_sum_by_hand(name: str) -> None:
    """Catches a term with another factor, of other samples, or of a measured point that is taken
    elsewhere or not at all: the terms are computed here from the field's answers and the same
    random numbers."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1]])
    sequence.depths_mm[:, :8] = 0
    bounds = BoxRoom().bounds
    field = make_field(name, NetworkSettings(16), bounds, seed=0)
    settings = field.Settings(n_rays=40, n_stratified=8, n_surface=4, lambda_color=3.0)
    if name == "neus_plus":
        settings = replace(settings, lambda_rendering=0.5)
    draw = PixelSampler(sequence, torch.device("cpu")).draw
    frames, generator = torch.arange(2), torch.Generator()
    field.prepare(sequence, np.arange(2)) if name == "neus_plus" else None

    def drawn(n_rays: int, **options: bool) -> Rays:
        return draw(n_rays, generator, frames, **options)

    found = field.mapping_losses(drawn, settings, generator.manual_seed(1))
    generator.manual_seed(1)
    if name == "imap":
        rays = drawn(40)
        seen = field.render(rays, field.render_hierarchically(rays, 8, 4, generator).depths)
        expected = rendered_losses(seen, rays, 3.0, 1.0, over_std=True)
    else:
        rays = drawn(40, tangent_planes=name == "neus_plus")
        depths = guided_depths(rays, bounds, settings, generator)
        seen = field.render(rays, depths)
        are_measured = rays.depth > 0
        expected = {"depth": (seen.depth - rays.depth)[are_measured].abs().mean()}
        expected["color"] = 3 * (seen.color - rays.color)[are_measured].abs().mean()
    if name == "neus":
        expected["eikonal"] = field._eikonal(rays.points(depths), settings, generator)
    if name == "neus_plus":
        expected = {term: 0.5 * value for term, value in expected.items()}
        surface = drawn(settings.n_surface_points)
        points = surface.origins_world + surface.depth[:, None] * surface.directions_world
        (color, sdf), are_measured = field(points), surface.depth > 0
        expected["surface"] = 10 * sdf[are_measured].abs().mean()
        expected["surface_color"] = 3 * (color - surface.color)[are_measured].abs().mean()
        answers = field.observed(rays.points(depths))
        target, known = distance_targets(rays, depths, *answers, settings)
        off = (field.query_along(rays, depths)[1] - target).abs()
        expected["sdf"] = 10 * off[known > 0].mean()
    for term, value in expected.items():
        torch.testing.assert_close(found[term], value, rtol=1e-4, atol=1e-6)


def test_how_far_points_lie_behind_what_was_seen() -> None:
    """Catches a sign, the largest in place of the least, and what no frame saw or measured."""
    camera, poses = Intrinsics.from_focal(16, 12, 14.0), poses_at([[0.3, -0.2, 0.1]] * 6, [1, 2, 3])
    sequence = sequence_of(np.full((6, 12, 16), 2000.0), camera, poses=poses)
    sequence.depths_mm[5] = 3000  # every fifth frame is asked: 0 and 5
    sequence.depths_mm[:, :, 9:] = 0
    points = [[0.0, 0.0, 2.5], [-0.1, 0.0, 1.5], [9.0, 0.0, 2.0], [0.0, 0.0, -1.0], [0.5, 0.0, 2.0]]
    R, t = torch.from_numpy(poses[0, :3]).float().split([3, 1], dim=1)
    behind = min_depth_behind(torch.tensor(points) @ R.T + t.T, sequence, np.arange(6))
    torch.testing.assert_close(behind, torch.tensor([-0.5, -1.5, *[math.inf] * 3]))


def test_how_far_a_map_is_off_by_hand() -> None:
    """Catches a pose that is inverted, a sign that counts, and frames that were not mapped: walls
    lie where the frames saw them, or 10 cm before or behind that."""
    sequence = box_sequence(poses_at([[0.1, 0.05, -0.1]] * 3, [0.1, -0.3, 0.2]))
    assert misfit_of(BoxRoom(), sequence[0]) < 0.03  # rendered: as sharp as its samples
    for off in (-0.1, 0.1):
        grid = BakedField(BoxRoom(half=(1.0 + off, 0.8 + off, 1.2 + off)), 0.05)
        assert misfit_of(grid, sequence[0]) == pytest.approx(0.1, abs=2e-3)
    sequence.T_world_camera[0, 2, 3] += 0.5
    assert 0 < usual_misfit(BoxRoom(), sequence, np.array([1, 2])) < 0.03


def test_a_picture_is_what_the_camera_sees() -> None:
    """Catches a pose that is inverted, rows for columns, and colours out of range, in a picture of
    a box from a turned camera."""
    poses = poses_at([[0.2, 0.1, -0.3]], [0.2, -0.4, 0.3])
    frames = box_sequence(poses)
    color, depth = BoxRoom().render_view(frames.intrinsics, poses[0])
    assert np.abs(depth - frames.depth(0)).mean() < 0.03
    assert np.abs(color - frames.color(0)).mean() < 0.02
    bright = Formula(lambda points: 1.0 - points[:, 2], BOX, lambda points: 0 * points + 3)
    assert bright.render_view(frames.intrinsics, np.eye(4))[0].max() == 1


def test_a_section_counts_by_its_middle() -> None:
    """Catches the depth or colour of one of its ends: the colour is a quarter of the depth."""
    field = Formula(lambda points: 1.0 - points[:, 2], BOX, lambda points: points / 4)
    seen = field.render(rays_ahead(1, 0.0), torch.tensor([[0.5, 0.8, 1.1, 1.2]]))
    expected = seen.weights[0] @ torch.tensor([0.65, 0.95, 1.15])
    torch.testing.assert_close(seen.depth[0], expected)
    torch.testing.assert_close(seen.color[0, 2], expected / 4)


@pytest.mark.parametrize("name", ["imap", "neus", "volsdf", "occupancy"])
def test_a_ray_is_the_same_in_another_unit(name: str) -> None:
    """Catches sections in units of the depth, not in metres: of directions twice as long depths
    are half as large, and nothing else changes."""
    field, generator = make_field(name, NetworkSettings(16), BOX, seed=0), torch.Generator()
    rays, values = rays_ahead(5, 0.0), torch.rand(5, 8, generator=generator)
    depths = values.cumsum(dim=1)
    doubled = replace(rays, directions_world=2 * rays.directions_world)
    expected = field.weights(values, rays, depths)
    torch.testing.assert_close(field.weights(values, doubled, depths / 2), expected)


def test_the_network_by_hand() -> None:
    """Catches another wave, a lost skip or activation, a point that is not taken from the centre,
    and first weights of one sign or another spread than a rectifier needs."""
    box = SceneBounds((1.0, 2.0, 3.0), (5.0, 5.0, 4.0))
    mlp, points = make_field("imap", NetworkSettings(64), box, seed=0).mlp, 5 * torch.rand(7, 3)
    wave = torch.sin((points - torch.tensor([3.0, 3.5, 3.5])) / 2 @ mlp.frequencies)
    first = (wave @ mlp.layer_1.weight.T).relu()
    second = (first @ mlp.layer_2.weight.T).relu()
    third = (torch.cat([second, wave], dim=1) @ mlp.layer_3.weight.T).relu()
    raw = (third @ mlp.layer_4.weight.T).relu() @ mlp.head.weight.T
    torch.testing.assert_close(torch.cat([mlp(points)[0], mlp(points)[1][:, None]], dim=1), raw)
    for layer in (mlp.layer_1, mlp.layer_2, mlp.layer_3, mlp.layer_4):
        spread = (2 / layer.in_features) ** 0.5
        assert abs(layer.weight.mean().item()) < 0.05 * spread
        assert layer.weight.std().item() == pytest.approx(spread, rel=0.05)


def test_equations_of_points_are_the_grids_interpolation() -> None:
    """Catches ends or axes exchanged, and points outside that are not moved to the border."""
    grid, generator = BakedField(BoxRoom(), 0.2), torch.Generator().manual_seed(0)
    grid.volume[3] = torch.rand(grid.volume[3].shape, generator=generator)
    points = 4 * torch.rand(100, 3, generator=generator) - 2
    vertices, weights = interpolation(points.double().numpy(), grid)
    found = (grid.volume[3].numpy()[vertices] * weights).sum(axis=1)
    np.testing.assert_allclose(found, grid(points)[1], atol=1e-5)


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_a_wall_outside_of_the_map_corrects_nothing(turn: float) -> None:
    """Catches points beyond the grid, which would count at its border."""
    frames = sequence_of(np.full((1, 12, 16), 1500.0), Intrinsics.from_focal(16, 12, 14.0))
    frames.T_world_camera[:] = poses_at([[0.0, 0.0, 0.0]], [0.0, turn, 0.0])
    small = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    with pytest.raises(DataError, match="no surface"):
        corrected(Formula(lambda points: points[:, 2], small), frames, np.arange(1), 0.2)


def test_a_large_place_takes_more_points(monkeypatch) -> None:
    """Catches a share that is inverted, and more than four times as many points: a wall of 1.33 by
    1 m has 8, 540 or 3,400 cells, each of which asks for ten."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 2000)
    asked, draw = [], PixelSampler.draw
    monkeypatch.setattr(PixelSampler, "draw", lambda *a, **b: asked.append(a[1]) or draw(*a, **b))
    frames = sequence_of(np.full((1, 48, 64), 2000.0), Intrinsics.from_focal(64, 48, 96.0))
    bounds = SceneBounds((-0.7, -0.5, 1.9), (0.7, 0.5, 2.1))
    for voxel in (0.4, 0.05, 0.02):
        corrected(Formula(lambda points: 2.0 - points[:, 2], bounds), frames, np.arange(1), voxel)
    assert asked[:2] + asked[3:] == [2000, 2000, 2000, 8000]
    assert asked[2] == pytest.approx(10 * 540, rel=0.1)
