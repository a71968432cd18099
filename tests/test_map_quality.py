"""Scores of maps, on fields whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nbtrack.core.errors import DataError
from nbtrack.data.sequence import RgbdSequence, observed_bounds, read_sequence
from nbtrack.fields.base import LearnedField
from nbtrack.mapping.files import Map
from nbtrack.mapping.meshes import extract_mesh, seen_by
from nbtrack.mapping.quality import score_map
from nbtrack.synthetic import build_room, make_room

ROOM = build_room("bedroom")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> RgbdSequence:
    """What a camera sees of it, with clean depth."""
    folder = tmp_path_factory.mktemp("data") / "bedroom"
    make_room("bedroom", folder, 15, 40, 30)
    return read_sequence(folder, depth_folder="depth")


class ShiftedRoom(LearnedField):
    """The exact room, its distance off by a constant: the surface moves by as much."""

    name, label, surface_level = "shifted", "shifted", 0.0
    composite = mapping_losses = None  # not asked for

    def __init__(self, sequence: RgbdSequence, shift: float) -> None:
        super().__init__(observed_bounds(sequence))
        self.shift = shift

    def forward(self, points_world):
        sdf = ROOM.sdf(points_world.double().numpy()) - self.shift
        return torch.full_like(points_world, 0.5), torch.from_numpy(sdf).float()


def quality_of(sequence: RgbdSequence, shift: float) -> dict:
    made = {"settings": {"holdout_every": 0}}
    return score_map(Map(ShiftedRoom(sequence, shift), sequence.intrinsics, made), sequence, ROOM)


def test_scores_of_the_truth(sequence: RgbdSequence) -> None:
    """Catches scores that punish an exact map: within half a cell, and nearly all within 5 cm."""
    quality = quality_of(sequence, 0.0)
    assert (quality["psnr_db"], quality["depth_l1_m"]) == (None, None)
    assert max(quality["sdf_near_m"], quality["sdf_free_m"]) < 1e-5
    assert quality["mesh_accuracy_m"] < 0.01
    assert quality["mesh_completion_m"] < 0.03
    assert quality["mesh_f_score"] > 0.95


def test_scores_of_a_shifted_room(sequence: RgbdSequence) -> None:
    """Catches blind scores and wrong units: a surface 8 cm inside the room is beyond 5 cm."""
    quality = quality_of(sequence, 0.08)
    assert quality["sdf_near_m"] == pytest.approx(0.08, abs=1e-5)
    assert quality["sdf_free_m"] == pytest.approx(0.08, abs=1e-5)
    assert quality["mesh_accuracy_m"] == pytest.approx(0.08, abs=0.01)
    assert quality["mesh_f_score"] < 0.3


def test_a_map_without_surface_is_scored_without_mesh(sequence: RgbdSequence) -> None:
    """Catches a lost map: no surface yet is no error, its mesh scores are just empty."""
    quality = quality_of(sequence, -10.0)
    assert {quality[name] for name in quality if name.startswith("mesh")} == {None}


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
    whole, mesh = (extract_mesh(ShiftedRoom(sequence, 0.0), part) for part in (None, sequence))
    assert np.quantile(np.abs(ROOM.sdf(np.asarray(mesh.vertices))), 0.95) < 0.01
    assert len(mesh.vertices) < len(whole.vertices)
    blind = replace(sequence, depths_mm=np.zeros_like(sequence.depths_mm))
    with pytest.raises(DataError, match="no frame saw the surface"):
        extract_mesh(ShiftedRoom(sequence, 0.0), blind)
