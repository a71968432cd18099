"""Fitting fields: what is learnt, resume, settings that do not fit; scores, of known errors."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from box_room import Formula, poses_at, room_sequence, sequence_of

from nbtrack.beyond.points import PointMapping
from nbtrack.core.camera import Intrinsics
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.quality import score_map
from nbtrack.fields import MappingSettings, NetworkSettings, field_class
from nbtrack.machinery.errors import DataError, NumericalError
from nbtrack.mapping.files import Map
from nbtrack.mapping.fit import learning_rate, map_sequence
from nbtrack.mapping.holdout import split_holdout
from nbtrack.plots.meshes import extract_mesh, seen_by
from nbtrack.synthetic import build_room

NETWORK = NetworkSettings(width=48, n_frequencies=32)


def settings_of(field_name: str, **changes: float) -> MappingSettings:
    """Few rays and samples; 24 iterations if nothing else is asked for."""
    small = {"iterations": 24, "n_rays": 32, "n_stratified": 8, "n_surface": 4}
    return field_class(field_name).Settings(**{**small, "learning_rate": 3e-3, **changes})


def wall_sequence(n_frames: int = 6, distance: float = 2.0):
    """Cameras side by side that look straight at a grey wall, `distance` metres ahead."""
    poses = poses_at(np.outer(np.linspace(-0.5, 0.5, n_frames), [1, 0, 0]))
    depths_mm = np.full((n_frames, 12, 16), 1000 * distance)
    return sequence_of(depths_mm, Intrinsics.from_focal(16, 12, 14.0), poses=poses, name="wall")


@cache
def finished_wall():
    """A NeuS map of the wall."""
    settings = settings_of("neus", iterations=150, holdout_every=0)
    return map_sequence("neus", wall_sequence(), NETWORK, settings)


def test_neus_finds_a_wall() -> None:
    """Catches wrong signs or units of the distance: 1.5 m before a wall it is 1.5 m off zero."""
    mapped = finished_wall()
    color, sdf = mapped.field(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.7], [0.0, 0.0, 2.0]]))
    assert not sdf.requires_grad
    assert sdf[2].abs() < 0.05
    assert sdf[1] == pytest.approx(0.3, abs=0.1)
    assert (color[2] - 128 / 255).abs().max() < 0.1
    assert mapped.record["misfit_m"] < 0.05
    assert mapped.record["first_and_last_frame"] == [0, 5]


def test_points_are_fused_at_once() -> None:
    """Catches held-out frames among the points, and a bar that never ends."""
    seen, settings = [], PointMapping(voxel=0.05, holdout_every=3)
    how = {"settings": settings, "on_iteration": lambda *news: seen.append(news)}
    mapped = map_sequence("points", wall_sequence(), NETWORK, **how)
    n_points = len(mapped.field.points)
    assert seen == [(1, {"points": n_points, "bytes": 24 * n_points})]
    assert mapped.history.to_dict("records") == [seen[0][1]]
    assert (mapped.field.points[:, 2] - 2).abs().max() < 1e-5
    assert mapped.record["mapped_frames"] == 4
    assert mapped.record["misfit_m"] < 0.05
    assert all(0 < of.record["seconds"] < 60 for of in (mapped, finished_wall()))


def map_wall(field_name: str, checkpoint: Path | None, *on_iteration):
    more = settings_of(field_name), 3, None, checkpoint, *on_iteration
    return map_sequence(field_name, wall_sequence(), NETWORK, *more)


@pytest.mark.parametrize("field_name", ["imap", "neus", "neus_plus"])
def test_resume_equals_uninterrupted(field_name: str, tmp_path: Path) -> None:
    """Catches a checkpoint that forgets anything: batches, Adam's moments, the learning rate; and a
    seed or a sum of losses that is recorded wrongly."""
    checkpoint, seen = tmp_path / "mapping.pt", []

    def kill(share: float, losses: dict[str, float]) -> None:
        if share >= 20 / 24:
            raise InterruptedError

    whole = map_wall(field_name, None)
    now = mock.patch("nbtrack.machinery.files.CHECKPOINT_SECONDS", 0.0)
    with now, pytest.raises(InterruptedError):
        map_wall(field_name, checkpoint, kill)
    resumed = map_wall(field_name, checkpoint, lambda done, losses: seen.append(done))
    assert seen == [20 / 24, 1]
    assert np.array_equal(resumed.history.to_numpy(), whole.history.to_numpy())
    assert resumed.key == whole.key
    assert whole.record["seed"] == 3
    terms = whole.history.drop(columns=["total", "std_m"], errors="ignore")
    np.testing.assert_allclose(whole.history["total"], terms.sum(axis=1))


def test_diverged_loss_names_the_iteration() -> None:
    """Catches NaN that spreads unnoticed: an absurd learning rate must stop the run."""
    settings = settings_of("neus", iterations=200, learning_rate=1e6)
    with pytest.raises(NumericalError, match=r"at mapping iteration \d+: lower the learning rate"):
        map_sequence("neus", wall_sequence(), NETWORK, settings)


def test_schedule_and_split() -> None:
    """Catches a rate that ends high or too low (half-way it is 0.525 of the start), and frames that
    are both mapped and scored, or neither."""
    settings = settings_of("imap", iterations=100, learning_rate=1.0)
    found = [learning_rate(settings, iteration) for iteration in (0, 50, 100)]
    assert found == pytest.approx([1.0, 0.525, 0.05])
    mapped, held_out = split_holdout(25, 10)
    assert held_out.tolist() == [5, 15]
    assert sorted([*mapped, *held_out]) == list(range(25))
    assert len(split_holdout(5, 10)[1]) == len(split_holdout(25, 0)[1]) == 0


ROOM = build_room("bedroom")


@pytest.fixture(scope="module")
def sequence():
    """What a camera sees of it, with clean depth."""
    return room_sequence("bedroom", 40, 15)


def shifted(sequence, shift: float) -> Formula:
    """The exact room, its distance off by a constant: the surface moves by as much."""

    def distance(points_world):
        return torch.from_numpy(ROOM.sdf(points_world.double().numpy()) - shift).float()

    return Formula(distance, observed_bounds(sequence))


def quality_of(sequence, shift: float) -> dict:
    made = {"settings": {"holdout_every": 0}}
    return score_map(Map(shifted(sequence, shift), sequence.intrinsics, made), sequence, ROOM)


def test_scores(sequence, monkeypatch) -> None:
    """Catches scores that punish an exact map, blind scores and wrong units: of the truth, within
    half a cell, and of a surface 8 cm inside the room, which is beyond 5 cm."""
    monkeypatch.setattr("nbtrack.experiments.quality.POINTS_SCORED", 4000)
    exact, inside = quality_of(sequence, 0.0), quality_of(sequence, 0.08)
    assert (exact["psnr_db"], exact["depth_l1_m"]) == (None, None)
    assert max(exact["sdf_near_m"], exact["sdf_free_m"]) < 1e-5
    assert exact["mesh_accuracy_m"] < 0.01
    assert exact["mesh_completion_m"] < 0.03
    assert exact["mesh_f_score"] > 0.95
    assert inside["sdf_near_m"] == pytest.approx(0.08, abs=1e-5)
    assert inside["sdf_free_m"] == pytest.approx(0.08, abs=1e-5)
    assert inside["mesh_accuracy_m"] == pytest.approx(0.08, abs=0.01)
    assert inside["mesh_f_score"] < 0.3
    # No surface yet is no error: its mesh scores are just empty.
    lost = quality_of(sequence, -10.0)
    assert {lost[name] for name in lost if name.startswith("mesh")} == {None}


def test_seen_points(sequence) -> None:
    """Catches wrong visibility: what a pixel measured is seen, what lies far behind it is not."""
    T_world_camera, depth = sequence.T_world_camera[0], float(sequence.depth(0)[15, 20])
    ahead = np.array([depth, depth / 2, depth + 0.5, -1.0])
    points = T_world_camera[:3, 3] + ahead[:, None] * T_world_camera[:3, 2]
    assert seen_by(points, sequence.select(slice(1))).tolist() == [True, True, False, False]


def test_mesh_is_in_metres_and_world_frame(sequence) -> None:
    """Catches grid units or a lost offset: every corner lies on the exact surface."""
    whole, mesh = (extract_mesh(shifted(sequence, 0.0), part) for part in (None, sequence))
    assert np.quantile(np.abs(ROOM.sdf(np.asarray(mesh.vertices))), 0.95) < 0.01
    assert len(mesh.vertices) < len(whole.vertices)
    blind = replace(sequence, depths_mm=np.zeros_like(sequence.depths_mm))
    with pytest.raises(DataError, match="no frame saw the surface"):
        extract_mesh(shifted(sequence, 0.0), blind)
