"""Table III, the basin of convergence and the ingredients: rows, budgets, scores."""

import math

import numpy as np
import pandas as pd
import pytest
from tiny import TINY

from nbtrack.cli import main
from nbtrack.core.settings import resolve_preset, with_settings
from nbtrack.experiments import basin, beyond
from nbtrack.experiments.grid import plan_table_1, prepare_scenes
from nbtrack.experiments.parallel import Execution
from nbtrack.plots import plot_basin, plot_ingredients, plot_speed_accuracy
from nbtrack.tables.latex import TableNotes, write_table_3

SETTINGS = (
    *TINY, "scenes.names=office", "mapping.neus_plus.iterations=6", "mapping.neus_plus.n_rays=8",
    "mapping.neus_plus.n_surface_points=16", "tracking.vr_neus.n_pixels=8",
    "tracking.lm.n_pixels=32", "tracking.lm.n_restarts=0", "tracking.icp.n_pixels=64",
    "tracking.vr.n_stratified=4", "tracking.vr_neus.n_stratified=4",
)  # fmt: skip

HERE = Execution(workers=1)


@pytest.fixture(scope="module")
def preset(tmp_path_factory):
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path_factory.mktemp("runs")))
        yield with_settings(resolve_preset("smoke"), *SETTINGS)


def test_rows_of_table_1_are_the_same_runs(preset) -> None:
    """Catches a Table III that tracks the paper's methods once more, with other settings."""
    scenes = prepare_scenes(preset)
    of_table_1 = {cell.run.key for cell in plan_table_1(preset, scenes)}
    cells = beyond.plan_table_3(preset, scenes)
    assert len(cells) == len(beyond.METHODS) * len(beyond.RATES_HZ)
    shared = [c for c in cells if c.run.key in of_table_1]
    assert {c.method for c in shared} == set(beyond.PAPERS_METHODS)
    assert {c.rate_hz for c in shared} == set(preset.tables.rates_hz)


def test_budgets(preset) -> None:
    """Steps on the paper's hardware: 6.8 and 15.3 at 10 Hz; by the clock no step count at all."""
    scenes = prepare_scenes(preset)
    at_10 = {c.method: c.run for c in beyond.plan_table_3(preset, scenes) if c.rate_hz == 10}
    assert at_10["iMAP with VR"].steps == at_10["NeuS with VR"].steps == 6.8
    assert at_10["NeuS+ with SDF (LM)"].steps == 15.3
    by_clock = beyond.plan_table_3(preset, scenes, "clock")
    assert all(c.run.steps is None and c.run.rate_hz == c.rate_hz for c in by_clock)
    baked = at_10["NeuS+ baked (LM)"].map_cell
    assert baked.key == at_10["NeuS+ with SDF (LM)"].map_cell.key  # one map serves both


def test_table_3_is_filled_and_written(preset, tmp_path) -> None:
    results = beyond.table_3_results(preset, prepare_scenes(preset), execution=HERE)
    assert results["ate_m"].notna().all()
    paths = write_table_3(tmp_path, results, TableNotes("tiny", "steps", "CPU"))
    assert [path.name for path in paths] == ["table_3.csv", "table_3.tex"]
    text = paths[1].read_text()
    assert r"\multirow{7}{*}{$r=\SI{30}{Hz}$}" in text
    assert text.count("NeuS+ baked (LM)") == 4
    points = beyond.speed_and_accuracy(results)
    assert points["method"].tolist() == [method.label for method in beyond.METHODS]
    assert plot_speed_accuracy(points).axes[0].get_xlabel() == "time a frame (ms)"


def test_speed_and_accuracy_by_hand() -> None:
    results = pd.DataFrame(
        {
            "rate_hz": [10, 10, 2], "method": "A", "seconds_per_frame": [0.01, 0.03, 9.0],
            "ate_m": [0.02, 0.04, 9.0], "steps_per_frame": [3.0, 5.0, 9.0],
        }
    )  # fmt: skip
    (row,) = beyond.speed_and_accuracy(results).to_dict("records")
    assert row == pytest.approx({"method": "A", "ms_per_frame": 20, "ate_cm": 3, "steps": 4})


def test_each_ingredient_changes_one_thing(preset) -> None:
    """Every row but the first differs from it, in the run or in the map."""
    scenes = prepare_scenes(preset)
    table = beyond.what_each_ingredient_adds(preset, scenes, (1, 2), HERE)
    assert len(table) == 2 * len(beyond.INGREDIENTS)
    assert table["ate_m"].notna().all()
    keys = {
        beyond._ablated(preset, scenes[0], field_name, settings, 1).key
        for _, field_name, settings in beyond.INGREDIENTS
    }
    assert len(keys) == len(beyond.INGREDIENTS)
    assert len(plot_ingredients(table).axes) == 2


def test_map_errors(preset) -> None:
    scenes = prepare_scenes(preset)
    beyond.table_3_results(preset, scenes, methods=beyond.METHODS[2:4], execution=HERE)
    errors = beyond.map_errors(preset, scenes)
    assert errors["field"].tolist() == ["neus", "neus_plus"]
    assert (errors[["seconds", "near_cm", "free_cm"]] > 0).all().all()


def test_searches_start_as_far_off_as_they_say() -> None:
    """Catches degrees taken for radians: 20 cm and 15 degrees along unit directions."""
    for seed in range(5):
        twist = basin._offset(seed, 20, 15)
        assert float(twist[:3].norm()) == pytest.approx(math.radians(15), abs=1e-6)
        assert float(twist[3:].norm()) == pytest.approx(0.2, abs=1e-6)
    assert not np.allclose(basin._offset(0, 20, 15), basin._offset(1, 20, 15))


def test_find_from_afar(preset) -> None:
    (scene,) = prepare_scenes(preset)
    compared = [(method, 2) for method, _ in basin.COMPARED]
    searches = basin.find_from_afar(preset, scene, compared, ((0, 0), (4, 4)), 2, HERE)
    assert len(searches) == 3 * 2 * 2
    shares = basin.share_recovered(searches)
    assert list(shares.columns) == ["0 cm, 0°", "4 cm, 4°"]
    assert shares.index.get_level_values("steps").tolist() == [2, 2, 2]
    assert set(basin.score_verdicts(searches)) == {"NeuS+ with SDF (LM)", "NeuS+ baked (LM)"}
    assert plot_basin(shares).axes[0].get_ylabel() == "found to 2 cm and 1°"


def test_share_and_verdicts_by_hand() -> None:
    """Two of four end within 2 cm and 1°; of two called lost one is, of two lost one is called."""
    searches = pd.DataFrame(
        {
            "method": "A", "steps": 5, "offset_cm": 1, "offset_deg": 1,
            "error_m": [0.019, 0.0, 0.3, 0.5], "error_deg": [0.9, 0.0, 0.0, 3.0],
            "called_lost": [True, False, True, False],
        }
    )  # fmt: skip
    assert basin.share_recovered(searches).to_numpy().tolist() == [[0.5]]
    score = basin.score_verdicts(searches)["A"]
    assert (score.precision, score.recall) == (0.5, 0.5)


def test_command(preset, tmp_path, capsys) -> None:
    words = [word for setting in SETTINGS for word in ("--set", setting)]
    assert main(["tables", "--beyond", "--workers", "1", "--out", str(tmp_path), *words]) == 0
    assert "Table III" in capsys.readouterr().out
    assert (tmp_path / "table_3_cells.csv").is_file()
    assert main(["tables", "--beyond", "--trackers", "vr", *words]) == 2
    assert "--beyond has rows of its own" in capsys.readouterr().err
    assert main(["tables", "--beyond", "--explain", "10 icp", "office", *words]) == 0
    assert "tracker icp" in capsys.readouterr().out
