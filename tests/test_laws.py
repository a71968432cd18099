"""Formulas by laws that must hold, or against values worked by hand in another way."""

import math

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, box_sequence, narrow_room, poses_at, sequence_of
from scipy.spatial.transform import Rotation

from nbtrack.beyond.correction import corrected
from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_optimizer import NEAR_SCALES, LmOptimizer
from nbtrack.beyond.lm_residuals import grid_of
from nbtrack.beyond.neus_plus import NeuSPlusField, distance_targets
from nbtrack.beyond.observed import draw_points
from nbtrack.beyond.points import min_depth_behind
from nbtrack.beyond.verdict import p_lost, p_within
from nbtrack.beyond.views import Viewpoints, retrieve, view_of
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import PixelSampler, Rays
from nbtrack.fields import NetworkSettings, NeusMapping, make_field
from nbtrack.fields.base import NEAR, rendered_losses
from nbtrack.fields.neus import NeuSField, guided_depths
from nbtrack.mapping.holdout import depth_residual_of, usual_depth_residual
from nbtrack.recordings.reading import FAR, far_limit
from nbtrack.tracking import SdfSettings, StepBudget, VrSettings, make_tracker

BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 3.0))


def rays_ahead(n: int, depth: float) -> Rays:
    """Rays from the origin along z."""
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    return Rays(torch.zeros(n, 3), ahead, torch.full((n, 3), 0.5), torch.full((n,), depth))


class Slope(NeuSField):
    """A value that rises by 3 per metre along x."""

    def forward(self, points_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.sigmoid(points_world), 3 * points_world[:, 0]


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
    depths = field.hierarchical_depths(rays_ahead(1, 0.0), 8, 16)[0]
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


def test_where_depths_become_outliers() -> None:
    """Catches another quantile: of a hundred depths the ninetieth decides."""
    assert far_limit(np.array([1.0] * 85 + [3.0] * 10 + [50.0] * 5)) == pytest.approx(3 * FAR)
    assert far_limit(np.array([])) == np.inf


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
    elsewhere: the terms are computed here from the field's answers and the same random numbers."""
    sequence = box_sequence([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1]])
    bounds = BoxRoom().bounds
    field = make_field(name, NetworkSettings(16), bounds, seed=0)
    settings = field.Settings(n_rays=40, n_stratified=8, n_surface=4, lambda_color=3.0)
    draw = PixelSampler(sequence, torch.device("cpu")).draw
    frames, generator = torch.arange(2), torch.Generator()
    field.prepare(sequence, np.arange(2)) if name == "neus_plus" else None

    def drawn(n_rays: int, **options: bool) -> Rays:
        return draw(n_rays, generator, frames, **options)

    found = field.mapping_losses(drawn, settings, generator.manual_seed(1))
    generator.manual_seed(1)
    if name == "imap":
        rays = drawn(40)
        seen = field.render(rays, field.hierarchical_depths(rays, 8, 4, generator))
        expected = rendered_losses(seen, rays, 3.0, 1.0, over_std=True)
    else:
        rays = drawn(40, tangent_planes=name == "neus_plus")
        depths = guided_depths(rays, bounds, settings, generator)
        seen = field.render(rays, depths)
        expected = {"depth": (seen.depth - rays.depth).abs().mean()}
        expected["color"] = 3 * (seen.color - rays.color).abs().mean()
    if name == "neus_plus":
        surface = drawn(settings.n_surface_points)
        points = surface.origins_world + surface.depth[:, None] * surface.directions_world
        color, sdf = field(points)
        expected["surface"] = 10 * sdf.abs().mean()
        expected["surface_color"] = 3 * (color - surface.color).abs().mean()
        answers = field.observed(rays.points(depths))
        target, known = distance_targets(rays, depths, *answers, settings)
        off = (field.query_along(rays, depths)[1] - target).abs()
        expected["sdf"] = 10 * off[known > 0].mean()
    for term, value in expected.items():
        torch.testing.assert_close(found[term], value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("unit", ["map", "metre"])
def test_the_first_step_of_adam_by_hand(unit: str) -> None:
    """Catches a rate in another unit, one rate for both parts, and a quaternion that is left
    longer than one: a first step moves every coordinate by its rate, against the gradient; and a
    search from the worse of two starts."""
    room = BoxRoom()
    sequence = box_sequence([[0.05, -0.04, 0.03]], room)
    settings = SdfSettings(n_pixels=500, position_unit=unit)
    tracker = make_tracker("sdf", room, np.eye(4), StepBudget(1), settings)
    found = tracker.track(sequence[0]).T_world_camera
    rate_m = 5e-4 * (room.bounds.metres_per_unit if unit == "map" else 1.0)
    np.testing.assert_allclose(found[:3, 3], [rate_m, -rate_m, rate_m], rtol=1e-3)
    quaternion = Rotation.from_matrix(found[:3, :3]).as_quat(scalar_first=True)
    vector = np.abs(quaternion[1:] / quaternion[0])
    np.testing.assert_allclose(vector, 1e-3, rtol=2e-3)
    assert tracker.q_wxyz.norm().item() == pytest.approx(1, abs=3e-7)
    starts = torch.from_numpy(poses_at([[0.1, 0.0, 0.0], [0.05, -0.04, 0.03]]))
    for T_starts in (starts, starts.flip(0)):  # the better one is taken up
        tracker.begin(sequence[0], T_starts)
        assert tracker.T_world_camera[0, 3].item() == pytest.approx(0.05)


def test_the_trackers_losses_by_hand() -> None:
    """Catches an inverted pose, rays instead of depths, a forgotten weight, and a mean over pixels
    in place of channels: Eq. 2 and iMAP's loss in plain numpy, at a pose that is off."""
    room = BoxRoom()
    frame = box_sequence([[0.0, 0.0, 0.0]], room)[0]
    (T_off,) = poses_at([[0.03, 0.02, -0.04]], [0.02, -0.03, 0.01])
    camera = frame.camera
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    depth = frame.depth_mm.numpy()[rows, columns] / 1000
    color = frame.color.numpy()[rows, columns] / 255
    points = np.stack([x * depth, y * depth, depth], axis=1) @ T_off[:3, :3].T + T_off[:3, 3]
    off = np.abs((np.array([1.0, 0.8, 1.2]) - np.abs(points)).min(axis=1)).mean()
    unlike = np.abs(0.5 + 0.4 * np.sin(3 * points) - color).mean()
    settings = SdfSettings(n_pixels=20_000, lambda_sdf=2.0, lambda_color=0.5)
    tracker = make_tracker("sdf", room, T_off, StepBudget(1), settings)
    assert tracker.track(frame).loss == pytest.approx(2 * off + 0.5 * unlike, rel=0.02)
    wide = SceneBounds((-4.0, -4.0, -1.0), (4.0, 4.0, 3.0))
    wall = Formula(lambda points: 500.0 * (points[:, 2] > 2.0), wide, as_density=True)
    depth_mm = torch.full_like(frame.depth_mm, 2500)
    settings = VrSettings(n_pixels=200, lambda_color=0.0, lambda_depth=2.0, n_stratified=200)
    tracker = make_tracker("vr", wall, np.eye(4), StepBudget(1), settings)
    ahead = Frame(camera, frame.color, depth_mm, np.eye(4))
    # Half a metre off, over the least deviation, 2 cm, of what is nearly a step.
    assert tracker.track(ahead).loss == pytest.approx(2 * 0.5 / 0.02, rel=0.1)


def test_how_far_points_lie_behind_what_was_seen() -> None:
    """Catches a sign, the largest in place of the least, and places that no frame saw."""
    sequence = sequence_of(np.full((6, 12, 16), 2000.0), Intrinsics.from_focal(16, 12, 14.0))
    sequence.depths_mm[5] = 3000  # every fifth frame is asked: 0 and 5
    points = torch.tensor([[0.0, 0.0, 2.5], [0.1, 0.0, 1.5], [9.0, 0.0, 2.0], [0.0, 0.0, -1.0]])
    behind = min_depth_behind(points, sequence, np.arange(6))
    torch.testing.assert_close(behind, torch.tensor([-0.5, -1.5, math.inf, math.inf]))


def test_the_probability_that_a_pose_is_wrong() -> None:
    """Catches a sign: it rises where fewer points fit, colours differ, the pose is less certain,
    farther from where it was expected, or still moves; and by hand, normal errors within 5 cm."""
    assert p_within(0.05) == pytest.approx(0.6827, abs=1e-4)
    assert p_within(0.025) == pytest.approx(0.9545, abs=1e-4)
    good = {"fitting_ratio": 0.9, "known_ratio": 0.8, "intensity_ratio": 1.0, "innovation": 0.03}
    good |= {"position_std_m": 0.002, "last_step": 0.0}
    worse = {"fitting_ratio": 0.5, "known_ratio": 0.3, "intensity_ratio": 3.0, "innovation": 0.3}
    worse |= {"position_std_m": 0.05, "last_step": 0.05}
    odds = 2.01 - 2.06 * math.log(9) - 0.28 * math.log(4) + 1.39 * math.log(0.03)
    assert p_lost(good) == pytest.approx(1 / (1 + math.exp(-odds)), rel=1e-6)
    for name, value in worse.items():
        assert p_lost({**good, name: value}) > p_lost(good)
    # Nothing but the spread: two standard deviations of 2.5 cm, and a last step of nothing.
    found = p_lost({**good, "position_std_m": 0.025})
    assert 1 - found == pytest.approx((1 - p_lost(good)) * p_within(0.05), rel=1e-6)


def test_the_certainty_of_a_pose_by_hand() -> None:
    """Catches a variance for a deviation and another unit of the scales: four times the points
    halve a standard deviation that the points' planes alone decide, up to 256 that count."""
    room = BoxRoom(half=(0.6, 0.45, 1.2), contrast=0.0)
    frame, grid = box_sequence([[0.0, 0.0, 0.0]], room, 96)[0], grid_of(BakedField(room, 0.05))
    said = []
    for n_points in (60, 240):
        seen = draw_points(frame, n_points, torch.Generator().manual_seed(0))
        optimizer = LmOptimizer(grid, seen, seen, 0.0, np.eye(4))
        optimizer.run()
        said.append(optimizer.certainty())
    assert all(each["inlier_ratio"] > 0.9 for each in said), said
    few, many = (each["position_std_m"] for each in said)
    assert many / few == pytest.approx(0.5, abs=0.05)
    # 1 cm a point, half of the least scale, times the root of 60 over the points that hold least.
    assert 0.01 / 60**0.5 < few < 0.02


def test_how_many_points_fit_by_hand() -> None:
    """Catches points that do not count by their reliability, a sign of the distance, and brightness
    that counts: a tenth of the points lie too near, a fifth too far; the picture is darker, and
    confidences differ."""
    grid, generator = BakedField(narrow_room(), 0.05), torch.Generator().manual_seed(1)
    grid.volume[4] = torch.rand(grid.n_vertices, generator=generator).flatten()
    seen = draw_points(box_sequence([[0.0] * 3], narrow_room(), 48)[0], 1000, generator)
    seen.points[::10] *= 0.8
    seen.points[1::5] *= 1.1
    seen = seen._replace(intensity=seen.intensity - 0.2)
    optimizer = LmOptimizer(grid_of(grid), seen, seen, 1.0, np.eye(4))
    assert optimizer.cost(NEAR_SCALES) > 1  # since intensities count in the coarse stage, too
    optimizer.run()
    said, (distance, intensity) = optimizer.certainty(), optimizer.terms.residuals
    known = optimizer.terms.reliability
    off = np.abs(intensity - np.median(intensity))
    fits = (np.abs(distance) < 0.05) & (known > 0) & (off < 0.25)
    assert 0.5 < fits.mean() < 0.9
    expected = {"inlier_ratio": fits.mean(), "fitting_ratio": known[fits].sum() / known.sum()}
    expected |= {"known_ratio": known.mean(), "intensity_mad": np.median(off)}
    for name, value in expected.items():
        assert said[name] == pytest.approx(value, rel=0.01), name


def test_views_that_are_alike() -> None:
    """Catches brightness or contrast that count, depths that do not or that count little, and an
    order turned round."""
    frames = box_sequence([[0.0, 0.0, 0.0], [0.0, 0.0, 0.15], [0.0, 0.0, -0.4]], BoxRoom(), 96)
    views = torch.stack([view_of(frames[i]) for i in range(3)])
    cameras = frames.T_world_camera.copy()
    darker = view_of(Frame(frames.intrinsics, frames[1].color // 2, frames[1].depth_mm, cameras[1]))
    found = retrieve(darker, Viewpoints(cameras, views), 3)
    assert found[:, 2, 3].tolist() == [0.15, 0.0, -0.4]
    np.testing.assert_allclose(found[0], cameras[1], atol=1e-12)  # not turned
    deeper, unlike = views[0].clone(), views[0].clone()
    deeper[1] = (1.5 * deeper[1].float()).clamp(max=255).byte()
    unlike[0] = unlike[0].flip(0)
    found = retrieve(views[0], Viewpoints(cameras, torch.stack([deeper, unlike, views[0]])), 3)
    assert found[:, 2, 3].tolist() == [-0.4, 0.15, 0.0]


def test_a_view_shows_what_lies_where() -> None:
    """Catches directions that are off by a column or a row, a principal point that is left out, and
    another unit of depth: of a plane that leans, in units of 5 cm."""
    camera = Intrinsics(96, 72, 72.0, 72.0, 40.0, 42.0)
    rows, columns = np.indices((72, 96)) + 0.5
    depths = 2000 / (1 - 0.9 * (columns - 40) / 72 - 0.6 * (rows - 42) / 72)
    luma, depth = view_of(sequence_of(depths[None], camera)[0]).float().numpy()
    rows, columns = np.indices((15, 20))
    expected = 40 / (1 - 0.9 * 0.05 * (columns - 9.5) - 0.6 * 0.05 * (rows - 7))
    asked = (luma > 0) & (expected < 60)
    assert asked.sum() > 100
    assert np.abs(depth - expected)[asked].max() < 1.5


def test_how_far_a_map_is_off_by_hand() -> None:
    """Catches a pose that is inverted, a sign that counts, and frames that were not mapped: walls
    lie where the frames saw them, or 10 cm before or behind that."""
    poses = poses_at([[0.1, 0.05, -0.1]] * 3, [0.1, -0.3, 0.2])
    sequence = box_sequence(poses)
    assert depth_residual_of(BoxRoom(), sequence[0]) < 0.03  # rendered: as sharp as its samples
    for off in (-0.1, 0.1):
        grid = BakedField(BoxRoom(half=(1.0 + off, 0.8 + off, 1.2 + off)), 0.05)
        assert depth_residual_of(grid, sequence[0]) == pytest.approx(0.1, abs=2e-3)
    sequence.T_world_camera[0, 2, 3] += 0.5
    assert usual_depth_residual(BoxRoom(), sequence, np.array([1, 2])) < 0.03
