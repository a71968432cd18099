"""The `paper` preset, whole, on a stand-in of the dataset: nine scenes of a few tiny frames."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tiny import TINY

from nbtrack.cli import main
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.recordings.pose_files import read_poses
from nbtrack.recordings.writer import write_sequence
from nbtrack.synthetic import build_room, room_frames, room_intrinsics
from nbtrack.tables import STANDING_STILL

N_FRAMES = 13  # so that img10 would come before img2 if sorted as text
WIDTH, HEIGHT = 32, 24


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Nine folders in the dataset's layout, under its names; what they show is one room of ours."""
    folder = tmp_path_factory.mktemp("neural_rgbd")
    frames = list(room_frames(build_room("living_room"), N_FRAMES, WIDTH, HEIGHT, seed=0))
    for name in DATASET_SCENES:
        write_sequence(folder / name, room_intrinsics(WIDTH, HEIGHT), frames)
        poses = read_poses(folder / name / "poses.txt")[0]
        poses[3:5] = np.nan  # as where BundleFusion lost the camera
        np.savetxt(folder / name / "trainval_poses.txt", poses.reshape(-1, 4))
    return folder


def test_nine_columns(dataset: Path, tmp_path: Path, monkeypatch) -> None:
    """Catches a preset that loses a scene of the dataset, or reads its frames in another order:
    every scene, one tracker, at one rate."""
    monkeypatch.setenv("NBTRACK_DATA", str(dataset))
    kept = [s for s in TINY if not s.startswith(("scenes.", "tables.rates"))]
    kept += ["scenes.track_frames=9:12", "tables.rates_hz=10"]
    for field in ("imap", "neus"):
        kept += [f"mapping.{field}.holdout_every=0", f"mapping.{field}.iterations=2"]
    words = [word for setting in kept for word in ("--set", setting)]
    words += ["--method", "sdf", "--workers", "1", "--out", str(tmp_path / "out")]
    assert main(["tables", "--preset", "paper", *words]) == 0
    cells = pd.read_csv(tmp_path / "out" / "table_1.csv")
    assert set(cells["scene"]) == set(DATASET_SCENES.values())
    assert cells["ate_m"].notna().all()
    still = cells["method"] == STANDING_STILL
    assert still.sum() == (~still).sum() == 9
    # Frames 9, 10 and 11 are neighbours only in natural order: errors stay those of two frames.
    assert cells["ate_m"].max() < 0.1
    latex = (tmp_path / "out" / "table_1.tex").read_text()
    assert "{@{}llrrrrrrrrr@{}}" in latex
    beside = pd.read_csv(tmp_path / "out" / "table_1_vs_paper.csv")
    assert beside["source"].tolist() == ["ours", "paper", "difference", "ours"]
    ours, paper, difference, _ = beside["Thin Geo."]
    assert paper == 0.031
    assert difference == pytest.approx(ours - paper, abs=1e-6)
