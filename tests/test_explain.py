"""Where a number comes from: the right cell, and a command that makes it again exactly."""

import json
import shlex
from pathlib import Path

import pytest
from tiny import TINY

from nbtrack.cli import main
from nbtrack.core.config import PRESETS
from nbtrack.core.settings import changed_settings, resolve_preset, with_settings
from nbtrack.experiments.scenes import find_scene

WORDS = [word for setting in (*TINY, "scenes.track_frames=1:4") for word in ("--set", setting)]


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and no settings of the caller's."""
    for name in ("NBTRACK_PRESET", "NBTRACK_CONFIG", "NBTRACK_SET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    return tmp_path


def test_a_cell_is_made_again_from_its_command(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Catches a command that lacks a setting, a seed or a slice: its map is made anew too."""
    options = ["--scenes", "office", "--seeds", "2", "--workers", "1", "--out", str(runs / "out")]
    assert main(["tables", *options, *WORDS]) == 0
    assert "±" in capsys.readouterr().out
    explain = ["--explain", "10 Hz NeuS with SDF", "office"]
    assert main(["tables", *options, *WORDS, *explain]) == 0
    printed = capsys.readouterr().out
    values = [line.split()[1] for line in printed.splitlines() if "ate_rmse_m" in line]
    commands = [line.split(None, 1)[1] for line in printed.splitlines() if "again " in line]
    assert len(values) == len(commands) == 2  # one a seed
    assert values[0] != values[1]
    monkeypatch.setenv("NBTRACK_RUNS", str(runs / "elsewhere"))
    monkeypatch.chdir(runs)
    arguments = shlex.split(commands[1])
    assert arguments[:3] == ["python", "-m", "nbtrack"]
    assert main(arguments[3:]) == 0
    metrics = json.loads((runs / arguments[-1] / "metrics.json").read_text())
    assert repr(metrics["ate_rmse_m"]) == values[1]
    assert metrics["seed"] == 1


def test_rows_and_columns_that_are_not_there(runs: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches an explanation of another cell than the one that was meant."""
    not_made = ["tables", "--scenes", "office", *WORDS, "--explain", "10 sdf", "office"]
    assert main(not_made) == 2
    assert "room office has not been made: run" in capsys.readouterr().err.splitlines()[-1]
    find_scene("office", resolve_preset("smoke", settings=TINY).scenes)
    for row, column, told in (
        ("1.2.3 sdf", "office", "no row '1.2.3 sdf'"),
        ("10 adam", "office", "no row '10 adam' in the table"),
        ("7 sdf", "office", "no row '7 sdf'"),
        ("sdf", "office", "no row 'sdf'"),
        ("10 sdf", "ofice", "no column 'ofice' in the table: did you mean 'office'"),
        ("10 sdf", "office", "has not been computed with these settings"),
    ):
        assert main(["tables", "--scenes", "office", *WORDS, "--explain", row, column]) == 2
        assert told in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("name", PRESETS)
def test_changed_settings_are_those_that_were_changed(name: str) -> None:
    """Catches settings that cannot be given again: every kind of value makes the round trip."""
    settings = (
        "mapping.neus.iterations=7", "tracking.sdf.motion_model=constant_velocity",
        "scenes.names=['a', 'b']", "tables.rates_hz=[3.5]", "network.imap.embedding_sigma=1.25",
        "tables.pixels.vr=[9]",
    )  # fmt: skip
    preset = with_settings(PRESETS[name], *settings)
    changed = changed_settings(preset)
    assert len(changed) == len(settings)
    assert with_settings(PRESETS[name], *changed) == preset
    assert changed_settings(resolve_preset(name)) == []
