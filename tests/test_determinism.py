"""One seed, one result, byte for byte: on a CPU with a budget of steps.

The same on workers, here and on a cluster, is in `test_grid.py`.
"""

import hashlib
from dataclasses import replace

import pytest
import torch
from box_room import box_sequence

from nbtrack.fields import NetworkSettings, field_class
from nbtrack.mapping.fit import map_sequence
from nbtrack.tracking import StepBudget, make_tracker, track_sequence, tracker_class

PAIRS = {"vr": "imap", "sdf": "neus", "lm": "neus_plus"}
SMALL = {"iterations": 6, "n_rays": 32, "n_stratified": 8, "n_surface": 8, "n_surface_points": 64}


def digest_of(tracker: str, seed: int) -> str:
    """Hash of a small map's weights and of the trajectory that is tracked in it."""
    sequence = box_sequence([[0.004 * i, 0.002 * i, 0.0] for i in range(4)])
    mapping = field_class(PAIRS[tracker]).Settings()
    mapping = replace(mapping, **{k: v for k, v in SMALL.items() if hasattr(mapping, k)})
    network = NetworkSettings(width=24, n_frequencies=16)
    field = map_sequence(PAIRS[tracker], sequence, network, mapping, seed).field
    settings = tracker_class(tracker).Settings(n_pixels=64, motion_model="better_of_both")
    T_first = sequence.T_world_camera[0]
    run = make_tracker(tracker, field, T_first, StepBudget(3.5), settings, seed)
    found = hashlib.sha256(track_sequence(run, sequence).T_estimated.tobytes())
    for name, tensor in field.state_dict().items():
        found.update(name.encode() + tensor.numpy().tobytes())
    return found.hexdigest()


@pytest.mark.parametrize("tracker", PAIRS)
def test_again_and_with_other_threads(tracker: str) -> None:
    """Catches hidden randomness, and sums whose order depends on how many share them.

    Networks this narrow are computed by one thread however many there are.
    """
    torch.set_num_threads(1)
    once = digest_of(tracker, 1)
    assert digest_of(tracker, 2) != once
    torch.set_num_threads(2)
    assert digest_of(tracker, 1) == once
