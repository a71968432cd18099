"""Scores of maps, on fields whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import Formula, room_sequence
from torch import Tensor

from nbtrack.data.sequence import RgbdSequence, observed_bounds
from nbtrack.experiments.quality import score_map
from nbtrack.machinery.errors import DataError
from nbtrack.mapping.files import Map
from nbtrack.plots.meshes import extract_mesh, seen_by
from nbtrack.synthetic import build_room

ROOM = build_room("bedroom")


@pytest.fixture(scope="module")
def sequence() -> RgbdSequence:
    """What a camera sees of it, with clean depth."""
    return room_sequence("bedroom", 40, 15)


def shifted(sequence: RgbdSequence, shift: float) -> Formula:
    """The exact room, its distance off by a constant: the surface moves by as much."""

    def distance(points_world: Tensor) -> Tensor:
        return torch.from_numpy(ROOM.sdf(points_world.double().numpy()) - shift).float()

    return Formula(distance, observed_bounds(sequence))


def quality_of(sequence: RgbdSequence, shift: float) -> dict:
    made = {"settings": {"holdout_every": 0}}
    return score_map(Map(shifted(sequence, shift), sequence.intrinsics, made), sequence, ROOM)


def test_scores(sequence: RgbdSequence, monkeypatch) -> None:
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


def test_seen_points(sequence: RgbdSequence) -> None:
    """Catches wrong visibility: what a pixel measured is seen, what lies far behind it is not."""
    T_world_camera, depth = sequence.T_world_camera[0], float(sequence.depth(0)[15, 20])
    ahead = np.array([depth, depth / 2, depth + 0.5, -1.0])
    points = T_world_camera[:3, 3] + ahead[:, None] * T_world_camera[:3, 2]
    assert seen_by(points, sequence.select(slice(1))).tolist() == [True, True, False, False]
    # A choice of frames counts: what one frame saw, a frame behind it did not.
    others = [i for i in range(len(sequence)) if seen_by(points[3:], sequence, np.array([i]))[0]]
    assert 0 not in others
    asked = {*range(0, len(sequence), 5)}
    assert seen_by(points[3:], sequence)[0] == bool(asked & {*others})


def test_mesh_is_in_metres_and_world_frame(sequence: RgbdSequence) -> None:
    """Catches grid units or a lost offset: every corner lies on the exact surface."""
    whole, mesh = (extract_mesh(shifted(sequence, 0.0), part) for part in (None, sequence))
    assert np.quantile(np.abs(ROOM.sdf(np.asarray(mesh.vertices))), 0.95) < 0.01
    assert len(mesh.vertices) < len(whole.vertices)
    blind = replace(sequence, depths_mm=np.zeros_like(sequence.depths_mm))
    with pytest.raises(DataError, match="no frame saw the surface"):
        extract_mesh(shifted(sequence, 0.0), blind)
