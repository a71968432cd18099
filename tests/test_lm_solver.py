"""The compiled solver against its formulas in plain numpy, differences, and values by hand."""

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, narrow_room, walk

from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.lm_optimizer import COARSE, LmOptimizer
from nbtrack.beyond.lm_residuals import Grid, Problem, Terms, grid_of, residual_terms
from nbtrack.beyond.lm_solver import (
    damped_step,
    normal_equations,
    point_costs,
    retract,
    robust_cost,
    robust_scales,
)
from nbtrack.beyond.observed import LUMA, Observed, draw_points, with_normals
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


def asked(field: BakedField, points: np.ndarray) -> list[np.ndarray]:
    """Distance and intensity of a field in double precision, with their gradients by torch."""
    x = torch.from_numpy(points).requires_grad_()
    color, value = field.double()(x)
    parts = [value, color @ torch.tensor(LUMA, dtype=torch.float64)]
    gradients = [torch.autograd.grad(part.sum(), x, retain_graph=True)[0] for part in parts]
    field.float()
    return [part.detach().numpy() for part in (*parts, *gradients)]


def terms_at(grid: Grid, points, lumas, normals=NONE, T=ORIGIN, is_fine: bool = False) -> Terms:
    return residual_terms(Problem(Observed(points, lumas, normals), grid, is_fine, 1.0, ORIGIN), T)


def wall(slope: float = 1.0) -> Grid:
    """The plane z = 0.5 seen from below, as a distance that grows `slope` times too fast."""
    gray = torch.tensor([[0.2] * 3, [0.0] * 3, [0.0] * 3])
    field = Formula(lambda p: slope * (0.5 - p[:, 2]), BOX, lambda p: 0.5 + p @ gray)
    return grid_of(BakedField(field, 0.1))


def at_wall(grid: Grid, depths: list[float], normals: np.ndarray = NONE, T=ORIGIN) -> Terms:
    points = np.array([[0.0, 0.0, depth] for depth in depths])
    return terms_at(grid, points, np.full(len(points), 0.5), normals, T)


@pytest.mark.parametrize("field", [ROOM, NETWORK], ids=["room", "network"])
@pytest.mark.parametrize("is_fine", [False, True])
def test_terms_and_sums_are_the_formulas(field: BakedField, is_fine: bool) -> None:
    """Catches a swapped axis or channel, points outside that pull, another weight, scale, cost or
    prior than the module states; once with normals, once with confidences."""
    normals, weight, grid = NONE if is_fine else NORMALS, 0.7, grid_of(field)
    problem = Problem(Observed(POINTS, LUMAS, normals), grid, is_fine, weight, ORIGIN)
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
    if is_fine:
        w = w * field.confidence(torch.from_numpy(x).float()).numpy()
    else:
        w = w * ((normals @ R.T * df).sum(axis=1) / np.maximum(g, 0.3)).clip(0) ** 2
    g = np.maximum(g, 0.3)[:, None]
    r, q = np.stack([f / g[:, 0], intensity - LUMAS]), np.stack([df / g, di])
    np.testing.assert_allclose([*terms.residuals, terms.reliability], [*r, w], atol=2e-5)
    scales = robust_scales(terms.residuals, np.full(2, np.inf), grid.residual_sigma, 3.0)
    np.testing.assert_allclose(scales, 3 * np.median(abs(r), axis=1), rtol=0.02)
    square = (r / scales[:, None]) ** 2
    rho = square / (1 + square)
    cost = (w * (rho[0] + weight * rho[1]) + (1 - w) * (1 + weight)).mean()
    found = robust_cost(terms.residuals, terms.reliability, scales, weight)
    assert found == pytest.approx(cost, rel=1e-5)
    J = np.concatenate([np.cross(a, q), q], axis=-1)  # of both residuals, n x 6
    W = w * np.array([[1], [weight]]) / (scales[:, None] * (1 + square)) ** 2
    H, b = np.einsum("kna,kn,knb->ab", J, W, J), np.einsum("kna,kn,kn->a", J, W, r)
    for sums, expected in zip(normal_equations(terms, scales, weight), (H, b), strict=True):
        np.testing.assert_allclose(sums, expected, atol=1e-5 * abs(H).max())
    sines = (R - R.T)[[2, 0, 1], [1, 2, 0]] / 2
    A = H + 4 * np.eye(6) + 0.1 * np.diag(H.diagonal())
    twist = -np.linalg.solve(A, b + 4 * np.concatenate([sines, t]))
    np.testing.assert_allclose(damped_step(problem, POSE, terms, scales, 0.1), twist, atol=1e-4)


def test_derivatives_against_finite_differences() -> None:
    """Catches a wrong lever arm, order or sign of the twist, and gradients that are not those of
    the grid's own interpolant: residuals of torch's interpolation at poses a little to either
    side, with the gradient norm held fixed, as the derivative is defined."""
    terms = terms_at(grid_of(NETWORK), POINTS, LUMAS, T=POSE)
    usable, step = terms.reliability > 0, 1e-6
    norm = np.linalg.norm(asked(NETWORK, POINTS @ POSE[:3, :3].T + POSE[:3, 3])[2], axis=1)
    gradients = terms.gradients.swapaxes(1, 2)
    jacobian = np.concatenate([np.cross(terms.lever_arms.T, gradients), gradients], axis=-1)
    for axis, twist in enumerate(step * np.eye(6)):
        poses = retract(POSE, twist), retract(POSE, -twist)
        after, before = (asked(NETWORK, POINTS @ T[:3, :3].T + T[:3, 3]) for T in poses)
        change = [(x - y) / (2 * step) for x, y in zip(after[:2], before[:2], strict=True)]
        off = jacobian[..., axis] - np.stack([change[0] / norm, change[1]])
        # A point may sit on a border between cells, where the gradient jumps.
        assert np.quantile(abs(off[:, usable]), 0.99) < 1e-4


def test_a_field_that_grows_too_fast_is_corrected() -> None:
    """Catches distances taken as they are: with gradient norm 1.3 a step would be 30 % too long."""
    terms = at_wall(wall(1.3), [0.2])
    assert terms.residuals[:, 0].tolist() == pytest.approx([0.3, 0], abs=1e-5)
    assert terms.reliability.tolist() == pytest.approx([(1 + 0.6**2) ** -2], abs=1e-5)
    assert terms.gradients[0, :, 0].tolist() == pytest.approx([0, 0, -1], abs=1e-5)


def test_points_count_by_how_far_their_normals_agree() -> None:
    """Catches points that pull towards a surface that faces elsewhere, normals that do not turn
    with the camera, and unknown ones that count: cosines of 1, 1/2, -1, and none."""
    normals = np.array([[0.0, 0.0, -1.0], [0.75**0.5, 0.0, -0.5], [0.0, 0.0, 1.0], [0, 0, 0]])
    reliability = at_wall(wall(), [0.2] * 4, normals).reliability
    assert reliability.tolist() == pytest.approx([1, 0.25, 0, 0])
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    terms = at_wall(wall(), [0.2] * 4, normals, upside_down)
    assert terms.reliability.tolist() == pytest.approx([0, 0, 1, 0])


def test_points_out_of_bounds_cost_the_most_and_pull_nowhere() -> None:
    """Catches a pose that gets cheaper by carrying points out of the map."""
    terms, scales = at_wall(wall(), [0.4, 5.0]), np.array([0.1, 1.0])
    assert terms.reliability.tolist() == pytest.approx([1, 0])
    # First point: one scale off, cost 1/2; second: the worst, 1; intensities: 0 and the worst, 1.
    cost = robust_cost(terms.residuals, terms.reliability, scales, 1.0)
    assert cost == pytest.approx((0.5 + 2) / 2, abs=1e-5)
    alone = at_wall(wall(), [0.4])
    both, one = (normal_equations(part, scales, 1.0) for part in (terms, alone))
    np.testing.assert_allclose(both[0], one[0])
    # Worked by hand: weight 1/4, derivative 1 along z, scale 0.1.
    assert both[0][5, 5] == pytest.approx(0.25 / 0.01, rel=1e-4)
    assert both[1][5] == pytest.approx(-0.25 * 0.1 / 0.01, rel=1e-4)


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


def test_the_pose_prior_goes_back_to_the_start() -> None:
    """Catches a prior that enters the curvature alone: where the frame says nothing, a step must
    undo turn and offset from the start, but for the sine of the angle."""
    twist = np.array([0.0, 0.0, 0.2, 0.1, -0.3, 0.0])
    problem = Problem(Observed(POINTS[:1], LUMAS[:1], NONE), wall(), False, 1.0, POSE)
    nothing = Terms(*(0 * part for part in residual_terms(problem, POSE)))
    found = damped_step(problem, retract(POSE, twist), nothing, np.ones(2), 0.0)
    np.testing.assert_allclose(found, -np.array([0, 0, np.sin(0.2), 0.1, -0.3, 0]), atol=1e-9)


def test_a_single_plane_leaves_three_directions_open() -> None:
    """Catches a covariance or condition that hides a slide along the only wall in view."""
    seen = Observed(0.6 * POINTS, LUMAS, NONE)
    found = LmOptimizer(wall(), seen, seen, 0.0, POSE).certainty()
    assert found["condition_number"] > 1e6
    # Along the wall the position is as uncertain as the prior allows.
    assert found["position_std_m"] == pytest.approx(0.5 / (3 * 0.6745), rel=0.01)


def rippled(surface, amplitude: float) -> Grid:
    """Surfaces by their distance, with a colour that ripples by noise, as a learned one does."""
    field = BakedField(Formula(surface, BOX, lambda p: 0.5 + 0 * p), 0.05)
    noise = torch.randn(field.volume[:3].shape, generator=torch.Generator().manual_seed(0))
    field.volume[:3] += amplitude * noise
    return grid_of(field)


def _corridor(p: torch.Tensor) -> torch.Tensor:
    return torch.minimum(0.5 - p[:, 2], 0.5 - p[:, 1].abs())


def _corner(p: torch.Tensor) -> torch.Tensor:
    return torch.minimum(_corridor(p), 0.5 - p[:, 0].abs())


@pytest.mark.parametrize(
    ("surface", "is_held"),
    [
        (lambda p: 0.5 - p[:, 2], False),
        (lambda p: p[:, 1] + 0.5, False),
        (_corridor, False),
        (lambda p: 0.9 - (p + torch.tensor([0.0, 0.0, 0.5])).norm(dim=1), False),
        (_corner, True),
    ],
    ids=["wall", "floor", "corridor", "sphere", "corner"],
)
def test_ripples_of_a_map_hold_nothing(surface, is_held: bool) -> None:
    """Catches a standard deviation of millimetres where only the noise of the map's colours has a
    slope along what is seen; and doubts where three planes hold the camera."""
    rays = torch.from_numpy(RANDOM.uniform([-1, -1, 0], 1, (2000, 3)))
    camera = torch.tensor([0.1, -0.05, 0.0])
    near, far = torch.zeros(2000), torch.ones(2000)
    for _ in range(40):
        middle = (near + far) / 2
        is_free = surface(camera + middle[:, None] * rays) > 0
        near, far = torch.where(is_free, middle, near), torch.where(is_free, far, middle)
    is_hit = (far < 1).numpy()
    points = (middle[:, None] * rays).numpy()[is_hit][:500]
    lumas = 0.5 + RANDOM.normal(scale=0.006, size=len(points))
    seen = Observed(points, lumas, NONE)
    T_start = np.eye(4)
    T_start[:3, 3] = camera
    optimizer = LmOptimizer(rippled(surface, 0.003), seen, seen, 1.0, T_start)
    optimizer.run()
    assert (optimizer.certainty()["position_std_m"] < 0.01) == is_held


def test_the_costs_of_points_are_those_of_their_mean() -> None:
    """Catches a second formula of the cost that differs from the compiled one."""
    terms, scales = terms_at(grid_of(ROOM), POINTS, LUMAS, is_fine=True), np.array([0.1, 0.2])
    mean = robust_cost(terms.residuals, terms.reliability, scales, 0.7)
    assert point_costs(terms, scales, 0.7).mean() == pytest.approx(mean, rel=1e-5)


def test_a_rejected_step_leaves_the_pose_unchanged() -> None:
    """Catches steps that are taken although the cost rises: at the optimum every step is one."""
    seen = draw_points(walk(1, narrow_room())[0], 300, torch.Generator().manual_seed(0))
    grid = grid_of(BakedField(narrow_room(), 0.05))
    optimizer = LmOptimizer(grid, seen, seen, 1.0, ORIGIN)
    for is_fine in (False, True):
        while not optimizer.is_ended:
            T, damping = optimizer.T_world_camera, optimizer.damping
            optimizer.step()
            assert (optimizer.damping > damping) == (optimizer.T_world_camera is T)
        assert optimizer.stage.is_fine is is_fine
        optimizer.refine()
    assert abs(optimizer.T_world_camera - ORIGIN).max() < 2e-3


def test_a_coarse_stage_that_leads_astray_is_undone() -> None:
    """Catches a good start that is given up for a worse pose."""
    seen = draw_points(walk(1, narrow_room())[0], 300, torch.Generator().manual_seed(0))
    grid = grid_of(BakedField(narrow_room(), 0.05))
    optimizer = LmOptimizer(grid, seen, seen, 1.0, ORIGIN)
    assert optimizer.stage is COARSE
    optimizer.T_world_camera = POSE
    optimizer.terms = residual_terms(optimizer.problem, POSE)
    optimizer.refine()
    assert optimizer.T_world_camera is ORIGIN


def test_normals_of_planes() -> None:
    """Catches a wrong sign, axis or focal length: planes that lean to a side, or overhead."""
    frame = walk(1)[0]
    y, x = torch.meshgrid(torch.arange(24) - 11.5, torch.arange(32) - 15.5, indexing="ij")
    for normal in np.array([[0.6, 0.0, -0.8], [0.0, -0.6, -0.8]]):
        depth = -48_000 / (normal[0] * x + normal[1] * y + normal[2] * 24)
        frame.depth_mm[:] = depth.round().int()
        observed = draw_points(frame, 300, torch.Generator())
        assert abs(with_normals(frame, observed, 200)[2] - normal).max() < 0.02
    frame.depth_mm[:, ::2] *= 2
    assert not with_normals(frame, observed, 200)[2].any()  # each has an edge beside it


def test_what_is_no_number_stays_none() -> None:
    """Catches compiled sums that turn NaN into a pose, and reads outside of the grid."""
    grid = grid_of(ROOM)
    terms = terms_at(grid, POINTS, LUMAS, T=np.full((4, 4), np.nan), is_fine=True)
    cost = robust_cost(terms.residuals, terms.reliability, grid.residual_sigma, 1.0)
    assert np.isnan(cost) or not terms.reliability.any()
    sums = normal_equations(terms, grid.residual_sigma, 1.0)
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
    color = frame.color[rows, columns].numpy() / 255
    np.testing.assert_allclose(luma, color @ LUMA, atol=1e-6)
    assert len(draw_points(walk(1)[0], 400, torch.Generator())[0]) == 400


def test_points_are_spread_evenly() -> None:
    """Catches a sequence that repeats itself or leaves gaps: any beginning covers the image."""
    points = draw_points(walk(1)[0], 400, torch.Generator().manual_seed(0))[0]
    columns, rows = (points[:, :2] / points[:, 2:] * 24 + [16, 12] - 1).T
    tiles = (rows / 22 * 6).astype(int) * 6 + (columns / 30 * 6).astype(int)
    for n in (100, 400):
        std = np.bincount(tiles[:n], minlength=36).std()
        assert std < 0.6 * (n / 36) ** 0.5  # random pixels: about once
