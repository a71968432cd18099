"""The compiled solver against its formulas in plain numpy, differences, and values by hand."""

from functools import partial

import numpy as np
import pytest
import torch
from box_room import PLANES, BoxRoom, Formula, narrow_room, plane_depths, walk

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_optimizer import COARSE, FINE, LmOptimizer
from nbtrack.beyond.lm_residuals import Problem, Stage, grid_of, residual_terms
from nbtrack.beyond.lm_solver import (
    damped_step,
    normal_equations,
    point_costs,
    retract,
    robust_cost,
    robust_scales,
    try_step,
)
from nbtrack.beyond.observed import LUMA, Observed, draw_points
from nbtrack.beyond.verdict import SIGMAS, std_when_moved
from nbtrack.core.bounds import SceneBounds
from nbtrack.fields import NetworkSettings, make_field

BOX = SceneBounds((-1.0, -1.2, -0.8), (1.0, 1.2, 0.8))
ROOM = BakedField(BoxRoom(), 0.05)  # known better here, worse there, as corrected grids are
ROOM.volume[4] = torch.rand(len(ROOM.volume.T), generator=torch.Generator().manual_seed(1))
NETWORK = BakedField(make_field("neus", NetworkSettings(width=32), BOX, seed=3), 0.1)
RANDOM = np.random.default_rng(0)
POINTS, LUMAS = RANDOM.uniform(-1.2, 1.2, (400, 3)), RANDOM.uniform(0, 1, 400)
NORMALS = POINTS[:, ::-1] / np.linalg.norm(POINTS, axis=1, keepdims=True)
NONE, ORIGIN = np.empty((0, 3)), np.eye(4)
POSE = retract(ORIGIN, np.array([0.3, -0.2, 0.4, 0.2, -0.1, 0.3]))
START = retract(POSE, np.array([0.0, 0.1, 0.2, 0.1, -0.3, 0.0]))


def asked(field: BakedField, points: np.ndarray) -> list[np.ndarray]:
    """Distance and intensity of a field in double precision, with their gradients by torch."""
    x = torch.from_numpy(points).requires_grad_()
    color, value = field.double()(x)
    parts = [value, color @ torch.tensor(LUMA, dtype=torch.float64)]
    gradients = [torch.autograd.grad(part.sum(), x, retain_graph=True)[0] for part in parts]
    field.float()
    return [part.detach().numpy() for part in (*parts, *gradients)]


@pytest.mark.parametrize("field", [ROOM, NETWORK], ids=["room", "network"])
@pytest.mark.parametrize("stage", [COARSE, FINE])
def test_terms_and_sums_are_the_formulas(field: BakedField, stage: Stage) -> None:
    """Catches a swapped axis or channel, points that pull from outside or towards a surface that
    faces elsewhere, distances that grow too fast taken as they are, another weight, scale, cost or
    prior than the module states; once with normals, once with confidences."""
    normals, weight, grid = NONE if stage.is_fine else NORMALS, 0.7, grid_of(field)
    problem = Problem(Observed(POINTS, LUMAS, normals), grid, stage, weight, START)
    terms = residual_terms(problem, POSE)
    R, t = POSE[:3, :3], POSE[:3, 3]
    a = POINTS @ R.T
    x = a + t
    f, intensity, df, di = asked(field, x)
    g = np.linalg.norm(df, axis=1)
    low, high = (np.array(corner) for corner in (field.bounds.minimum, field.bounds.maximum))
    w = ((x > low - 0.3) & (x < high + 0.3)).all(axis=1) & (g > 0.3) & (g < 2)
    assert 0.1 < w.mean() < 0.95
    w = w / (1 + ((g - 1) / 0.5) ** 2) ** 2
    if stage.is_fine:
        w = w * field.channels(torch.from_numpy(x).float())[4].numpy()
    else:
        w = w * ((normals @ R.T * df).sum(axis=1) / np.maximum(g, 0.3)).clip(0) ** 2
    g = np.maximum(g, 0.3)[:, None]
    r, q = np.stack([f / g[:, 0], intensity - LUMAS]), np.stack([df / g, di])
    np.testing.assert_allclose([*terms.residuals, terms.reliability], [*r, w], atol=2e-5)
    scales = robust_scales(terms.residuals, np.full(2, np.inf), grid.accuracy.residual_sigma, 3.0)
    np.testing.assert_allclose(scales, 3 * np.median(abs(r), axis=1), rtol=0.02)
    square = (r / scales[:, None]) ** 2
    rho = square / (1 + square)
    cost = (w * (rho[0] + weight * rho[1]) + (1 - w) * (1 + weight)).mean()
    found = robust_cost(terms.residuals, terms.reliability, scales, weight)
    assert found == pytest.approx(cost, rel=1e-5)
    assert point_costs(terms, scales, weight).mean() == pytest.approx(cost, rel=1e-5)
    J = np.concatenate([np.cross(a, q), q], axis=-1)  # of both residuals, n x 6
    W = w * np.array([[1], [weight]]) / (scales[:, None] * (1 + square)) ** 2
    H, b = np.einsum("kna,kn,knb->ab", J, W, J), np.einsum("kna,kn,kn->a", J, W, r)
    for sums, expected in zip(normal_equations(terms, scales, weight), (H, b), strict=True):
        np.testing.assert_allclose(sums, expected, atol=1e-5 * abs(H).max())
    turn = R @ START[:3, :3].T
    sines = (turn - turn.T)[[2, 0, 1], [1, 2, 0]] / 2
    A = H + 4 * np.eye(6) + 0.1 * np.diag(H.diagonal())
    twist = -np.linalg.solve(A, b + 4 * np.concatenate([sines, t - START[:3, 3]]))
    np.testing.assert_allclose(damped_step(problem, POSE, terms, scales, 0.1), twist, atol=1e-4)


def test_scales_only_fall() -> None:
    """Catches scales that widen again, which would let outliers back in, or shrink to nothing."""
    residuals, accuracy = np.array([[0.01, -0.04, 0.5], [0, 0, 0]]), np.array([0.02, 0.05])
    found = robust_scales(residuals, np.full(2, np.inf), accuracy, 3.0)
    np.testing.assert_allclose(found, [0.12, 0.05])
    found = robust_scales(residuals, np.full(2, 0.06), accuracy, 3.0)
    np.testing.assert_allclose(found, [0.06, 0.05])


def test_retract_turns_about_the_camera_and_is_finite_at_zero() -> None:
    """Catches a rotation about the world's origin, and 0/0 in the exponential map."""
    np.testing.assert_array_equal(retract(POSE, np.zeros(6)), POSE)
    turned = retract(POSE, np.array([0.0, 0.0, np.pi / 2, 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(turned[:3, 3], POSE[:3, 3] + [0.1, 0, 0])
    np.testing.assert_allclose(turned[:3, 0], [-POSE[1, 0], POSE[0, 0], POSE[2, 0]], atol=1e-12)


@pytest.mark.parametrize(("free_m", "low", "high"), [(0.07, 0, 0.02), (0.2, 0.1, 0.3)])
def test_a_pose_is_held_where_it_cannot_slide_far(free_m: float, low: float, high: float) -> None:
    """Catches doubts about a pose that may slide one way by less than 10 cm, certainty about one
    that may slide farther, and a certainty that grows with points beyond the independent ones."""

    def costs_at(T: np.ndarray, n_points: int) -> np.ndarray:
        return np.full(n_points, 0.0 if -1e-9 <= T[0, 3] <= free_m else 0.5)

    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-2, 1e-6, 1e-6])
    stds = [
        std_when_moved(partial(costs_at, n_points=n), np.eye(4), covariance, 1, 256)
        for n in (256, 4096)
    ]
    assert low < stds[0] < high
    assert stds[0] == stds[1]


# Least and largest standard deviations (m) in a scene of planes.
STDS = [("wall", 0.01, 1), ("floor", 0.2, 1), ("corridor", 0.2, 1), ("corner", 0, 0.01)]


@pytest.mark.parametrize(("scene", "low", "high"), STDS)
def test_ripples_of_a_map_hold_nothing(scene: str, low: float, high: float) -> None:
    """Catches a standard deviation of centimetres where only the noise of the map's colours has a
    slope along what is seen; and doubts where three planes hold the camera."""
    (planes, _), random = PLANES[scene], np.random.default_rng(3)
    normals, distances = torch.tensor([*planes]).float(), torch.tensor([*planes.values()])
    bounds = SceneBounds((-1.2, -1.2, -0.2), (1.2, 1.2, 2.0))
    surface = Formula(lambda p: (distances - p @ normals.T).amin(dim=1), bounds)
    field = BakedField(surface, 0.05)
    field.volume[:3] += torch.from_numpy(random.normal(scale=0.003, size=field.volume[:3].shape))
    rays = np.insert(random.uniform(-1, 1, (2000, 2)), 2, 1, axis=1)
    depths = plane_depths(planes, rays)[:, None]
    points = (depths * rays)[(depths < 2).all(axis=1)][:500]
    seen = Observed(points, 0.5 + random.normal(scale=0.006, size=len(points)), NONE)
    optimizer = LmOptimizer(grid_of(field), seen, seen, 1.0, ORIGIN)
    optimizer.run()
    assert low < optimizer.certainty()["position_std_m"] < high


def test_a_pose_between_steps_of_colour_is_not_held_along_a_corridor() -> None:
    """Catches a spread by curvature that does not count, in another unit, or of the turn: nothing
    holds a camera for some centimetres along stripes whose edges no point lies at."""
    (planes, _), random = PLANES["corridor"], np.random.default_rng(0)
    normals, distances = torch.tensor([*planes]).float(), torch.tensor([*planes.values()])
    surface = Formula(
        lambda p: (distances - p @ normals.T).amin(dim=1),
        SceneBounds((-1.0, -0.2, 0.2), (1.0, 1.1, 1.8)),
        lambda p: 0.5 + 0.3 * (20 * torch.sin(np.pi * p[:, 2:] / 0.2)).tanh().expand(-1, 3),
    )
    rays = np.insert(random.uniform(-1, 1, (3000, 2)), 2, 1, axis=1)
    points = plane_depths(planes, rays)[:, None] * rays
    at_edge = np.abs(np.sin(np.pi * points[:, 2] / 0.2))
    points = points[(at_edge > 0.9) & (points[:, 2] < 1.6) & (points[:, 2] > 0.4)][:400]
    seen = Observed(points, 0.5 + 0.3 * np.sign(np.sin(np.pi * points[:, 2] / 0.2)), NONE)
    optimizer = LmOptimizer(grid_of(BakedField(surface, 0.025)), seen, seen, 1.0, ORIGIN)
    optimizer.run()
    # As the prior alone has it: 0.5 m, of which scales are two.
    assert optimizer.certainty()["position_std_m"] == pytest.approx(0.5 / SIGMAS, rel=0.03)


SEEN = draw_points(walk(1, narrow_room())[0], 300, torch.Generator().manual_seed(0))
NARROW = grid_of(BakedField(narrow_room(), 0.05))


def test_a_rejected_step_leaves_the_pose_unchanged() -> None:
    """Catches steps that are taken although the cost rises, as every step at the optimum does, and
    a search that goes on after a short one."""
    optimizer = LmOptimizer(NARROW, SEEN, SEEN, 1.0, ORIGIN)
    for is_fine in (False, True):
        while not optimizer.is_ended:
            T, damping = optimizer.T_world_camera, optimizer.damping
            optimizer.step()
            assert (optimizer.damping > damping) == (optimizer.T_world_camera is T)
            assert optimizer.is_ended or optimizer.last_step >= optimizer.problem.stage.min_step
        assert optimizer.is_finished is is_fine
        optimizer.refine()
    assert abs(optimizer.T_world_camera - ORIGIN).max() < 2e-3


def test_steps_that_creep_are_lengthened() -> None:
    """Catches a limit of the series that is missed, another one, and steps that are lengthened
    although they shrink fast, turn round or turn aside: of steps that damping makes short."""
    problem, T = Problem(SEEN, NARROW, FINE, 1.0, ORIGIN), retract(ORIGIN, np.full(6, 0.01))
    terms = residual_terms(problem, T)
    scales = robust_scales(terms.residuals, np.full(2, np.inf), NARROW.accuracy.residual_sigma, 3)
    twist = damped_step(problem, T, terms, scales, 30.0)
    aside = twist[[1, 0, 3, 2, 5, 4]] * [1, -1, 1, -1, 1, -1]
    series = {0.8: 5, 0.95: 10, 0.6: 2.5, 0.4: 1, -0.8: 1}
    before = [(twist / ratio, stride) for ratio, stride in series.items()]
    for last_twist, stride in [*before, (twist + 1.1 * aside, 1), (np.zeros(6), 1)]:
        is_better, after, *_, length, _ = try_step(problem, T, terms, scales, 30.0, last_twist)
        assert is_better
        np.testing.assert_allclose(after, retract(T, stride * twist), atol=1e-12)
        assert length == pytest.approx(stride * abs(twist).max())


def test_scales_are_never_below_those_of_the_map() -> None:
    """Catches a tracker that takes what a worse map leaves for outliers."""
    accuracy = NARROW.accuracy._replace(residual_sigma=(0.2, 0.5))
    optimizer = LmOptimizer(NARROW._replace(accuracy=accuracy), SEEN, SEEN, 1.0, ORIGIN)
    np.testing.assert_allclose(optimizer.scales, [0.2, 0.5])


def test_a_coarse_stage_that_leads_astray_is_undone() -> None:
    """Catches a good start that is given up for a worse pose: something stands before two fifths
    of the coarse points, which pull the camera tens of centimetres away."""
    points, random = SEEN.points.copy(), np.random.default_rng(0)
    points *= 1 + random.normal(scale=0.01, size=(len(points), 1))
    points[points[:, 0] < np.quantile(points[:, 0], 0.4)] *= 0.8
    optimizer = LmOptimizer(NARROW, SEEN._replace(points=points), SEEN, 1.0, ORIGIN)
    optimizer.run_stage()
    assert abs(optimizer.T_world_camera - ORIGIN).max() > 0.2
    optimizer.refine()
    np.testing.assert_array_equal(optimizer.T_world_camera, ORIGIN)


def test_what_is_no_number_stays_none() -> None:
    """Catches compiled sums that turn NaN into a pose, and reads outside of the grid."""
    grid = grid_of(ROOM)
    problem = Problem(Observed(POINTS, LUMAS, NONE), grid, FINE, 1.0, ORIGIN)
    terms = residual_terms(problem, np.full((4, 4), np.nan))
    cost = robust_cost(terms.residuals, terms.reliability, grid.accuracy.residual_sigma, 1.0)
    assert np.isnan(cost) or not terms.reliability.any()
    sums = normal_equations(terms, grid.accuracy.residual_sigma, 1.0)
    assert np.isnan(sums[0]).any() or not terms.reliability.any()


def test_points_are_drawn_away_from_borders_and_edges() -> None:
    """Catches points whose depth may belong to either side of an edge, and draws that do not follow
    the seed."""
    frame = walk(1)[0]
    frame.depth_mm[:, :16], frame.depth_mm[:, 16:], frame.depth_mm[3:6] = 1000, 2000, 0
    draws = [draw_points(frame, 400, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    (points, luma, _), (again, *_), (other, *_) = draws
    np.testing.assert_array_equal(points, again)
    assert not np.array_equal(points, other)
    columns, rows = (points[:, :2] / points[:, 2:] * 24 + [16, 12] - 0.5).T.round().astype(int)
    assert {*columns} == {*range(1, 15), *range(17, 31)}
    assert {*rows} == {1, *range(7, 23)}
    np.testing.assert_allclose(luma, frame.color[rows, columns].numpy() / 255 @ LUMA, atol=1e-6)
    assert len(draw_points(walk(1)[0], 400, torch.Generator())[0]) == 400


def test_points_are_spread_evenly() -> None:
    """Catches a sequence that repeats itself or leaves gaps: any beginning covers the image."""
    points = draw_points(walk(1)[0], 400, torch.Generator().manual_seed(0))[0]
    columns, rows = (points[:, :2] / points[:, 2:] * 24 + [16, 12] - 1).T
    tiles = (rows / 22 * 6).astype(int) * 6 + (columns / 30 * 6).astype(int)
    for n in (100, 400):
        std = np.bincount(tiles[:n], minlength=36).std()
        assert std < 0.6 * (n / 36) ** 0.5  # random pixels: about once
