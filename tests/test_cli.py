"""The command line: what commands print and write. What they refuse: `test_faults.py`.

And what is printed while they run and no bar is shown: a line every 30 seconds.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
from finished import OWN
from recordings import write_recording
from scipy.spatial.transform import Rotation
from test_faults import assert_refused
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.files import naming_damaged
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.pose_files import read_tum
from nbtrack.recordings.recording import open_recording

TINY = tiny_words("scenes.n_frames=6", "tracking.sdf.n_pixels=32")


def track(path: Path | str, *more: str) -> list[str]:
    """A tracking command for a folder."""
    words = ["track", str(path), "--field", "neus", "--tracker", "sdf", "--steps", "2"]
    return [*words, *TINY, *more]


def test_track_writes_what_it_promises(work: Path, capsys) -> None:
    """Catches missing files and keys, and an error that the trajectories do not bear out."""
    assert main(OWN) == 0
    out, printed = work / "run", capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert f"error  {1000 * metrics['ate_rmse_m']:.1f} mm (ATE)" in printed
    promised = (
        "ate_rmse_m", "ate_rmse_aligned_m", "rotation_rmse_deg", "max_error_m", "frames",
        "lost_frames", "steps_per_frame", "seconds_per_step", "seconds_per_frame", "map_seconds",
        "device", "field", "tracker", "seed", "config", "command",
    )  # fmt: skip
    assert set(promised) <= set(metrics)
    assert (metrics["frames"], metrics["steps_per_frame"], metrics["seed"]) == (5, 2.0, 0)
    times, estimated = read_tum(out / "trajectory.txt")
    _, true = read_tum(out / "groundtruth.txt")
    assert times.tolist() == pytest.approx([n / 30 for n in range(1, 6)])
    error = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.sqrt((error**2).mean()) == pytest.approx(metrics["ate_rmse_m"])
    rows = (out / "frames.csv").read_text().splitlines()
    assert rows[0].startswith("frame_id,time,steps,seconds,loss,translation_error_m")
    assert len(rows) == 6


def test_a_traceback_for_who_asks(tmp_path: Path, capsys, monkeypatch) -> None:
    """Catches a mistake of the program that looks like one of a file, and tracebacks unasked."""
    wrong = ["data", "check", str(tmp_path / "nothing")]
    assert main(wrong) == 2
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setenv("NBTRACK_DEBUG", "1")
    assert main(wrong) == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert said.splitlines()[-1].startswith("nbtrack: no folder")
    with pytest.raises(AttributeError), naming_damaged(tmp_path):  # no file is to blame for it
        tmp_path.no_such_method()


def test_a_map_is_taken_with_the_settings_that_made_it(tmp_path: Path, capsys, monkeypatch) -> None:
    """Catches a refusal of the very settings that a map was made with, because a method set others
    beside them; settings that the map does not have, which no run could follow, however they are
    given; and a corrected map that asks for the plain one it was made from."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 2000)
    folder, out = write_recording("plain", tmp_path / "r"), str(tmp_path / "m")
    made = ["map", str(folder), "--field", "neus", *TINY, "--set", "correction.neus=0.3"]
    assert main([*made, "--out", out]) == 0
    assert MapJob.of_given(Path(out)).needs is None
    given = ["track", str(folder), "--map-from", out, "--tracker", "lm", "--steps", "2", *TINY]
    assert main([*given, "--out", str(tmp_path / "run")]) == 0
    says = ", not 77 as asked"
    assert_refused(tmp_path, capsys, [*given, "--set", "mapping.neus.n_rays=77"], says)
    assert main([*given, "--set", "mapping.imap.n_rays=77", "--out", str(tmp_path / "run")]) == 0
    (tmp_path / "own.toml").write_text("mapping.neus.lambda_depth = 77")
    assert_refused(tmp_path, capsys, [*given, "--config", str(tmp_path / "own.toml")], ", not 77")


def test_times_are_the_recordings_own(tmp_path: Path, capsys) -> None:
    """Catches frame numbers in place of times, which evaluation tools cannot associate with the
    recording's own reference; also after a conversion, and with a declared frame rate; and a
    --format that the command line drops on its way to map and track."""
    folder, out = write_recording("tum", tmp_path / "r"), tmp_path / "result"
    times = open_recording(folder).times
    assert_refused(tmp_path, capsys, track(folder, "--format", "plain"), "no colour images ")
    assert main(track(folder, "--out", str(out), "--format", "tum")) == 0
    found, _ = read_tum(out / "trajectory.txt")
    assert found.tolist() == times[1:].tolist()
    assert found[0] > 1.3e9
    assert main(["data", "convert", str(folder), str(tmp_path / "c"), "--frames", "::2"]) == 0
    assert open_recording(tmp_path / "c").times.tolist() == times[::2].tolist()
    (tmp_path / "c/timestamps.txt").write_text("1\n2\n")
    with pytest.raises(DataError, match="has 2 times for 3 images"):
        open_recording(tmp_path / "c")
    (tmp_path / "c/timestamps.txt").unlink()
    (tmp_path / "c/sequence.toml").write_text("frame_rate = 5\n")
    assert open_recording(tmp_path / "c").times == pytest.approx([0, 0.2, 0.4])


def test_a_recording_without_poses_is_tracked_in_a_map(work: Path, capsys, monkeypatch) -> None:
    """Catches `no poses in ...` where a map of the room is given: the camera is found first, every
    frame is tracked, and nothing is said of errors; a picture that is not there; and a reference of
    an earlier run that stays beside a trajectory without one."""
    monkeypatch.setattr("nbtrack.beyond.correction._N_POINTS", 20_000)
    recording = work / "rec"
    made = ["data", "make", "office", "--out", str(recording), "--n-frames", "8", "--width", "64"]
    assert main(made) == 0
    small = "network.neus.width=32", "mapping.neus.n_rays=48", "mapping.neus.iterations=200"
    words = [word for text in (*small, "correction.neus=0.15") for word in ("--set", text)]
    assert main(["map", str(recording), "--field", "neus", *words, "--out", "corrected"]) == 0
    capsys.readouterr()
    assert main(["track", str(recording), "--map-from", "corrected", "--out", "known"]) == 0
    assert "stands still" in capsys.readouterr().out
    # A session whose world is its own: refused at its pose, and right where it is found.
    poses = np.loadtxt(recording / "poses.txt").reshape(-1, 4, 4)
    own = Rotation.from_euler("y", 2).as_matrix() @ poses[:, :3] + [[0, 0, 0, 1.5]] * 3
    np.savetxt(recording / "poses.txt", np.insert(own, 3, [0, 0, 0, 1], axis=1).reshape(-1, 4))
    elsewhere = ["track", str(recording), "--map-from", "corrected", "--out", "elsewhere"]
    assert main(elsewhere) == 2
    assert "--start unknown" in capsys.readouterr().err
    assert main([*elsewhere, "--start", "unknown"]) == 0
    assert "in another world than the map" in capsys.readouterr().err
    assert json.loads((work / "elsewhere/metrics.json").read_text())["median_error_m"] < 0.05
    assert (work / "elsewhere/groundtruth.txt").is_file()
    known = np.loadtxt(recording / "poses.txt")
    np.savetxt(recording / "poses.txt", np.where(np.arange(len(known))[:, None] < 4, np.nan, known))
    assert main(elsewhere) == 0  # the first pose is not known
    assert "in another world than the map" in capsys.readouterr().err
    for name in ("poses.txt", "trainval_poses.txt"):
        (recording / name).unlink()
    assert main(elsewhere) == 0
    assert "errors cannot be computed" in capsys.readouterr().out
    metrics = json.loads((work / "elsewhere/metrics.json").read_text())
    assert (metrics["start"], metrics["frames"]) == ("unknown", 8)
    assert not (work / "elsewhere/groundtruth.txt").exists()
    runs = work / "known", work / "elsewhere"
    known, found = (read_tum(run / "trajectory.txt")[1] for run in runs)
    off = np.linalg.norm(found[1:, :3, 3] - known[:, :3, 3], axis=1)
    flagged = pd.read_csv(work / "elsewhere/frames.csv")["lost"].to_numpy()[1:]
    assert (flagged | (off < 0.05)).all()
    for run in runs:
        assert cv2.imread(str(run / "overview.png")).shape[1] > 800
    assert main(["export", "elsewhere", "--to", "gif", "found.gif"]) == 0
    assert "8 of 8 frames" in capsys.readouterr().out
    shutil.rmtree(work / "corrected")
    shutil.copytree(work / "map", work / "corrected")
    again = ["export", "elsewhere", "--to", "gif", "again.gif"]
    assert_refused(work, capsys, again, "is not the map of this run any more")


def test_a_pipe_that_nobody_reads() -> None:
    """Catches a traceback, or a message about the output, where its reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "nbtrack", "methods"]
    found = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (found.returncode, found.stderr) == (1, "")


def test_a_line_now_and_then(capsys, monkeypatch) -> None:
    """Catches output that is silent until the end, or never, and an ETA that is not from the mean
    speed: 2 of 8 parts in 31 seconds leave 93; and hours that are left for half an hour, because
    the first frame was compiled."""
    clock = SimpleNamespace(now=0.0)  # s, moved by hand
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now)
    with ProgressBar("mapping", 8) as bar:
        for clock.now, done in ((31, 2), (40, 3), (90, 8)):
            bar.move_to(done, "loss 0.5")
    first, *others = capsys.readouterr().err.splitlines()
    assert first == "mapping: 25 %, 00:31 gone, 01:33 left, loss 0.5"
    assert {*others} == {"mapping: 100 %, 01:30 gone, 00:00 left, loss 0.5"}
    with ProgressBar("tracking", 60) as bar:
        for frame in range(50):
            clock.now += 31 if frame else 600
            bar.move_to(frame + 1)
    *_, last, _ = capsys.readouterr().err.splitlines()
    assert "05:10 left" in last  # 10 times 31 s


def test_ctrl_c_ends_an_import_at_once(monkeypatch) -> None:
    """Catches a library that goes on with its import, or raises another error, after Ctrl-C."""
    seen, before = [], signal.getsignal(signal.SIGINT)

    def load(name: str) -> SimpleNamespace:
        seen.append(signal.getsignal(signal.SIGINT))
        return SimpleNamespace(methods_command=lambda options: 0)

    monkeypatch.setattr("importlib.import_module", load)
    assert main(["methods"]) == 0
    assert seen == [signal.SIG_DFL]
    assert signal.getsignal(signal.SIGINT) == before
