"""The open questions: the right cells, and numbers read from curves by hand."""

from pathlib import Path

import pandas as pd
import pytest
from tiny import TINY

from nbtrack.core.config import Preset
from nbtrack.core.settings import resolve_preset
from nbtrack.experiments.ablations import (
    compare_times,
    learning_rate_and_steps,
    quality_over_time,
    start_of_the_search,
    vr_in_both_maps,
)
from nbtrack.experiments.grid import prepare_scenes, table_1_cells
from nbtrack.experiments.scenes import Scene


@pytest.fixture
def preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Preset:
    """One room of a few pixels, an empty cache, one process."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    monkeypatch.setattr("nbtrack.experiments.parallel.os.cpu_count", lambda: 1)
    return resolve_preset("smoke", settings=(*TINY, "scenes.names=['office']"))


@pytest.fixture
def scenes(preset: Preset) -> list[Scene]:
    """The room."""
    return prepare_scenes(preset)


def test_reach_is_steps_times_rate(preset: Preset, scenes: list[Scene]) -> None:
    """Catches a factor that reaches neither the tracker nor the axis: 6.8 x 0.5 mm is 3.4 mm."""
    table = learning_rate_and_steps(preset, scenes[0], trackers=("vr",), factors=(1.0, 4.0))
    assert table["reach_mm"].tolist() == pytest.approx([3.4, 18.05, 3.4, 13.6])
    assert table["how"].tolist() == ["more steps"] * 2 + ["larger steps"] * 2
    errors = table["ate_m"].tolist()
    assert errors[0] == errors[2]  # the same run
    assert errors[3] != errors[2]


def test_the_papers_rows_stay_as_they_are(preset: Preset, scenes: list[Scene]) -> None:
    """Catches an ablation that changes Table I: a third row in it, or another start."""
    before = table_1_cells(preset, scenes)
    starts = start_of_the_search(preset, scenes, rate_hz=10)
    both = vr_in_both_maps(preset, scenes, rate_hz=10)
    assert both["method"].tolist() == ["iMAP with VR", "NeuS with SDF", "NeuS with VR"]
    pd.testing.assert_frame_equal(table_1_cells(preset, scenes), before)
    previous = starts[starts["motion_model"] == "previous_pose"].set_index("tracker")["ate_m"]
    paper = before[before["rate_hz"] == 10].set_index("method")["ate_m"]
    assert previous.to_dict() == paper.to_dict()
    assert both.set_index("method")["ate_m"][:2].to_dict() == pytest.approx(paper.to_dict())


def test_the_beginning_of_a_run_is_a_run(preset: Preset, scenes: list[Scene]) -> None:
    """Catches a comparison over different frames: a short run must equal the long one's start."""
    rows = vr_in_both_maps(preset, scenes, rate_hz=10, n_frames=3).set_index("method")["ate_m"]
    short = resolve_preset(
        "smoke", settings=(*TINY, "scenes.names=['office']", "scenes.track_frames=0:3")
    )
    alone = table_1_cells(short, scenes)
    alone = alone[alone["rate_hz"] == 10].set_index("method")["ate_m"]
    for method in ("iMAP with VR", "NeuS with SDF"):
        assert rows[method] == pytest.approx(alone[method], rel=1e-9)


def test_maps_of_growing_length(preset: Preset, scenes: list[Scene]) -> None:
    """Catches points that are not maps of their own, or scored without held-out frames."""
    held_out = resolve_preset(
        "smoke",
        settings=(*TINY, "mapping.imap.holdout_every=2", "mapping.neus.holdout_every=2"),
    )
    curves = quality_over_time(held_out, scenes[0], shares=(0.5, 1.0))
    assert curves["iterations"].tolist() == [3, 6, 3, 6]
    assert curves["depth_l1_m"].notna().all()
    assert (curves["seconds"] > 0).all()


def test_times_by_hand(preset: Preset) -> None:
    """Catches a ratio read at different errors: iMAP passes 2 cm at 20 s, NeuS ends there at 90."""
    curves = pd.DataFrame(
        {
            "field": ["imap", "imap", "neus", "neus"],
            "iterations": [3, 6, 3, 6],
            "seconds": [10.0, 40.0, 45.0, 90.0],
            "depth_l1_m": [0.04, 0.01, 0.08, 0.02],
        }
    )
    times = compare_times(curves, preset)
    assert times.depth_l1_m == 0.02
    assert times.to_equal_quality == pytest.approx(4.5)
    samples = {
        name: (lambda c: c.n_rays * (c.n_stratified + c.n_surface))(preset.mapping_of(name))
        for name in ("imap", "neus")
    }
    expected = 90 / 40 * samples["imap"] / samples["neus"]
    assert times.per_iteration == pytest.approx(expected)
