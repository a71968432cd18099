"""Formulas by laws that must hold, or against values worked by hand in another way."""

import math

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, box_sequence, narrow_room, poses_at, sequence_of
from scipy.spatial.transform import Rotation

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_optimizer import NEAR_SCALES, LmOptimizer
from nbtrack.beyond.lm_residuals import grid_of
from nbtrack.beyond.observed import draw_points, with_normals
from nbtrack.beyond.verdict import SIGMAS, p_lost, p_within, std_when_moved
from nbtrack.beyond.views import Viewpoints, retrieve, spread_out, view_of
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.frame import Frame
from nbtrack.data.pixels import PixelSampler
from nbtrack.recordings.reading import FAR, far_limit
from nbtrack.tracking import SdfSettings, StepBudget, VrSettings, make_tracker


def test_where_depths_become_outliers() -> None:
    """Catches another quantile: of a hundred depths the ninetieth decides."""
    assert far_limit(np.array([1.0] * 85 + [3.0] * 10 + [50.0] * 5)) == pytest.approx(3 * FAR)
    assert far_limit(np.array([])) == np.inf


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
    np.testing.assert_allclose(np.abs(quaternion[1:] / quaternion[0]), 1e-3, rtol=2e-3)
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
    (T_off,) = poses_at([[0.03, 0.02, -0.04]], [0.2, -0.3, 0.1])
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
    ahead = torch.from_numpy(T_off[:3, 2]).float()  # of a camera that is turned
    wall = Formula(lambda points: 500.0 * (points @ ahead > 2.0), wide, as_density=True)
    settings = VrSettings(n_pixels=200, lambda_color=0.0, lambda_depth=2.0, n_stratified=200)
    T_off[:3, 3] = 0
    tracker = make_tracker("vr", wall, T_off, StepBudget(1), settings)
    # Half a metre off, over the least deviation, 2 cm, of what is nearly a step.
    seen = Frame(camera, frame.color, torch.full_like(frame.depth_mm, 2500), T_off)
    assert tracker.track(seen).loss == pytest.approx(2 * 0.5 / 0.02, rel=0.1)


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
    """Catches directions that are off by a column or a row or lie beside the picture, a principal
    point that is left out, and another unit of depth: of a plane that leans, in units of 5 cm; and
    depth of cells that are just half measured, of 6 by 6 pixels."""
    depths = np.full((1, 72, 96), 2000)
    depths[:, :, ::2] = 0
    half = sequence_of(depths, Intrinsics(96, 72, 120.0, 120.0, 48.0, 33.0))
    assert not view_of(half[0])[1].any()
    camera = Intrinsics(96, 72, 120.0, 110.0, 40.0, 33.0)
    rows, columns = np.indices((72, 96)) + 0.5
    depths = 2000 / (1 - 0.9 * (columns - 40) / 120 - 0.6 * (rows - 33) / 110)
    depths[::2, ::2] = 0  # where nothing is measured nothing is averaged
    luma, depth = view_of(sequence_of(depths[None], camera)[0]).float().numpy()
    rows, columns = np.indices((15, 20))
    expected = 40 / (1 - 0.9 * 0.05 * (columns - 9.5) - 0.6 * 0.05 * (rows - 7))
    u, v = 40 + 6 * (columns - 9.5), 33 + 5.5 * (rows - 7)  # where the picture has them
    np.testing.assert_array_equal(luma > 0, (u > 0) & (u < 96) & (v > 0) & (v < 72))
    asked = (depth > 0) & (expected < 60)
    assert asked.sum() > 100
    assert np.abs(depth - expected)[asked].max() < 1.5


def test_how_a_pose_is_moved_by_hand() -> None:
    """Catches another length or direction of the motion, a turn that does not follow it, and a cost
    that does not grow with the square: by 10 cm along x, where the pose is least certain, a turn of
    0.25 rad a metre follows; then along y."""
    moved, covariance = [], np.diag([1e-6, 1e-6, 1e-4, 4e-4, 1e-4, 1e-6])
    covariance[2, 3] = covariance[3, 2] = 1e-4

    def costs_at(T: np.ndarray) -> np.ndarray:
        moved.append(T)
        return np.full(50, 0.5 + 2 * T[0, 3] ** 2 + T[1, 3] ** 2)

    for n_directions, growth in ((1, 2.0), (2, 1.0)):
        found = std_when_moved(costs_at, np.eye(4), covariance, n_directions, 20)
        assert found == pytest.approx(1 / (SIGMAS * (20 * growth + 4) ** 0.5))
    places = np.stack(moved)[1:3, :3, 3]
    np.testing.assert_allclose(places, places[0, 0] * np.array([[1, 0, 0], [-1, 0, 0]]), atol=1e-9)
    assert abs(places[0, 0]) == pytest.approx(0.1)
    turns = Rotation.from_matrix(np.stack(moved)[1:3, :3, :3]).as_rotvec()
    np.testing.assert_allclose(turns, 0.25 * places[:, [1, 2, 0]], atol=1e-9)


def test_points_know_no_unit_and_have_the_normals_of_mapping() -> None:
    """Catches edges in millimetres, and normals of a pixel beside: of a wavy surface with edges."""
    rows, columns = np.indices((72, 96))
    waves = 2000 + 350 * np.sin(rows / 3) + 99 * np.sin(columns / 2) + 900 * (columns > 50)
    depths_mm = np.stack([waves.round(), 2 * waves.round()])
    frames = sequence_of(depths_mm, Intrinsics(96, 72, 70.0, 75.0, 45.0, 38.0))
    seen, far = (draw_points(frames[i], 900, torch.Generator().manual_seed(0)) for i in (0, 1))
    np.testing.assert_allclose(far.points, 2 * seen.points)
    u, v = (seen.points[:, :2] / seen.points[:, 2:] * [70, 75] + [45, 38]).T
    columns, rows = (torch.from_numpy(x - 0.5).round().long() for x in (u, v))
    sampler = PixelSampler(frames, torch.device("cpu"))
    expected = sampler.normals_camera(torch.zeros_like(rows), rows, columns)
    np.testing.assert_allclose(with_normals(frames[0], seen, 900)[2], expected, atol=1e-3)


def test_poses_are_spread_by_place_and_optical_axis() -> None:
    """Catches the nearest in place of the farthest, and turns about the optical axis that count."""
    poses = poses_at(np.zeros((4, 3)), [[0.5, 0.0, 0.0]] * 4)
    poses[1, :3, :3] @= Rotation.from_rotvec([0.0, 0.0, 3.0]).as_matrix()
    poses[2, :3, :3] @= Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    poses[3, :3, 3] = [0.2, 0.0, 0.0]
    assert spread_out(poses).tolist() == [0, 2, 3, 1]


@pytest.mark.parametrize("turn", [[0.14, 0.0, 0.0], [-0.14, 0.0, 0.0], [0.0, 0.3, 0.0]])
def test_a_view_is_found_from_a_turned_camera(turn: list[float]) -> None:
    """Catches a turn of the wrong sign or axis."""
    poses = poses_at([[0.0, 0.0, -0.3]] * 2, [[0.0, 0.0, 0.0], turn])
    frames = box_sequence(poses, BoxRoom(), 96)
    known = Viewpoints(poses[:1].copy(), view_of(frames[0])[None])
    (found,) = retrieve(view_of(frames[1]), known, 1)
    assert Rotation.from_matrix(found[:3, :3].T @ poses[1, :3, :3]).magnitude() < 0.03


def test_brightness_and_what_is_not_measured_make_no_view_unlike() -> None:
    """Catches a mean that is left in, and depths of nothing: the same with noise comes after the
    same in bright light, and a view that is measured less is as much like."""
    noise = torch.Generator().manual_seed(0)
    dark = torch.randint(1, 11, (2, 15, 20), generator=noise).byte()
    dark[1] = 40
    bright, noisy, deeper, half = (dark.clone() for _ in range(4))
    bright[0] += 200
    noisy[0] += torch.randint(0, 9, (15, 20), generator=noise).byte()
    deeper[1] += 1
    half[1, :7] = 0
    cameras = poses_at(np.outer(range(4), [1.0, 0.0, 0.0]))
    found = retrieve(dark, Viewpoints(cameras, torch.stack([noisy, deeper, half, bright])), 4)
    assert found[:, 0, 3].tolist() in ([2, 3, 1, 0], [3, 2, 1, 0])
