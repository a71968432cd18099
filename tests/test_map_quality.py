"""Scores of maps, on fields whose errors are known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.data.sequence import RgbdSequence, observed_bounds, read_sequence
from nbtrack.fields.base import LearnedField
from nbtrack.mapping.meshes import extract_mesh, keep_seen, seen_by
from nbtrack.mapping.quality import score_map, score_mesh, score_sdf
from nbtrack.synthetic import Room, build_room, make_room


@pytest.fixture(scope="module")
def room() -> Room:
    """A furnished room with its exact distance."""
    return build_room("bedroom")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> RgbdSequence:
    """What a camera sees of it, with clean depth."""
    folder = tmp_path_factory.mktemp("data") / "bedroom"
    make_room("bedroom", folder, 30, 48, 36)
    return read_sequence(folder, depth_folder="depth")


class ShiftedRoom(LearnedField):
    """The exact room, its distance off by a constant: the surface moves by as much."""

    name, label, surface_level = "shifted", "shifted", 0.0

    def __init__(self, room: Room, bounds: SceneBounds, shift: float) -> None:
        super().__init__(bounds)
        self.room, self.shift = room, shift
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        sdf = self.room.sdf(points_world.double().numpy()) - self.shift
        return torch.full_like(points_world, 0.5), torch.from_numpy(sdf).float()

    def composite(self, *arguments: object) -> None:
        raise NotImplementedError

    mapping_losses = composite


@pytest.mark.parametrize("shift", [0.0, 0.02])
def test_sdf_error_is_the_shift(room: Room, sequence: RgbdSequence, shift: float) -> None:
    """Catches a score in the wrong unit, or near and free space mixed up: both are the shift."""
    field = ShiftedRoom(room, observed_bounds(sequence), shift)
    scores = score_sdf(field, sequence, np.arange(len(sequence)), room)
    assert scores == pytest.approx({"sdf_near_m": shift, "sdf_free_m": shift}, abs=1e-5)


def test_mesh_scores_of_the_truth(room: Room, sequence: RgbdSequence) -> None:
    """Catches scores that punish an exact map: within half a cell, and nearly all within 5 cm."""
    field = ShiftedRoom(room, observed_bounds(sequence), 0.0)
    scores = score_mesh(field, sequence, np.arange(len(sequence)), room, voxel=0.05)
    assert scores["mesh_accuracy_m"] < 0.01
    assert scores["mesh_completion_m"] < 0.03
    assert scores["mesh_f_score"] > 0.95


def test_mesh_scores_of_a_wrong_surface(room: Room, sequence: RgbdSequence) -> None:
    """Catches blind scores: a surface 8 cm inside the room is 8 cm off and beyond 5 cm."""
    field = ShiftedRoom(room, observed_bounds(sequence), 0.08)
    scores = score_mesh(field, sequence, np.arange(len(sequence)), room, voxel=0.05)
    assert scores["mesh_accuracy_m"] == pytest.approx(0.08, abs=0.01)
    assert scores["mesh_f_score"] < 0.3


def test_a_map_without_surface_is_scored_without_mesh(room: Room, sequence: RgbdSequence) -> None:
    """Catches a lost map: no surface yet is no error, its mesh scores are just empty."""
    field = ShiftedRoom(room, observed_bounds(sequence), -10.0)
    quality = score_map(field, sequence, np.arange(3), np.arange(0), room)
    assert quality.mesh_f_score is None
    assert quality.psnr_db is None


def test_seen_points(sequence: RgbdSequence) -> None:
    """Catches wrong visibility: what a pixel measured is seen, what lies far behind it is not."""
    T_world_camera = sequence.T_world_camera[0]
    depth = float(sequence.depth(0)[18, 24])
    for distance, expected in ((depth, True), (depth / 2, True), (depth + 0.5, False)):
        point = T_world_camera[:3, 3] + distance * T_world_camera[:3, 2]
        assert seen_by(point[None], sequence.select(slice(1)))[0] == expected
    behind = T_world_camera[:3, 3] - T_world_camera[:3, 2]
    assert not seen_by(behind[None], sequence.select(slice(1)))[0]


def test_seen_by_some_frames_only(sequence: RgbdSequence) -> None:
    """Catches a choice of frames that is ignored: what one frame saw, a frame behind it did not."""
    T_world_camera = sequence.T_world_camera[0]
    behind = T_world_camera[:3, 3] - T_world_camera[:3, 2]
    others = [i for i in range(len(sequence)) if seen_by(behind[None], sequence, np.array([i]))[0]]
    assert 0 not in others
    assert seen_by(behind[None], sequence, every=1)[0] == bool(others)


def test_mesh_is_in_metres_and_world_frame(
    room: Room, sequence: RgbdSequence, tmp_path: Path
) -> None:
    """Catches grid units or a lost offset: every corner lies on the exact surface."""
    mesh = keep_seen(extract_mesh(ShiftedRoom(room, observed_bounds(sequence), 0.0)), sequence)
    assert np.quantile(np.abs(room.sdf(np.asarray(mesh.vertices))), 0.95) < 0.01
    mesh.export(tmp_path / "room.ply")
