"""Maps and runs of scenes: complete, cached, the same when done again, and keyed by what counts."""

import json
import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recordings import write_recording
from tiny import TINY, tiny_words

from nbtrack import METHODS, load_preset, map_scene, map_scenes, open_scenes, read_run, track_scenes
from nbtrack.beyond.correction import CorrectedField
from nbtrack.beyond.points import PointCloud
from nbtrack.cli import main
from nbtrack.experiments.bench import default_pixels, measure_steps
from nbtrack.experiments.jobs import Execution, Report
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.methods import RATES_3_HZ, TABLE_1, TABLE_3
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.machinery.errors import ConfigError, DataError, MissingError
from nbtrack.machinery.settings import with_settings
from nbtrack.tables import table_1
from nbtrack.tracking import make_tracker


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """One cache for all tests here, so that rooms and maps are made once, and one process."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("runs")
        patch.setenv("NBTRACK_RUNS", str(folder))
        yield folder


@pytest.fixture(scope="module")
def preset(cache: Path):
    return load_preset("smoke", settings=TINY)


@pytest.fixture(scope="module")
def scenes(preset) -> list[Scene]:
    """Two rooms of a few pixels."""
    return open_scenes(preset)


@pytest.fixture
def coarse_methods(monkeypatch) -> None:
    """A grid of a whole room in cells of 4 cm takes seconds to fill."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 2000)
    for name, method in METHODS.items():
        settings = tuple(text.replace("=0.04", "=0.3") for text in method.settings)
        monkeypatch.setitem(METHODS, name, replace(method, settings=settings))


def test_table_1_twice(preset, scenes: list[Scene], tmp_path: Path, monkeypatch) -> None:
    """Catches missing cells, runs that are made again, and hidden randomness anywhere."""
    cells = track_scenes(scenes, TABLE_1, preset)
    assert len(cells) == 2 * 2 * 2  # methods, rates, rooms
    assert cells["ate_m"].notna().all()
    assert set(cells["method"]) == {"iMAP with VR", "NeuS with SDF"}
    run = read_run(cells["run"][0])
    assert run.T_estimated.shape == run.T_true.shape == (4, 4, 4)
    assert len(run.frames) == 4
    with monkeypatch.context() as patch:
        for made in ("map_jobs.map_sequence", "track_jobs.track_sequence"):
            patch.delattr(f"nbtrack.experiments.{made}")
        again = track_scenes(open_scenes(preset), TABLE_1, preset)
    pd.testing.assert_frame_equal(again, cells)
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path))
    elsewhere = track_scenes(scenes[1:], TABLE_1, preset, [10])
    here = cells[(cells["scene"] == scenes[1].name) & (cells["rate_hz"] == 10)]
    assert elsewhere["ate_m"].tolist() == here["ate_m"].tolist()


def test_keys_change_with_what_matters(preset, scenes: list[Scene], monkeypatch) -> None:
    """Catches a cached result that is taken for one of another setting, seed, slice or version, and
    one that is made anew for a setting that it does not read."""
    cells = [
        MapJob.of(scenes[0], "neus", preset),
        MapJob.of(scenes[0], "imap", preset),
        MapJob.of(scenes[0], "neus", preset, seed=1),
        MapJob.of(scenes[0], "neus", preset, frames=":3"),
        MapJob.of(scenes[0], "neus", with_settings(preset, "mapping.neus.n_rays=9")),
        MapJob.of(scenes[1], "neus", preset),
    ]
    assert len({cell.key for cell in cells}) == 6
    other = with_settings(preset, "tracking.sdf.n_pixels=17", "network.neus.width=7")
    assert MapJob.of(scenes[0], "points", other).key == MapJob.of(scenes[0], "points", preset).key
    runs = [TrackJob(cells[0], scenes[0], "sdf", preset.tracking_of("sdf"), 2) for _ in range(2)]
    assert runs[0].key == runs[1].key
    changes = [{"settings": other.tracking_of("sdf")}, {"steps": 3}, {"seed": 1}]
    changes += [{"frames": ":3"}, {"start": "unknown"}]
    assert len({run.key for run in [runs[0], *(replace(runs[0], **c) for c in changes)]}) == 6
    monkeypatch.setattr("nbtrack.provenance.versions", lambda: {"torch": "another"})
    assert MapJob.of(scenes[0], "neus", preset).key != cells[0].key
    assert replace(runs[0]).key != runs[1].key


def test_maps_and_their_scores(preset, scenes: list[Scene]) -> None:
    """Catches scores that are missing for a room whose truth is known, and maps made twice."""
    scores = map_scenes(scenes[1:], ["neus", "neus_plus"], preset)
    assert scores["field"].tolist() == ["neus", "neus_plus"]
    assert scores[["seconds", "sdf_near_m", "sdf_free_m"]].notna().all().all()
    found = map_scene(scenes[1], "neus", preset)
    assert found.record["seconds"] == scores["seconds"][0]
    versions = {"nbtrack", "torch", "python", "numba", "scipy"}
    assert versions <= set(found.record["versions"])  # where it comes from
    assert len(found.history) == 6


def test_budgets(preset, scenes: list[Scene], monkeypatch) -> None:
    """Catches another budget than asked for: the paper's steps, so many steps, or the clock."""
    by_steps = track_scenes(scenes[1:], ["vr_neus", "sdf"], preset, [10])
    assert by_steps["steps"].tolist() == [6.8, 15.3]
    assert by_steps["rate_hz"].tolist() == [10, 10]
    fixed = track_scenes(scenes[1:], ["sdf"], preset, steps=3, frames=":3")
    assert (fixed["steps"][0], fixed["frames"][0]) == (3, 2)
    clock = track_scenes(scenes[1:], ["sdf"], preset, [10], clock=True)
    assert "wall clock" in clock["budget"][0]
    assert clock["steps"].isna().all()
    tried = []

    def fail(job: MapJob, report: Report) -> None:
        tried.append(job.name)
        raise DataError("it diverges")

    monkeypatch.setattr(MapJob, "compute", fail)
    on = Execution(workers=1, keep_going=True)
    failed = track_scenes(scenes[1:], ["sdf"], preset, [10], clock=True, seeds=[9], execution=on)
    assert "it diverges" in failed["failure"][0]
    assert len(tried) == 1  # no second time for the run


def test_table_3(tmp_path: Path, coarse_methods: None, monkeypatch) -> None:
    """Catches rows of Table III that are other runs than those of Table I, or go without a map."""
    assert set(TABLE_1) < set(TABLE_3)
    assert RATES_3_HZ[0] == 30
    monkeypatch.setattr("nbtrack.experiments.bench.RATES_3_HZ", RATES_3_HZ[:1])
    words = tiny_words("scenes.names=office", "scenes.track_frames=:2", "tracking.lm.voxel=0.3")
    words += ["--no-still", "--set", "scenes.labels=['office=My_1 [2]']", "--caption"]
    assert main(["tables", "--beyond", "--workers", "1", "--out", str(tmp_path), *words]) == 0
    assert len(pd.read_csv(tmp_path / "table_3.csv")) == len(TABLE_3)
    latex = (tmp_path / "table_3.tex").read_text()
    assert latex.count("NeuS+ baked (LM)") == latex.count(r"My\_1\\{}[2]") == 1
    assert "best at this rate).}\n" in latex


def test_every_method_is_made_again_from_its_command(
    preset, scenes: list[Scene], tmp_path: Path, coarse_methods: None, monkeypatch
) -> None:
    """Catches a command that lacks a setting, a seed or a slice, or is refused; of the first method
    the map is made anew too."""
    few = [f"mapping.{field}.iterations=6" for field in ("volsdf", "occupancy")]
    coarse = with_settings(preset, "tracking.lm.voxel=0.3", *few)
    how = {"steps": 2, "frames": "1:4", "seeds": [1], "execution": Execution(workers=1)}
    runs = track_scenes(scenes[1:], [*METHODS], coarse, **how)
    assert runs["failure"].eq("").all()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nbtrack.experiments.commands.draw_overview", lambda run: None)
    here, elsewhere = os.environ["NBTRACK_RUNS"], str(tmp_path / "elsewhere")
    for row in runs.itertuples():
        monkeypatch.setenv("NBTRACK_RUNS", here if row.Index else elsewhere)
        arguments = shlex.split(row.command)
        assert arguments[:3] == ["python", "-m", "nbtrack"]
        assert main(arguments[3:]) == 0, row.method
        again = read_run(tmp_path / arguments[-1])
        assert again.metrics["ate_rmse_m"] == row.ate_m, row.method
        assert again.metrics["seed"] == 1


def test_a_second_path(preset, scenes: list[Scene], tmp_path: Path, monkeypatch) -> None:
    """Catches a run on the mapped path, one taken for it in the cache, and a wrong command."""
    second = open_scenes(with_settings(preset, "scenes.seed=1"))[1:]
    found = track_scenes(scenes[1:], ["sdf"], preset, [10], tracked=second)
    assert found["ate_m"][0] != track_scenes(scenes[1:], ["sdf"], preset, [10])["ate_m"][0]
    assert found["scene"][0] == scenes[1].name  # the mapped one
    T_true = second[0].read().T_world_camera[1:]
    np.testing.assert_allclose(read_run(found["run"][0]).T_true, T_true, atol=1e-12)
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(found["command"][0])[3:]
    assert main(arguments) == 0
    metrics = json.loads((tmp_path / arguments[-1] / "metrics.json").read_text())
    assert metrics["ate_rmse_m"] == found["ate_m"][0]


def test_a_recording_without_reference(preset, scenes: list[Scene], tmp_path: Path) -> None:
    """Catches a table that ends, and loses its other cells, because one recording has no poses."""
    unknown = tmp_path / "unknown"
    shutil.copytree(scenes[1].folder, unknown)
    poses = np.loadtxt(unknown / "poses.txt")
    poses[4:] = np.nan  # but for the first frame
    np.savetxt(unknown / "poses.txt", poses)
    tracked = [scenes[0], Scene("unknown", unknown)]
    results = track_scenes(scenes, ["sdf"], preset, [10], tracked=tracked)
    assert results["ate_m"].isna().tolist() == [False, True]
    assert (results["failure"] == "").all()
    assert table_1(results).isna().sum(axis=None) == 2  # of the method, and of standing still


def test_a_cached_run_is_checked(cache: Path, preset, scenes: list[Scene]) -> None:
    """Catches a table that ends in a traceback, or as a whole, or holds a hole without a word, for
    a spoilt file of the cache."""
    run, _ = track_scenes(scenes, ["sdf"], preset, [10])["run"]
    path = cache / "tracks" / run / "metrics.json"
    sound = path.read_text()
    for spoilt in ("{}", sound.replace('"key": "', '"key": "0')):
        path.write_text(spoilt)
        with pytest.raises(DataError, match="is not what this run has written"):
            track_scenes(scenes, ["sdf"], preset, [10])
        on = Execution(workers=1, keep_going=True)
        results = track_scenes(scenes, ["sdf"], preset, [10], execution=on)
        assert results["ate_m"].isna().tolist() == [True, False]
        assert "is not what this run has written" in results["failure"][0]
    path.write_text(sound)


def test_table_2_of_this_machine(preset, scenes: list[Scene]) -> None:
    """Catches empty cells: even a slow machine fits a step of 16 points into 20 ms sometimes; and
    rows that stand there twice, where two methods share a tracker."""
    steps = measure_steps(preset, scenes[0], [*TABLE_1, "vr_neus"])
    assert steps[["tracker", "n_pixels"]].to_numpy().tolist() == [["VR", 4], ["SDF", 8]]
    assert (steps["steps"] >= 0).all()
    assert default_pixels(preset) == {"VR": 8, "SDF": 16}


def test_table_2_measures_own_settings(tmp_path: Path, scenes: list[Scene], monkeypatch) -> None:
    """Catches points without a map, and settings of a method that Table II does not know: then raw,
    untrained networks are measured in place of corrected maps, and another n."""
    fields = {}

    def seen(name: str, field: object, *arguments: object) -> object:
        fields[name] = field
        return make_tracker(name, field, *arguments)

    monkeypatch.setattr("nbtrack.experiments.bench.make_tracker", seen)
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 2000)
    settings = ("correction.neus_plus=0.3", "tracking.lm.n_pixels=64")
    monkeypatch.setitem(METHODS, "corrected", replace(METHODS["corrected"], settings=settings))
    words = tiny_words("scenes.names=office", "tables.rates_hz=[10]", "scenes.track_frames=:2")
    words += ["--set", "tracking.lm.n_pixels=8", "--workers", "1", "--out", str(tmp_path)]
    assert main(["tables", "--method", "icp,corrected", *words]) == 0
    assert isinstance(fields["icp"], PointCloud)
    assert isinstance(fields["lm"], CorrectedField)
    steps = pd.read_csv(tmp_path / "table_2.csv")
    assert steps[["tracker", "n_pixels"]].to_numpy().tolist() == [["ICP", 8], ["LM", 8]]
    assert "\\bfseries 8 " in (tmp_path / "table_2.tex").read_text()


def test_wrong_scenes_are_told_first(preset, tmp_path: Path, monkeypatch) -> None:
    """Catches a misspelt column that is left out in silence, a column counted as two seeds, an
    unhelpful error where the dataset was not downloaded, and minutes of mapping before a recording
    turns out to be shorter than the part that the preset tracks."""
    for names, message in (
        ("['living_rom']", "no sequence 'living_rom': it is neither a folder nor .*did you mean"),
        ("['office', 'office']", "office, office: give at least one, and of one name only one"),
        ("[]", "give at least one"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_scenes(with_settings(preset, f"scenes.names={names}"))
    with pytest.raises(DataError, match=r"0 of the 5 .*scenes.track_frames"):
        track_scenes(open_scenes(preset), ["sdf"], preset, frames="90:140", seeds=[7])
    assert not MapJob.of(open_scenes(preset)[0], "neus", preset, seed=7).is_done
    monkeypatch.setenv("NBTRACK_DATA", str(tmp_path / "nothing"))
    with pytest.raises(MissingError, match=r"no folder .*breakfast_room.*data/README.md"):
        open_scenes(load_preset("paper"))


def test_a_scene_whose_tracked_part_has_no_pose(cache: Path, tmp_path: Path, capsys) -> None:
    """Catches a whole scene whose results are lost, because the first frame of the one beside it,
    on which steps are counted, has no pose, or its map is damaged."""
    lost, whole = (write_recording("neural_rgbd", tmp_path / name) for name in ("lost", "whole"))
    rows = (lost / "poses.txt").read_text().splitlines()
    (lost / "poses.txt").write_text("\n".join([*(4 * ["nan nan nan nan"]), *rows[4:]]) + "\n")
    words = tiny_words(f"scenes.names=['{lost}', '{whole}']", "scenes.track_frames=:")
    command = ["tables", "--method", "sdf", "--workers", "1", "--out", str(tmp_path / "out")]
    assert main([*command, *words]) == 2
    assert "cells of the table failed" in capsys.readouterr().err
    errors = pd.read_csv(tmp_path / "out/table_1.csv").set_index(["method", "scene"])["ate_m"]
    assert errors.notna().loc["NeuS with SDF", "whole"].all()
    assert errors.isna().loc["NeuS with SDF", "lost"].all()
    (damaged,) = cache.glob("maps/lost-*/map.safetensors")
    damaged.write_bytes(b"")
    (tmp_path / "out/table_2.csv").unlink()
    assert main([*command, *words]) == 2
    assert "map.safetensors is not a readable map file" in capsys.readouterr().err
    assert len(pd.read_csv(tmp_path / "out/table_2.csv")) == 1


def test_a_damaged_scene_leaves_the_others(preset, tmp_path: Path, capsys) -> None:
    """Catches one bad folder, or one scene that was not downloaded, that stops the whole grid."""
    broken = write_recording("neural_rgbd", tmp_path / "broken")
    (broken / "images/img2.png").unlink()
    names = f"scenes.names=['{broken}', 'office', 'kitchen']"
    assert [s.name for s in open_scenes(with_settings(preset, names))] == ["office"]
    errors = capsys.readouterr().err
    assert f"missing, and left out: {broken}, kitchen (" in errors
    assert "depth2.png" in errors
