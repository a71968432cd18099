"""The command line: every mistake is one line on standard error and exit status 2."""

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import write_recording
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.tracking.trajectories import read_tum

TINY = tiny_words("scenes.n_frames=6", "tracking.sdf.n_pixels=32")


@pytest.fixture(autouse=True)
def runs(few_scores: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and none of the caller's settings."""
    for name in ("NBTRACK_PRESET", "NBTRACK_CONFIG", "NBTRACK_SET", "NBTRACK_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    return tmp_path / "runs"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sound sequence of six frames, to be spoilt."""
    return write_recording("neural_rgbd", tmp_path / "scene")


def failure(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    """The one line that a failing command prints."""
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("nbtrack: "), error
    assert error.count("\n") == 1, error
    return error


def track(path: Path | str, *more: str) -> list[str]:
    """A tracking command for a folder."""
    words = ["track", str(path), "--field", "neus", "--tracker", "sdf", "--steps", "2"]
    return [*words, *TINY, *more]


ROOM = "track living_room --field neus"
WRONG = {
    "no folder": ("track does/not/exist --field neus --tracker sdf --steps 2",
                  "no sequence 'does/not/exist'"),
    "room": ("track living_rom --field neus --tracker sdf --steps 2", "did you mean 'living_room'"),
    "supervision": ("map living_room --field imap --supervision rendering+sdf",
                    "'imap' knows no supervision 'rendering+sdf'"),
    "baked and rendered": (f"{ROOM} --tracker vr --steps 2 --bake 0.04",
                           "did you mean 'tracking.lm.bake_voxel'"),
    "field": ("map living_room --field imapp", "did you mean 'imap'"),
    "tracker": (f"{ROOM} --tracker sfd --steps 2", "did you mean 'sdf'"),
    "pair": ("track living_room --field imap --tracker sdf --steps 2", "take one of neus"),
    "rate": (f"{ROOM} --tracker sdf --rate 0", "rate_hz is 0"),
    "steps": (f"{ROOM} --tracker sdf --steps -1", "steps_per_frame is -1"),
    "no budget": (f"{ROOM} --tracker sdf", "give one of the two"),
    "both budgets": (f"{ROOM} --tracker sdf --steps 2 --rate 2", "give one of the two"),
    "budget": ("tables --budget tick", "unknown 'tick'"),
    "command": ("trak living_room", "did you mean 'track'"),
    "action": ("data chekc room", "did you mean 'check'"),
    "option": (f"{ROOM} --tracker sdf --stpes 2", "did you mean '--steps'"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments(case: str, capsys: pytest.CaptureFixture, runs: Path) -> None:
    """Catches usage dumps, tracebacks and guesses; the nearest valid name is offered."""
    arguments, message = WRONG[case]
    assert message in failure(capsys, *arguments.split())
    assert not runs.exists()


def test_frames_that_select_nothing(folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches an empty run that looks like a success."""
    assert "select 0 of" in failure(capsys, *track(folder, "--map-frames", "10:20"))


def test_track_writes_what_it_promises(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches missing files and keys, and an error that the trajectories do not bear out."""
    out = tmp_path / "result"
    assert main(track("living_room", "--out", str(out), "--seed", "3")) == 0
    assert "ate rmse" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    promised = (
        "ate_rmse_m", "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "frames",
        "lost_frames", "steps_per_frame", "seconds_per_step", "seconds_per_frame", "map_seconds",
        "device", "field", "tracker", "seed", "config", "command",
    )  # fmt: skip
    assert set(promised) <= set(metrics)
    assert (metrics["frames"], metrics["steps_per_frame"], metrics["seed"]) == (5, 2.0, 3)
    times, estimated = read_tum(out / "trajectory.txt")
    _, true = read_tum(out / "groundtruth.txt")
    assert times.tolist() == pytest.approx([n / 30 for n in range(1, 6)])
    error = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(metrics["ate_rmse_m"])
    rows = (out / "frames.csv").read_text().splitlines()
    assert rows[0].startswith("frame_id,steps,seconds,loss,translation_error_m")
    assert len(rows) == 7


def test_a_second_run_finds_the_map(capsys: pytest.CaptureFixture, runs: Path) -> None:
    """Catches maps that are made again although nothing changed, or not although it did, and a map
    whose quality or folder is not told."""
    assert main(["map", "living_room", "--field", "neus", *TINY]) == 0
    printed = capsys.readouterr().out
    assert all(text in printed for text in (str(runs), "sdf near", "mesh"))
    said = []
    for more in ([], ["--set", "mapping.neus.n_rays=17"]):
        assert main(track("living_room", *more)) == 0
        said.append(capsys.readouterr().out.splitlines()[0].partition(" in ")[0])
    assert said == ["map found", "no finished map"]


def test_data_make_and_check(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches a made room that its own check would not accept."""
    out = tmp_path / "room"
    make = ["data", "make", "office", "--out", str(out), "--n-frames", "4", "--width", "48"]
    assert main(make) == 0
    assert main(["data", "check", str(out)]) == 0
    assert "4 frames" in capsys.readouterr().out
    assert "exists" in failure(capsys, *make)


def test_tracking_command_reads_any_format(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Catches a --format that the command line drops on its way to map and track."""
    folder = write_recording("tum", tmp_path / "r")
    assert main(track(folder, "--format", "tum")) == 0
    capsys.readouterr()
    assert "no file " in failure(capsys, *track(folder, "--format", "plain"))
