"""Speed is measured, not tested; what it is compared with is."""

import torch
from tiny import TINY

from nbtrack.core.config import FieldConfig, TrackingConfig
from nbtrack.core.settings import resolve_preset, with_settings
from nbtrack.data.sequence import read_sequence
from nbtrack.experiments.scenes import find_scene
from nbtrack.experiments.speed import (
    forward_flops,
    measure_mapping,
    measure_step_times,
    step_flops,
    time_to_distance,
)
from nbtrack.synthetic import make_room


def test_operations_of_the_papers_network_by_hand() -> None:
    """Weights without biases: 3*93 + 93*256 + 256² + 349*256 + 256² + 4*256, twice."""
    assert forward_flops(FieldConfig()) == 2 * (279 + 23808 + 65536 + 89344 + 65536 + 1024)


def test_operations_of_a_step_by_hand() -> None:
    """SDF: a forward and a backward pass. VR: 32 samples ask, then 44, differentiated too."""
    network, point = FieldConfig(), forward_flops(FieldConfig())
    assert step_flops("sdf", TrackingConfig(n_pixels=10), network) == 10 * 2 * point
    assert step_flops("vr", TrackingConfig(n_pixels=10), network) == 10 * (76 + 44) * point


def test_both_engines_stand_side_by_side(tmp_path) -> None:
    preset = with_settings(resolve_preset("smoke"), *TINY)
    make_room("office", tmp_path / "office", 4, 32, 24, 0, 1)
    sequence = read_sequence(tmp_path / "office")
    times = measure_step_times(preset, sequence, torch.device("cpu"), progress=False)
    assert times["tracker"].tolist() == ["VR", "VR, engine", "SDF", "SDF, engine"]
    assert (times["times_floor"] > 0).all()
    mapping = measure_mapping(preset, sequence, torch.device("cpu"))
    assert mapping["field"].tolist() == ["imap", "neus"]


def test_time_to_a_distance_ends_with_the_target_or_the_whole_map(tmp_path, monkeypatch) -> None:
    """A target of 10 m is reached at once; one of 0 never: then all lengths are there."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path))
    preset = with_settings(resolve_preset("smoke"), *TINY, "mapping.neus_plus.iterations=6")
    room = find_scene("office", preset.scenes)
    at_once = time_to_distance(preset, room, torch.device("cpu"), 10.0)
    assert at_once["field"].tolist() == ["neus", "neus_plus"]
    never = time_to_distance(preset, room, torch.device("cpu"), 0.0)
    assert len(never) == 12
