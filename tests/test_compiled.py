"""The compiled search: the same sums as the plain one, the same points, and a way on without it."""

import sys

import numpy as np
import pytest
import torch
from box_room import BoxRoom, narrow_room, walk

from nbtrack.fields.grid import BakedField
from nbtrack.tracking import LmSettings, LmTracker, StepBudget, compiled, kernels, registration
from nbtrack.tracking.compiled import CompiledSearch
from nbtrack.tracking.lm import search_kind
from nbtrack.tracking.search import Search

GRID, EXACT = BakedField(BoxRoom(), 0.05), BakedField(BoxRoom(), 0.05).double()
for grid in (GRID, EXACT):  # known better here, worse there, as corrected grids are
    grid.volume[4] = torch.rand(len(grid.volume.T), generator=torch.Generator().manual_seed(1))
OBSERVED = torch.rand(300, 4, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2
NORMALS = torch.nn.functional.normalize(OBSERVED[:, 1:] - 0.3, dim=-1).double().numpy()
NUMPY = OBSERVED[:, :3].double().numpy(), OBSERVED[:, 3].double().numpy(), NORMALS
TWIST = torch.tensor([0.3, -0.2, 0.4, 0.2, -0.1, 0.3], dtype=torch.float64)


@pytest.mark.parametrize(("near", "n_normals"), [(False, 0), (True, 0), (False, 300)])
def test_the_sums_are_those_of_registration(near: bool, n_normals: int) -> None:
    """Catches a swapped axis or channel, points outside that pull, another weight, scale, cost,
    pull or rotation than the functions whose mathematics is read and tested."""
    seen = *NUMPY[:2], NORMALS[:n_normals]
    start = torch.eye(4, dtype=torch.float64)
    pose = registration.moved(start, TWIST)
    np.testing.assert_allclose(kernels.moved(start.numpy(), TWIST.numpy()), pose, atol=1e-12)
    grid, least = compiled._arrays_of(GRID)
    rows = kernels.residual_rows(seen, pose.numpy(), grid, near)
    observed = tuple(torch.from_numpy(part) for part in seen)
    plain = registration.residuals_at(EXACT, observed, pose, near)
    assert 0.1 < (plain.reliability > 0).float().mean() < 0.9  # some outside, some in between
    np.testing.assert_allclose(rows[:2], plain.value, atol=1e-6)
    np.testing.assert_allclose(rows[2], plain.reliability, atol=1e-5)
    scales = kernels.scales_of(rows, np.full(2, np.inf), least, 3.0)
    expected = registration.scales_of(plain, torch.full((2,), np.inf), torch.tensor(GRID.accuracy))
    np.testing.assert_allclose(scales, expected, rtol=1e-5)
    state = expected, 0.7
    cost = registration.robust_cost(plain, *state)
    assert kernels.robust_cost(rows, scales, 0.7) == pytest.approx(cost.item(), rel=1e-6)
    sums = kernels.normal_equations(rows, scales, 0.7)
    for found, wanted in zip(sums, registration.normal_equations(plain, *state), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6 * abs(sums[0]).max())
    twist = kernels.damped_step(rows, scales, 0.7, start.numpy(), pose.numpy(), 0.1)
    step = registration.damped_step(plain, *state, start, pose, 0.1)
    np.testing.assert_allclose(twist, step, atol=1e-5)


def test_normals_of_planes() -> None:
    """Catches a wrong sign, axis or focal length: planes that lean to a side, or overhead."""
    frame = walk(1)[0]
    y, x = torch.meshgrid(torch.arange(24) - 11.5, torch.arange(32) - 15.5, indexing="ij")
    for normal in torch.tensor([[0.6, 0.0, -0.8], [0.0, -0.6, -0.8]]):
        depth = -48_000 / (normal[0] * x + normal[1] * y + normal[2] * 24)
        frame.depth_mm[:] = depth.round().int()
        points, _ = CompiledSearch.draw(frame, 300, torch.Generator())
        normals = torch.from_numpy(CompiledSearch.normals(frame, points)).float()
        assert (normals - normal).abs().max() < 0.02
    frame.depth_mm[:, ::2] *= 2
    assert not CompiledSearch.normals(frame, points).any()  # each has an edge beside it


def test_steps_are_those_of_the_plain_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches another rule for steps that are taken, and points that count more than there."""
    frame = walk(2, narrow_room())[1]
    T_start = registration.moved(torch.eye(4).double(), 0.1 * TWIST)
    points, luma = CompiledSearch.draw(frame, 300, torch.Generator().manual_seed(0))
    normals = CompiledSearch.normals(frame, points)
    levels = (points, luma, normals), (points, luma, normals[:0])
    tensors = tuple(tuple(torch.from_numpy(part) for part in level) for level in levels)
    monkeypatch.setattr(Search, "first_medians", CompiledSearch.first_medians)
    fast = CompiledSearch(BakedField(narrow_room(), 0.05), levels, LmSettings(), T_start)
    slow = Search(BakedField(narrow_room(), 0.05).double(), tensors, LmSettings(), T_start)
    for number in range(5):
        if number == 2:
            fast.begin(1)
            slow.begin(1)
        assert fast.step() == pytest.approx(slow.step(), rel=1e-4)
        np.testing.assert_allclose(fast.T_world_camera, slow.T_world_camera, atol=1e-5)
        assert fast.damping == pytest.approx(slow.damping)


def test_what_is_no_number_stays_none() -> None:
    """Catches compiled sums that turn NaN into a pose, and reads outside of the grid."""
    grid, least = compiled._arrays_of(GRID)
    rows = kernels.residual_rows(NUMPY, np.full((4, 4), np.nan), grid, True)
    assert np.isnan(kernels.robust_cost(rows, least, 1.0)) or not rows[2].any()
    assert np.isnan(kernels.normal_equations(rows, least, 1.0)[0]).any() or not rows[2].any()


@pytest.mark.parametrize("kind", [Search, CompiledSearch])
def test_points_are_drawn_away_from_borders_and_edges(kind: type[Search]) -> None:
    """Catches points whose depth may belong to either side of an edge, and draws that do not follow
    the seed, or that differ between both kinds of search."""
    frame = walk(1)[0]
    frame.depth_mm[:, :16], frame.depth_mm[:, 16:], frame.depth_mm[3:6] = 1000, 2000, 0
    kinds = (kind, 1), (CompiledSearch, 1), (kind, 2)
    draws = [k.draw(frame, 400, torch.Generator().manual_seed(seed)) for k, seed in kinds]
    (points, luma), (again, _), (other, _) = (map(np.asarray, draw) for draw in draws)
    np.testing.assert_allclose(points, again, atol=1e-6)
    assert not np.array_equal(points, other)
    columns, rows = (points[:, :2] / points[:, 2:] * 24 + [16, 12] - 0.5).T.round().astype(int)
    assert {*columns} == {*range(1, 15), *range(17, 31)}
    assert {*rows} == {1, *range(7, 23)}
    color = frame.color[rows, columns].numpy() / 255
    np.testing.assert_allclose(luma, color @ [0.299, 0.587, 0.114], atol=1e-6)
    assert len(kind.draw(walk(1)[0], 400, torch.Generator())[0]) == 400


def test_points_are_spread_evenly() -> None:
    """Catches a sequence that repeats itself or leaves gaps: any beginning covers the image."""
    points, _ = walk(1)[0].smooth_points(400, torch.Generator().manual_seed(0))
    columns, rows = (points[:, :2] / points[:, 2:] * 24 + torch.tensor([16, 12]) - 1).T
    tiles = (rows / 22 * 6).long() * 6 + (columns / 30 * 6).long()
    for n in (100, 400):
        deviation = torch.bincount(tiles[:n], minlength=36).float().std()
        assert deviation < 0.6 * (n / 36) ** 0.5  # random pixels: about once


def test_without_numba_torch_does_it_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Catches a machine on which grids cannot be tracked in, and a slow search nobody mentions."""
    frames, grid = walk(3, narrow_room()), BakedField(narrow_room(), 0.05)
    settings = LmSettings(n_pixels=256)
    fast = LmTracker(grid, np.eye(4), StepBudget(20), settings)
    assert fast.search_kind is CompiledSearch
    estimates = [fast.track(frames[index]) for index in (1, 2)]
    monkeypatch.setitem(sys.modules, "nbtrack.tracking.compiled", None)
    slow = LmTracker(grid, np.eye(4), StepBudget(20), settings)
    assert "numba does not work here" in capsys.readouterr().err
    assert slow.search_kind is Search is search_kind(narrow_room())
    for found in estimates, [slow.track(frames[index]) for index in (1, 2)]:
        poses = np.stack([estimate.T_world_camera for estimate in found])
        assert np.abs(poses - frames.T_world_camera[1:]).max() < 2e-3
