"""Fitting fields: what is learnt, resume, and settings that do not fit."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import FieldConfig, MappingConfig
from nbtrack.core.errors import DataError, NumericalError
from nbtrack.data.sequence import RgbdSequence
from nbtrack.mapping.fit import learning_rate, load_map, map_sequence, split_holdout

NETWORK = FieldConfig(width=48, n_frequencies=32)
SHORT = MappingConfig(iterations=30, n_rays=32, n_stratified=8, n_surface=4, learning_rate=3e-3)


def wall_sequence(n_frames: int = 6, distance: float = 2.0) -> RgbdSequence:
    """Cameras side by side that look straight at a grey wall, `distance` metres ahead."""
    height, width = 12, 16
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, n_frames)
    return RgbdSequence(
        "wall", Intrinsics.from_focal(width, height, 14.0),
        np.full((n_frames, height, width, 3), 128, np.uint8),
        np.full((n_frames, height, width), int(1000 * distance), np.uint16),
        poses, np.arange(n_frames),
    )  # fmt: skip


def test_neus_finds_a_wall() -> None:
    """Catches wrong signs or units of the distance: 1.5 m before a wall it is 1.5 m off zero."""
    config = MappingConfig(
        iterations=300, n_rays=64, n_stratified=16, n_surface=8, learning_rate=3e-3,
        holdout_every=0,
    )  # fmt: skip
    fitted = map_sequence("neus", wall_sequence(), NETWORK, config)
    ahead = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.7], [0.0, 0.0, 2.0]])
    sdf = fitted.field(ahead)[1]
    assert sdf[2].abs() < 0.05
    assert sdf[1] == pytest.approx(0.3, abs=0.1)
    color = fitted.field(ahead[2:])[0]
    assert (color - 128 / 255).abs().max() < 0.1


def test_imap_renders_a_wall() -> None:
    """Catches densities that do not absorb: the rendered depth must be the wall's."""
    from nbtrack.fields.views import render_view

    config = MappingConfig(
        iterations=250, n_rays=64, n_stratified=24, n_surface=8, learning_rate=3e-3
    )
    sequence = wall_sequence()
    fitted = map_sequence("imap", sequence, NETWORK, config)
    view = render_view(fitted.field, sequence.intrinsics, sequence.T_world_camera[2])
    assert np.median(np.abs(view.depth - 2.0)) < 0.06
    assert np.median(np.abs(view.color - 128 / 255)) < 0.06


@pytest.mark.parametrize("field_name", ["imap", "neus"])
def test_resume_equals_uninterrupted(field_name: str, tmp_path: Path) -> None:
    """Catches a checkpoint that forgets anything: batches, Adam's moments, the learning rate."""
    sequence = wall_sequence()
    whole = map_sequence(field_name, sequence, NETWORK, SHORT, seed=3)

    class Killed(Exception):
        pass

    def kill_at_20(iteration: int, losses: dict[str, float]) -> None:
        if iteration >= 20:
            raise Killed

    checkpoint = tmp_path / "map.pt"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nbtrack.mapping.fit.CHECKPOINT_SECONDS", 0.0)
        with pytest.raises(Killed):
            map_sequence(
                field_name, sequence, NETWORK, SHORT, seed=3, checkpoint=checkpoint,
                on_iteration=kill_at_20,
            )  # fmt: skip
    resumed = map_sequence(field_name, sequence, NETWORK, SHORT, seed=3, checkpoint=checkpoint)
    assert 0 < resumed.resumed_from < 20
    assert np.array_equal(resumed.history.to_numpy(), whole.history.to_numpy())
    for name, value in whole.field.state_dict().items():
        assert torch.equal(resumed.field.state_dict()[name], value), name


def test_load_map_gives_the_same_field(tmp_path: Path) -> None:
    """Catches a saved map that answers differently from the one that was fitted."""
    checkpoint = tmp_path / "map.pt"
    fitted = map_sequence("neus", wall_sequence(), NETWORK, SHORT, checkpoint=checkpoint)
    loaded = load_map(checkpoint, "neus", NETWORK, torch.device("cpu"))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(loaded.field(points)[1], fitted.field(points)[1])
    assert len(loaded.history) == SHORT.iterations


def test_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    """Catches a silent continuation under another seed."""
    checkpoint = tmp_path / "map.pt"
    map_sequence("imap", wall_sequence(), NETWORK, SHORT, seed=0, checkpoint=checkpoint)
    with pytest.raises(DataError, match="another seed"):
        map_sequence("imap", wall_sequence(), NETWORK, SHORT, seed=1, checkpoint=checkpoint)
    with pytest.raises(DataError, match="is a map of field 'imap', not 'neus'"):
        load_map(checkpoint, "neus", NETWORK, torch.device("cpu"))


def test_damaged_checkpoint(tmp_path: Path) -> None:
    """Catches a traceback from a file that was cut or is something else."""
    checkpoint = tmp_path / "map.pt"
    checkpoint.write_bytes(b"not a checkpoint")
    with pytest.raises(DataError, match="not a readable checkpoint"):
        map_sequence("imap", wall_sequence(), NETWORK, SHORT, checkpoint=checkpoint)


def test_diverged_loss_names_the_iteration() -> None:
    """Catches NaN that spreads unnoticed: an absurd learning rate must stop the run."""
    config = MappingConfig(
        iterations=200, n_rays=16, n_stratified=4, n_surface=2, learning_rate=1e18
    )
    with pytest.raises(NumericalError, match="at mapping iteration"):
        map_sequence("neus", wall_sequence(), NETWORK, config)


def test_no_depth_at_all() -> None:
    """Catches training on nothing."""
    sequence = wall_sequence()
    sequence.depths_mm[:] = 0
    with pytest.raises(DataError, match="no pixel of wall has a depth"):
        map_sequence("imap", sequence, NETWORK, SHORT)


def test_learning_rate_schedule() -> None:
    """Catches a rate that ends high or too low; half-way it is 0.525 of the start."""
    config = MappingConfig(iterations=100, learning_rate=1.0)
    assert learning_rate(config, 0) == pytest.approx(1.0)
    assert learning_rate(config, 50) == pytest.approx(0.525)
    assert learning_rate(config, 100) == pytest.approx(0.05)


def test_split_holdout_parts() -> None:
    """Catches frames that are both mapped and scored, or neither."""
    mapped, held_out = split_holdout(25, 10)
    assert held_out.tolist() == [5, 15]
    assert sorted([*mapped, *held_out]) == list(range(25))
    assert len(split_holdout(5, 10)[1]) == 0
    assert len(split_holdout(25, 0)[1]) == 0
