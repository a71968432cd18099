"""Cells and tables of a preset: complete, cached, and the same when done again."""

from pathlib import Path

import cv2
import pandas as pd
import pytest
from tiny import TINY

from nbtrack.core.config import Preset
from nbtrack.core.device import choose_device
from nbtrack.core.errors import ConfigError, MissingError
from nbtrack.core.settings import resolve_preset, with_settings
from nbtrack.experiments.bench import default_pixels, measure_steps
from nbtrack.experiments.cells import MapCell
from nbtrack.experiments.grid import (
    map_cells,
    plan_table_1,
    prepare_scenes,
    run_maps,
    table_1_cells,
    table_1_results,
    track_cells,
)
from nbtrack.experiments.parallel import Execution
from nbtrack.experiments.results import map_summary, read_frames, read_poses
from nbtrack.experiments.scenes import find_scene
from nbtrack.tables.claims import in_words, iteration_ratio, paper_claims
from nbtrack.tables.layout import published_table_1, published_table_2, table_1


@pytest.fixture
def preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Preset:
    """Two rooms of a few pixels, an empty cache, and one process for everything."""
    for name in ("NBTRACK_PRESET", "NBTRACK_CONFIG", "NBTRACK_SET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    monkeypatch.setattr("nbtrack.experiments.parallel.os.cpu_count", lambda: 1)
    return resolve_preset("smoke", settings=TINY)


def test_table_1_is_complete_and_cached(preset: Preset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches missing cells, and runs that are made again although they lie in the cache."""
    scenes = prepare_scenes(preset)
    cells = table_1_cells(preset, scenes)
    assert len(cells) == 2 * 2 * 2  # methods, rates, rooms
    assert cells["ate_m"].notna().all()
    assert set(cells["method"]) == {"iMAP with VR", "NeuS with SDF"}
    assert table_1(cells).shape == (4, 2)

    def forbidden(*arguments: object, **options: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr("nbtrack.experiments.results.map_sequence", forbidden)
    monkeypatch.setattr("nbtrack.experiments.results.track_sequence", forbidden)
    pd.testing.assert_frame_equal(table_1_cells(preset, scenes), cells)


def test_results_are_the_same_when_done_again(
    preset: Preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches hidden randomness anywhere between the room and the table."""
    first = table_1_cells(preset, prepare_scenes(preset))
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "other"))
    second = table_1_cells(preset, prepare_scenes(preset))
    assert first["ate_m"].tolist() == second["ate_m"].tolist()


def test_keys_change_with_what_matters(preset: Preset) -> None:
    """Catches a cached result that is taken for one of another setting, seed or slice."""
    scene = find_scene("living_room", preset.scenes)
    cell = MapCell(scene, "neus", preset)
    others = [
        MapCell(scene, "imap", preset),
        MapCell(scene, "neus", preset, seed=1),
        MapCell(scene, "neus", preset, frames=":3"),
        MapCell(scene, "neus", resolve_preset("smoke", settings=(*TINY, "mapping.neus.n_rays=9"))),
    ]
    assert len({cell.key, *(other.key for other in others)}) == 5
    untouched = resolve_preset("smoke", settings=(*TINY, "tracking.sdf.n_pixels=17"))
    assert MapCell(scene, "neus", untouched).key == cell.key


def test_map_scores_and_run_files(preset: Preset) -> None:
    """Catches scores that are missing for a room whose truth is known, and unreadable runs."""
    scenes = prepare_scenes(preset)
    quality = run_maps(map_cells(preset, "neus", scenes))
    assert quality.index.tolist() == list(preset.scenes.names)
    assert quality[["sdf_near_m", "sdf_free_m"]].notna().all().all()
    assert map_summary(map_cells(preset, "neus", scenes)[0])["seconds"] > 0
    table_1_cells(preset, scenes)
    cell = track_cells(preset, "sdf", scenes)[0]
    estimated, true = read_poses(cell)
    assert estimated.shape == true.shape == (4, 4, 4)
    assert len(read_frames(cell)) == 5


def test_clock_cells(preset: Preset) -> None:
    """Catches a budget that is ignored: by the clock, cells carry a rate and no step count."""
    scenes = prepare_scenes(preset)
    assert [c.rate_hz for c in track_cells(preset, "vr", scenes, "clock")] == [10, 10, 2, 2]
    assert [c.steps for c in track_cells(preset, "vr", scenes)] == [6.8, 6.8, 36.1, 36.1]
    with pytest.raises(ConfigError, match="unknown budget 'time'"):
        track_cells(preset, "vr", scenes, "time")


def test_table_2_of_this_machine(preset: Preset) -> None:
    """Catches empty cells: even a slow machine fits a step of 16 points into 20 ms sometimes."""
    scene = find_scene("living_room", preset.scenes)
    cells = measure_steps(preset, scene.read(slice(0, 1)), choose_device(), progress=False)
    assert cells[["tracker", "n_pixels"]].to_numpy().tolist() == [
        ["VR", 4], ["SDF", 8], ["VR, engine", 4], ["SDF, engine", 8],
    ]  # fmt: skip
    assert (cells["steps"] >= 0).all()
    assert default_pixels(preset)["VR"] == default_pixels(preset)["VR, engine"] == 8
    assert default_pixels(preset)["SDF"] == 16


def test_missing_dataset_scene_is_named(
    preset: Preset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches an unhelpful error where the dataset was not downloaded."""
    monkeypatch.setenv("NBTRACK_DATA", str(tmp_path / "nothing"))
    paper = resolve_preset("paper")
    with pytest.raises(MissingError, match=r"no folder .*breakfast_room.*data/README.md"):
        prepare_scenes(paper)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ("['living_rom']", "unknown scene 'living_rom', and no such folder: did you mean"),
        ("['office', 'office']", "two have one name"),
        ("[]", "no scene is named"),
    ],
)
def test_wrong_scenes_are_told_before_anything_is_made(
    preset: Preset, names: str, told: str
) -> None:
    """Catches a misspelt column that is left out in silence, and a column counted as two seeds."""
    wrong = with_settings(preset, f"scenes.names={names}")
    with pytest.raises(ConfigError, match=told):
        prepare_scenes(wrong)


def test_a_damaged_scene_leaves_the_others(preset: Preset, capsys: pytest.CaptureFixture) -> None:
    """Catches one bad folder that stops the whole grid."""
    scenes = prepare_scenes(preset)
    (scenes[0].folder / "images" / "img2.png").unlink()
    said = []
    assert [s.name for s in prepare_scenes(preset, said.append)] == ["office"]
    assert "left out: living_room" in said[-1]
    assert "4 images but 5 depth maps" in said[-1]


def test_a_failed_map_tells_why_in_every_cell(preset: Preset) -> None:
    """Catches a reason that is lost between the map that failed and the runs that need it."""
    scenes = prepare_scenes(preset)
    for depth in (scenes[0].folder / "depth_filtered").iterdir():
        image = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(depth), 0 * image)
    execution = Execution(workers=1, keep_going=True)
    results = table_1_results(plan_table_1(preset, scenes), execution=execution)
    failed = results[results["scene"] == "living_room"]
    assert failed["failure"].str.contains("no pixel of living_room has a depth").all()
    assert failed["ate_m"].isna().all()
    assert results.loc[results["scene"] == "office", "ate_m"].notna().all()


def test_the_paper_supports_its_own_claims() -> None:
    """Catches a claim that is judged wrongly: the published numbers must support all of them."""
    claims = paper_claims(published_table_1(), published_table_2(), 2.0)
    assert claims["verdict"].eq("supported").all()
    assert claims["here"].tolist()[:2] == [
        "VR 9, SDF 2 of 18 cells above 0.2 m",
        "VR better in 6 of 9 scenes",
    ]


def test_no_failures_decide_nothing() -> None:
    """Catches "not supported" where no camera was lost by either method."""
    cells = published_table_1().assign(ate_m=0.01)
    claims = paper_claims(cells, published_table_2(), 1.0)
    verdicts = ["undecided", "not supported", "supported", "not supported"]
    assert claims["verdict"].tolist() == verdicts
    assert in_words(claims).startswith("UNDECIDED: SDF tracking fails less often")


def test_iteration_ratio_is_per_sample() -> None:
    """Catches a ratio that forgets batch sizes: 2 x the seconds on half the samples is 4."""
    preset = resolve_preset(
        "smoke",
        settings=(
            "mapping.imap.iterations=10", "mapping.imap.n_rays=20", "mapping.imap.n_stratified=6",
            "mapping.imap.n_surface=4", "mapping.neus.iterations=10", "mapping.neus.n_rays=10",
            "mapping.neus.n_stratified=6", "mapping.neus.n_surface=4",
        ),
    )  # fmt: skip
    assert iteration_ratio(preset, {"imap": [1.0, 3.0], "neus": [4.0]}) == pytest.approx(4.0)
