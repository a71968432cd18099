"""The fused point cloud and the classical tracker in it."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import FieldConfig, MappingConfig, TrackingConfig
from nbtrack.core.errors import DataError, MissingError
from nbtrack.core.geometry import rotation_vector_to_matrix
from nbtrack.data.pixels import PixelSampler
from nbtrack.data.sequence import RgbdSequence, read_sequence
from nbtrack.fields import make_field
from nbtrack.fields.fusion import fuse_points
from nbtrack.mapping.fit import FittedMap, load_map, map_sequence, split_holdout
from nbtrack.mapping.quality import score_map
from nbtrack.synthetic import build_room, make_room
from nbtrack.tracking.budget import StepBudget
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers import tracker_class

NETWORK, MAPPING, TRACKING = FieldConfig(), MappingConfig(), TrackingConfig()
BOX = SceneBounds((-1.0, -1.0, 0.0), (1.0, 1.0, 3.0))


def two_pixel_sequence(depths_mm: list[list[int]], shades: list[list[int]]) -> RgbdSequence:
    """Frames of two pixels side by side, from one camera at the origin; grey by pixel.

    The pixels' directions are (-0.25, 0, 1) and (0.25, 0, 1).
    """
    shape = (len(depths_mm), 1, 2)
    return RgbdSequence(
        "two pixels", Intrinsics(2, 1, 2.0, 2.0, 1.0, 0.5),
        np.repeat(np.array(shades, np.uint8).reshape(*shape, 1), 3, axis=3),
        np.array(depths_mm, np.uint16).reshape(shape),
        np.tile(np.eye(4), (len(depths_mm), 1, 1)), np.arange(len(depths_mm)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def room_sequence(tmp_path_factory: pytest.TempPathFactory) -> RgbdSequence:
    """A few clean frames of a furnished room."""
    folder = tmp_path_factory.mktemp("data") / "bedroom"
    make_room("bedroom", folder, 12, 96, 72)
    return read_sequence(folder, depth_folder="depth")


@pytest.fixture(scope="module")
def room_map(room_sequence: RgbdSequence) -> FittedMap:
    return map_sequence("points", room_sequence, NETWORK, MAPPING)


def test_points_of_a_voxel_are_averaged() -> None:
    """Catches sums that are not divided, or voxels mixed up: the mean is worked out by hand."""
    # Left pixel: x = -z/4. 2.02 and 2.04 m fall into one voxel of 10 cm, 2.50 m into another.
    depths_mm, shades = [[2020, 0], [2040, 0], [2500, 0]], [[50, 0], [150, 0], [255, 0]]
    sequence = two_pixel_sequence(depths_mm, shades)
    points, colors = fuse_points(sequence, np.arange(3), BOX, voxel=0.1)
    order = points[:, 2].argsort()
    expected = [[-0.5075, 0, 2.03], [-0.625, 0, 2.5]]
    np.testing.assert_allclose(points[order], expected, atol=1e-6)
    np.testing.assert_allclose(colors[order], [[100 / 255] * 3, [1.0] * 3], atol=1e-6)


def test_mean_is_over_all_pixels_however_they_are_merged() -> None:
    """Catches a mean of means: 20 frames, merged in blocks, weigh the same each."""
    depths = [2010 + 4 * (i % 5) ** 2 for i in range(20)]
    sequence = two_pixel_sequence([[0, d] for d in depths], [[0, 90]] * 20)
    points, _ = fuse_points(sequence, np.arange(20), BOX, voxel=0.25)
    assert points.shape == (1, 3)
    assert points[0, 2] == pytest.approx(np.mean(depths) / 1000, abs=1e-6)


def test_only_the_frames_asked_for_and_what_lies_inside_are_fused() -> None:
    """Catches a map of held-out frames, and wild depths that stretch the grid."""
    sequence = two_pixel_sequence([[2000, 9000], [1000, 1000]], [[10, 10]] * 2)
    points, _ = fuse_points(sequence, np.array([0]), BOX, voxel=0.02)
    np.testing.assert_allclose(points, [[-0.5, 0.0, 2.0]], atol=1e-6)


def test_field_answers_for_the_nearest_point() -> None:
    """Catches distance and colour of different points, and a tree that outlives its points."""
    field = make_field("points", NETWORK, BOX, seed=0)
    field.fuse(two_pixel_sequence([[2000, 2000]], [[0, 255]]), np.array([0]), 0.02)
    color, distance = field(torch.tensor([[0.5, 0.3, 2.0], [-0.5, 0.0, 1.6]]))
    torch.testing.assert_close(color, torch.tensor([[1.0] * 3, [0.0] * 3]))
    torch.testing.assert_close(distance, torch.tensor([0.3, 0.4]))
    assert field.n_bytes == 2 * 6 * 4
    field.fuse(two_pixel_sequence([[1000, 0]], [[0, 0]]), np.array([0]), 0.02)
    assert field(torch.tensor([[-0.25, 0.0, 1.5]]))[1].item() == pytest.approx(0.5)


def test_held_out_frames_are_not_mapped(room_sequence: RgbdSequence, room_map: FittedMap) -> None:
    """Catches a map that ignores `holdout_every`: it must be that of the other frames alone."""
    mapped, held_out = split_holdout(len(room_sequence), MAPPING.holdout_every)
    assert len(held_out) > 0
    points, _ = fuse_points(room_sequence, mapped, room_map.field.bounds, MAPPING.voxel)
    assert np.array_equal(points, room_map.field.points.numpy())


def test_loaded_map_is_the_same_and_tracks_the_same(
    room_sequence: RgbdSequence, tmp_path: Path
) -> None:
    """Catches a checkpoint that cannot hold any number of points, or loses their order."""
    checkpoint, seen = tmp_path / "map.pt", []
    fitted = map_sequence(
        "points", room_sequence, NETWORK, MAPPING, checkpoint=checkpoint,
        on_iteration=lambda *news: seen.append(news),
    )  # fmt: skip
    assert len(seen) == 1
    loaded = load_map(checkpoint, "points", NETWORK, torch.device("cpu"))
    again = map_sequence("points", room_sequence, NETWORK, MAPPING, checkpoint=checkpoint)
    for other in (loaded, again):
        for name, value in fitted.field.state_dict().items():
            assert torch.equal(other.field.state_dict()[name], value), name
        assert other.field.surface_level == fitted.field.surface_level
        assert other.history.equals(fitted.history)
    with pytest.raises(DataError, match="another seed"):
        map_sequence("points", room_sequence, NETWORK, MAPPING, seed=1, checkpoint=checkpoint)
    pytest.importorskip("small_gicp")
    short = room_sequence.select(slice(0, 3))
    first, second = (
        track_sequence("icp", map_.field, short, StepBudget(1), TRACKING).T_estimated
        for map_ in (fitted, loaded)
    )
    assert np.array_equal(first, second)


def test_scores_of_points(room_sequence: RgbdSequence, room_map: FittedMap) -> None:
    """Catches images asked of points, and points off the exact surface: depth here is clean."""
    mapped, held_out = split_holdout(len(room_sequence), MAPPING.holdout_every)
    room = build_room("bedroom")
    quality = score_map(room_map.field, room_sequence, mapped, held_out, room)
    assert quality.psnr_db is None
    assert quality.sdf_near_m is None
    assert quality.mesh_accuracy_m < 0.005
    assert quality.mesh_completion_m < 0.1
    assert quality.mesh_f_score > 0.7
    unknown = score_map(room_map.field, room_sequence, mapped, held_out, None)
    assert set(unknown.to_dict().values()) == {None}


def test_icp_lands_on_the_true_pose(room_sequence: RgbdSequence, room_map: FittedMap) -> None:
    """Catches a pose taken for its inverse, or wrong axes: from 5 cm and 3 degrees off."""
    pytest.importorskip("small_gicp")
    sampler = PixelSampler(room_sequence, torch.device("cpu"))
    tracker = tracker_class("icp")(
        room_map.field, sampler, TRACKING, torch.Generator().manual_seed(0)
    )
    T_true = torch.from_numpy(room_sequence.T_world_camera[5]).float()
    T_start = T_true.clone()
    T_start[:3, 3] += 0.05 * torch.tensor([2.0, 2.0, 1.0]) / 3
    turn = torch.deg2rad(torch.tensor(3.0)) * torch.tensor([2.0, -1.0, 2.0]) / 3
    T_start[:3, :3] = rotation_vector_to_matrix(turn) @ T_true[:3, :3]
    tracker.start_frame(5, T_start[None])
    assert not tracker.is_converged
    assert torch.equal(tracker.T_world_camera, T_start)
    assert torch.isfinite(tracker.step())
    assert tracker.is_converged
    assert (tracker.T_world_camera - T_true)[:3, 3].norm() < 0.008
    left = tracker.T_world_camera[:3, :3].T @ T_true[:3, :3]
    assert torch.rad2deg(((left.trace() - 1) / 2).clamp(-1, 1).arccos()) < 0.3
    assert tracker.report()["inlier_ratio"] > 0.8
    assert not tracker.report()["lost"]


def test_icp_says_when_it_is_lost(room_sequence: RgbdSequence, room_map: FittedMap) -> None:
    """Catches a crash, or a pose that is no number, where no point has a partner."""
    pytest.importorskip("small_gicp")
    sampler = PixelSampler(room_sequence, torch.device("cpu"))
    tracker = tracker_class("icp")(
        room_map.field, sampler, TRACKING, torch.Generator().manual_seed(0)
    )
    T_start = torch.eye(4)
    T_start[:3, 3] = 100.0
    tracker.start_frame(5, T_start[None])
    tracker.step()
    assert torch.equal(tracker.T_world_camera, T_start)
    assert tracker.report() == {"inlier_ratio": 0.0, "lost": True}


def test_missing_package_is_one_line(
    room_sequence: RgbdSequence, room_map: FittedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a traceback where the optional package is not installed."""
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(MissingError, match=r"^tracker icp needs .* 'nbtrack\[icp\]'$"):
        track_sequence("icp", room_map.field, room_sequence, StepBudget(1), TRACKING)
