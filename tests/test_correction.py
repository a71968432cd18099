"""The corrected field: better at surfaces that were measured, as before elsewhere; in a file."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import BoxRoom, Formula, box_sequence, error_m, poses_at

from nbtrack import Map, read_map, write_map
from nbtrack.beyond.correction import CORRECTIONS, CorrectedField, correct_map, corrected
from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.least_squares import corrected_vertices, regularisation_of, solve
from nbtrack.beyond.lm import LmSettings, LmTracker
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import NetworkSettings, NeusMapping, make_field
from nbtrack.machinery.errors import DataError
from nbtrack.tracking import StepBudget

ROOM, VOXEL = BoxRoom(half=(1.0, 0.5, 1.2)), 0.05


def wavy(points: torch.Tensor) -> torch.Tensor:
    """The room's distance (m), 8 mm off in waves, as a network's is."""
    return ROOM.value(points) + 0.008 * torch.sin(9 * points).prod(dim=-1).sign()


@pytest.fixture(scope="module")
def sequence() -> RgbdSequence:
    """Views all around from the middle: turns about the vertical axis."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    poses = poses_at(np.outer(0.01 * np.arange(12), [1, 0, 0]), np.outer(angles, [0, 1, 0]))
    return box_sequence(poses, ROOM, 96)


@pytest.fixture(scope="module", autouse=True)
def few_points() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nbtrack.beyond.correction._N_POINTS", 40_000)
        yield


@pytest.fixture(scope="module")
def found(sequence: RgbdSequence) -> CorrectedField:
    dark = Formula(wavy, ROOM.bounds, lambda points: 0.8 * ROOM.color(points))
    return corrected(dark, sequence, np.arange(12), VOXEL)


def errors(field: Formula | CorrectedField) -> tuple[float, float]:
    """Mean errors of distance (m) and colour on two walls that the cameras face."""
    points = 2 * torch.rand(2, 4000, 3, generator=torch.Generator().manual_seed(3)) - 1
    points *= torch.tensor([0.6, 0.4, 0.6])
    points[0, :, 0], points[1, :, 2] = 1.0, 1.2
    answers = zip(field(points.flatten(0, 1)), ROOM(points.flatten(0, 1)), strict=True)
    color, distance = ((found - exact).abs().mean().item() for found, exact in answers)
    return distance, color


def test_surfaces_are_mended_and_the_rest_is_left(found: CorrectedField) -> None:
    """Catches corrections of the wrong sign, at the wrong vertices, or without effect; and ones
    that reach into free space, where nothing was measured."""
    before, after = errors(found.source), errors(found)
    assert after[0] < before[0] / 4
    assert after[1] < before[1] / 4
    inside = 0.2 * (2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 1)
    assert torch.equal(found(inside)[1], BakedField(found.source, VOXEL)(inside)[1])


def test_a_map_knows_where_it_was_measured(found: CorrectedField) -> None:
    """Catches a tracker that follows what the network made up in free space and behind walls."""
    faced = torch.tensor([[1.0, 0.1, 0.2], [0.3, -0.2, 1.2], [-1.0, 0.0, 0.0]])
    assert (found.channels(faced)[4] > 0.8).all()
    for elsewhere in (0.3 * faced, 1.2 * faced):
        torch.testing.assert_close(found.channels(elsewhere)[4], torch.full((3,), 0.1))
    assert (BakedField(found.source, VOXEL).channels(faced)[4] == 1).all()


def test_the_same_data_give_the_same(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches draws that follow no seed. Frames without any surface are reported."""
    again = corrected(found.source, sequence, np.arange(12), VOXEL)
    assert torch.equal(found.corrections, again.corrections)
    sequence = box_sequence([[0.0, 0.0, 0.0]], ROOM)
    sequence.depths_mm[:] = 0
    with pytest.raises(DataError, match="shows no surface to correct a map by: check its depth"):
        corrected(found.source, sequence, np.arange(1), VOXEL)


def test_the_solution_is_that_of_dense_least_squares() -> None:
    """Catches weights that count twice or not at all, a vertex in another's column, and a minimum
    that is not one: of two columns, whose larger residual decides on a row's weight."""
    shape, rng, huber = (5, 4, 6), np.random.default_rng(1), 0.3
    corners = np.array([*np.ndindex(2, 2, 2)])
    cells = np.vstack([rng.integers(0, [4, 3, 5], size=(40, 3)), [[0, 0, 0], [3, 2, 4]]])
    vertices = np.ravel_multi_index((cells[:, None] + corners).transpose(2, 0, 1), shape)
    is_corrected, matrix = corrected_vertices(vertices, rng.random((42, 8)), shape)
    (numbers, springs), dense = regularisation_of(is_corrected), matrix.toarray()
    np.testing.assert_allclose(springs.toarray(), springs.toarray().T)
    wanted, reliability = rng.normal(size=(42, 2)), rng.random(42)
    expected = np.zeros((len(numbers), 2))
    for _ in range(3):
        largest = np.abs(wanted - dense @ expected).max(axis=1)
        weighted = dense * (reliability * huber / largest.clip(huber))[:, None]
        hessian = dense.T @ weighted + springs.toarray()
        expected = np.linalg.solve(hessian, weighted.T @ wanted)
    found, diagonal = solve(matrix, wanted, reliability, springs, huber, 3)
    np.testing.assert_allclose(found, expected, atol=0.01)
    np.testing.assert_allclose(diagonal, hessian.diagonal(), rtol=0.01)


def test_regularisation_by_hand() -> None:
    """Catches springs across edges and corners of cells: two vertices of a row, one of another; and
    corrections that fade out over more than a vertex: of one cell three more on each of 8 corners.
    """
    is_corrected = np.zeros((2, 2, 2), bool)
    is_corrected.flat[[0, 1, 7]] = True
    _, springs = regularisation_of(is_corrected)
    expected = [[0.7, -0.1, 0.0], [-0.1, 0.7, 0.0], [0.0, 0.0, 0.7]]
    np.testing.assert_allclose(springs.toarray(), expected)
    cell = np.ravel_multi_index(np.indices((2, 2, 2)).reshape(3, 1, 8) + 2, (6, 6, 6))
    assert corrected_vertices(cell, np.ones((1, 8)), (6, 6, 6))[0].sum() == 8 + 3 * 8


def test_a_file_keeps_it_whole(tmp_path: Path, sequence: RgbdSequence) -> None:
    """Catches corrections lost or rounded on the way to disk and back, and grids in the file."""
    network = NetworkSettings(width=16)
    field = make_field("neus", network, ROOM.bounds, seed=0).eval().requires_grad_(False)
    made = {"field": "neus", "network": vars(network), "seconds": 5.0, "seed": 0}
    made |= {"scene": "box", "n_frames": len(sequence), "origin": [0.0, 0.0, 0.0]}
    made["settings"] = asdict(NeusMapping())
    finished = correct_map(Map(field, sequence.intrinsics, made), sequence, 0.2)
    assert 5 < finished.record["seconds"] == 5 + finished.record["correction_seconds"] < 60
    write_map(tmp_path / "map.safetensors", finished)
    stored, points = read_map(tmp_path), torch.rand(100, 3)
    assert torch.equal(stored.field(points)[1], finished.field(points)[1])
    assert stored.field.label == "NeuS corrected"
    assert stored.key == finished.key
    own = {name for name in finished.field.state_dict() if not name.startswith("source.")}
    assert own == {*CORRECTIONS}


def tracked(field: CorrectedField, T_start: np.ndarray) -> LmTracker:
    return LmTracker(field, T_start, StepBudget(30), LmSettings(n_pixels=1024))


def test_a_kidnapped_camera_is_found(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches a tracker that looks only around where it last was: it is teleported by 150 degrees,
    where the map's own cameras stand 30 degrees apart and the room is no mirror image; and a first
    pose that is trusted although nobody knows it."""
    tracker = tracked(found, sequence.T_world_camera[6])
    assert not tracker.track(sequence[6]).lost
    for number in (1, 2):
        estimate = tracker.track(sequence[number])
        off = np.abs(estimate.T_world_camera - sequence.T_world_camera[number])
        assert off.max() < 0.05  # of the position (m), and of the axes
        assert estimate.lost is (estimate.report["p_lost"] >= 0.5)
    assert not estimate.lost
    assert estimate.report["p_lost"] < 0.1
    starts = tracker._starts_by_views(sequence[2], np.eye(4), found.viewpoints)
    assert len(starts) == 1 + 12 + 20  # the anchor, those of views, and the best random ones
    tracker.restart_anywhere()
    assert tracker.was_lost


def test_a_covered_camera_is_lost(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches a pose that passes while a hand covers the camera, and one that it leads astray."""
    tracker, covered = tracked(found, sequence.T_world_camera[3]), sequence[3]
    hand = replace(covered, depth_mm=0 * covered.depth_mm + 120, color=0 * covered.color + 90)
    assert not tracker.track(covered).lost
    for estimate in (tracker.track(hand) for _ in range(10)):
        assert estimate.lost
        assert estimate.report["p_lost"] > 0.5
    estimate = tracker.track(sequence[4])
    assert error_m(estimate, sequence[4]) < 0.05
    assert not estimate.lost


def test_a_room_that_was_never_mapped_is_told(found: CorrectedField) -> None:
    """Catches a pose that passes because some walls fit: another room's frames are all lost."""
    other = BoxRoom(half=(0.7, 0.6, 2.0))
    frames = box_sequence([[0.05 * n, 0.0, 0.0] for n in range(6)], other, 96)
    tracker = tracked(found, np.eye(4))
    for number in range(6):
        estimate = tracker.track(frames[number])
        assert estimate.lost
        assert estimate.report["p_lost"] > 0.75


def test_views_are_those_of_their_frames(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches views of the wrong frame or unit."""
    cameras = found.viewpoints.T_world_camera
    assert found.views.shape == (len(sequence), 2, 15, 20)
    ahead = sequence[2].depth_mm[45:51, 61:67].float().mean().item() / 50  # in units of 5 cm
    nearest = np.linalg.norm(cameras - sequence.T_world_camera[2], axis=(1, 2)).argmin()
    assert found.views[nearest, 1, 7, 9:11].float().mean().item() == pytest.approx(ahead, abs=1)


def test_colours_are_those_of_the_surface(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches colours that are smeared along normals, as where they are asked for off the surface
    too, or that are as stiff as distances: an eightieth of the error would be left."""
    grey = Formula(wavy, ROOM.bounds)
    assert errors(corrected(grey, sequence, np.arange(12), VOXEL))[1] < errors(grey)[1] / 150


def test_minimum_scales_follow_the_sensor(found: CorrectedField, sequence: RgbdSequence) -> None:
    """Catches a tracker that takes a noisy camera's residuals for outliers, or a good one's for
    noise: 5.5 medians of normal noise are 3.7 of its standard deviations."""
    # What is nearly exact has the least scales.
    assert found.accuracy.residual_sigma == pytest.approx((0.01, 0.05))
    noise = np.random.default_rng(0).normal(scale=6.0, size=sequence.depths_mm.shape)
    noisy = replace(sequence, depths_mm=(sequence.depths_mm + noise).astype(np.uint16))
    field = corrected(found.source, noisy, np.arange(12), VOXEL)
    # Walls are mostly seen at an angle, where less of the noise is along the normal.
    assert 0.5 * 3.7 * 0.006 < field.accuracy.residual_sigma[0] < 3.7 * 0.006
    medians = {"residual_medians": torch.tensor([0.01, 0.1])}
    field.add({name: getattr(field, name) for name in CORRECTIONS} | medians)
    assert field.accuracy.residual_sigma == pytest.approx((0.055, 0.23))
