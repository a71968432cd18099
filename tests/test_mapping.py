"""Fitting fields: what is learnt, resume, and settings that do not fit."""

from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from box_room import poses_at, sequence_of

from nbtrack.beyond.points import PointMapping
from nbtrack.core.camera import Intrinsics
from nbtrack.fields import MappingSettings, NetworkSettings, field_class
from nbtrack.machinery.errors import NumericalError
from nbtrack.mapping.fit import learning_rate, map_sequence
from nbtrack.mapping.holdout import split_holdout

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
    ahead = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.7], [0.0, 0.0, 2.0]])
    color, sdf = mapped.field(ahead)
    assert sdf[2].abs() < 0.05
    assert sdf[1] == pytest.approx(0.3, abs=0.1)
    assert (color[2] - 128 / 255).abs().max() < 0.1
    assert mapped.record["misfit_m"] < 0.05
    assert mapped.record["first_and_last_frame"] == [0, 5]


def test_imap_renders_a_wall() -> None:
    """Catches densities that do not absorb: the rendered depth must be the wall's."""
    settings = settings_of("imap", iterations=120, n_stratified=20, n_surface=8)
    sequence = wall_sequence()
    mapped = map_sequence("imap", sequence, NETWORK, settings)
    color, depth = mapped.field.render_view(sequence.intrinsics, sequence.T_world_camera[2])
    assert np.median(np.abs(depth - 2.0)) < 0.06
    assert np.median(np.abs(color - 128 / 255)) < 0.06


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
