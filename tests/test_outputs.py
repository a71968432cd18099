"""Where commands write, what they take for what, and when a cached result still holds: nothing of
a user's is overwritten, mixed or confused."""

import json
import os
import shlex
import shutil
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
import trimesh
from finished import GIVEN, MAP, OWN, SET
from PIL.PngImagePlugin import PngImageFile
from recordings import N_FRAMES, write_recording
from test_faults import assert_refused, contents
from tiny import tiny_words

from nbtrack import load_preset
from nbtrack.cli import main
from nbtrack.experiments.runs import read_trajectory, scores_of
from nbtrack.experiments.scenes import Scene, open_scene
from nbtrack.machinery import files
from nbtrack.machinery.errors import DataError
from nbtrack.recordings.pose_files import read_tum
from nbtrack.recordings.reading import read_frames, read_sequence
from nbtrack.recordings.recording import open_recording

PROJECT = Path(__file__).parents[1]
# How often each file was opened in this process, whatever module opened it.
_opened: Counter[str] = Counter()
sys.addaudithook(lambda event, about: event == "open" and _opened.update([str(about[0])]))


def test_track_reads_a_file_once(tmp_path: Path, monkeypatch) -> None:
    """Catches a check, an estimate of the unit, a digest, a map, a run or a picture that opens or
    decodes for itself what another part of the command has read."""
    folder = write_recording("neural_rgbd", tmp_path / "room")
    decoded, end = [], PngImageFile.load_end
    monkeypatch.setattr(PngImageFile, "load_end", lambda i: decoded.append(i.mode) or end(i))
    _opened.clear()
    words = ["--method", "sdf", "--steps", "2", "--out", str(tmp_path / "run")]
    assert main(["track", str(folder), *words, *tiny_words()]) == 0
    files = [str(file) for file in folder.glob("*/*.png")]
    assert {_opened[file] for file in files} == {1}
    assert len(decoded) == len(files) == 2 * decoded.count("I;16")


def test_a_recording_is_never_written_to(work: Path, capsys, monkeypatch) -> None:
    """Catches `track REC --out REC`, which replaced the recording's own poses by the estimate."""
    write_recording("tum", work / "rec")
    commands = [
        ["track", "rec", *OWN[2:], "--out", "rec"],
        ["map", "rec", *MAP[2:], "--out", "rec/images"],  # a picture there ends the next reading
        ["export", "run", "--to", "kitti", "rec/poses/new/poses.txt"],
        ["data", "check", "rec", "--out", "rec"],
        ["data", "convert", "rec", "rec/color/again"],
        ["data", "make", "office", "--out", "rec/office"],
        ["tables", *SET, "--out", "rec"],
        ["bench", *SET, "--out", "rec"],
    ]
    for command in commands:
        assert_refused(work, capsys, command, "rec holds a recording, where nothing is written")
    monkeypatch.setenv("NBTRACK_RUNS", str(work / "rec" / "runs"))
    for command in (["track", "rec", *OWN[2:]], ["map", "office", *MAP[2:]]):
        assert_refused(work, capsys, command, "rec holds a recording, where nothing is written")


def test_files_of_others_stay(work: Path, capsys) -> None:
    """Catches an --out that overwrites what nbtrack did not write; other files beside are fine."""
    (work / "mine").mkdir()
    (work / "mine/trajectory.txt").write_text("0 1 2 3 0 0 0 1\n")
    says = "mine has a trajectory.txt that may not be nbtrack's"
    assert_refused(work, capsys, [*OWN, "--out", "mine"], says)
    export = ["export", "run", "--to", "kitti", "mine/trajectory.txt"]
    assert_refused(work, capsys, export, "exists")
    (work / "mine/trajectory.txt").rename(work / "mine/notes.txt")
    for _ in range(2):  # what it wrote itself, it replaces
        assert main([*OWN, "--out", "mine"]) == 0
    assert (work / "mine/notes.txt").read_text() == "0 1 2 3 0 0 0 1\n"
    (work / "paper").mkdir()
    for name in ("table_1.tex", "table_3_cells.csv"):
        (work / "paper" / name).write_text("mine\n")
        says = f"paper has a {name} that may not be nbtrack's"
        assert_refused(work, capsys, ["tables", "--out", "paper"], says)
        (work / "paper" / name).unlink()


def test_places_are_told_before_the_work(work: Path, capsys) -> None:
    """Catches hours of mapping that end at a place where nothing can be written."""
    with mock.patch("nbtrack.experiments.commands.run_jobs") as run_jobs:
        for place in ("room", "room/run", "/proc/nbtrack"):
            new = ["--set", "mapping.neus.n_rays=31"]
            assert_refused(work, capsys, [*OWN, *new, "--out", place], place.split("/")[-1])
        run_jobs.assert_not_called()


def test_a_flipped_bit_in_a_checkpoint_is_noticed(tmp_path: Path) -> None:
    """Catches a run that goes on from a damaged checkpoint to another trajectory."""
    file, state = files.Checkpoint(tmp_path / "map" / "mapping.pt", {"rows": [1, 2]}), {}
    file.save(lambda: {"weights": torch.arange(1000.0)}, is_last=True)
    file.resume(state.update)
    assert state["recipe"] == {"rows": [1, 2]}
    content = bytearray(file.path.read_bytes())
    content[len(content) // 2] ^= 1
    file.path.write_bytes(content)
    with pytest.raises(DataError, match="not a readable"):
        file.resume(state.update)


def test_tables_do_not_touch_the_evidence(tmp_path: Path, capsys) -> None:
    """Catches a command that writes into `paper_tables`, which holds committed evidence."""
    before = contents(PROJECT / "paper_tables")
    words = tiny_words("scenes.names=['office']", "scenes.track_frames=:2")
    assert main(["tables", "--workers", "1", "--preset", "nine_rooms", *words]) == 0
    assert contents(PROJECT / "paper_tables") == before
    written = tmp_path / "runs/tables/nine_rooms"
    assert {path.name for path in written.iterdir()} >= {"table_1.csv", "table_1.tex"}


def test_a_folder_comes_before_a_room_of_its_name(work: Path, capsys) -> None:
    """Catches an own recording `office/` in whose place the synthetic room is tracked, an own
    `kitchen/` that is to be downloaded, and results in `office/` that are taken for a recording."""
    preset = load_preset(settings=["scenes.n_frames=2", "scenes.width=32"])
    for name in ("office", "kitchen"):
        write_recording("plain", work / name)
        assert open_scene(name, preset).folder == work / name
        said = capsys.readouterr().err
        assert said.startswith(f"{name}: the folder {work / name} is read, not the room or scene")
    assert main(["track", "office", *OWN[2:]]) == 0
    command = shlex.split(json.loads((work / "run/metrics.json").read_text())["command"])
    assert command[4] == str(work / "office")
    shutil.rmtree(work / "office")
    shutil.copytree(work / "run", work / "office")
    assert open_scene("office", preset).made


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_an_image_mended_in_place_counts(tmp_path: Path, kind: str) -> None:
    """Catches a map made of images that are no longer there: same name, size and time of change,
    another pixel, as `rsync -t` leaves it; and a recording that is another one after a copy."""
    write_recording("plain", tmp_path / "rec")
    image = sorted((tmp_path / "rec" / kind).iterdir())[0]
    pixels, uncompressed = cv2.imread(str(image), cv2.IMREAD_UNCHANGED), [16, 0]
    cv2.imwrite(str(image), pixels, uncompressed)
    before, status = Scene("rec", tmp_path / "rec").fingerprint, image.stat()
    pixels[3, 4] += 1
    cv2.imwrite(str(image), pixels, uncompressed)
    os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert image.stat().st_size == status.st_size
    assert Scene("rec", tmp_path / "rec").fingerprint != before
    pixels[3, 4] -= 1
    cv2.imwrite(str(image), pixels, uncompressed)
    shutil.copytree(tmp_path / "rec", tmp_path / "copy")
    assert Scene("rec", tmp_path / "copy").fingerprint == before


def test_flagged_and_wrong_frames_are_told_apart(work: Path, capsys) -> None:
    """Catches "lost frames" that mean errors in one place and the tracker's verdict in another, and
    verdicts that do not count where no true pose is known."""
    small = ["--set", "tracking.lm.n_pixels=64", "--set", "tracking.lm.n_restarts=0"]
    assert main([*GIVEN, "map", "--tracker", "lm", *small, "--out", "by_lm"]) == 0
    printed = capsys.readouterr().out
    metrics = json.loads((work / "by_lm/metrics.json").read_text())
    assert metrics["flagged_frames"] == pd.read_csv(work / "by_lm/frames.csv")["lost"].sum()
    run = read_trajectory(work / "by_lm")
    rows = run.frames.assign(lost=True, translation_error_m=np.nan)
    without_truth = replace(run, frames=rows, T_true=np.full_like(run.T_true, np.nan))
    assert scores_of(without_truth)["flagged_frames"] == len(rows)
    for name, says in (("lost", "of the frames, off by"), ("flagged", "of the frames lost, as")):
        assert f"{metrics[f'{name}_frames'] / metrics['frames']:.1%} {says}" in printed
    assert main([*GIVEN, "map"]) == 0
    assert "tracker itself" not in capsys.readouterr().out


def test_far_from_the_origin(tmp_path: Path, capsys) -> None:
    """Catches positions in map coordinates that single precision rounds to half a metre, and one
    pose that is far from all others."""
    utm, found = np.array([4.5e5, 5.4e6, 100.0]), {}
    for name, offset in (("near", 0 * utm), ("far", utm)):
        folder = write_recording("plain", tmp_path / name / "rec")
        rows = np.loadtxt(folder / "trajectory.txt")
        rows[:, 1:4] += offset
        np.savetxt(folder / "trajectory.txt", rows, fmt="%.17g")
        made, run = str(tmp_path / name / "map"), str(tmp_path / name / "run")
        assert main(["map", str(folder), "--field", "points", *SET, "--out", made]) == 0
        assert main(["track", str(folder), "--map-from", made, "--out", run]) == 0
        found[name] = read_tum(tmp_path / name / "run/trajectory.txt")[1][:, :3, 3]
    assert np.abs(found["far"] - found["near"] - utm).max() < 1e-4
    # What leaves the package is in the recording's world; recordings of one place share an origin.
    room = "nbtrack.experiments.exports"
    with mock.patch.multiple(room, movie_bytes=lambda _: b"", movie_pictures=mock.DEFAULT) as drawn:
        assert main(["export", run, "--to", "gif", str(tmp_path / "far.gif")]) == 0
    surface, seen, _, poses, *_ = drawn["movie_pictures"].call_args.args
    for places in (surface.bounds, seen.T_world_camera[:, :3, 3], poses[:, :3, 3]):
        assert np.abs(places - utm).max() < 20
    assert np.abs(trimesh.load(tmp_path / "far/map/mesh.ply").bounds - utm).max() < 20
    origin = open_recording(folder).origin.tolist()
    start = read_sequence(folder, origin=utm.tolist()).T_world_camera[0, :3, 3]
    np.testing.assert_allclose(start, rows[0, 1:4] - utm, atol=1e-8)
    rows[:, 1:4] += [30.0, -40.0, 2.0]  # another end of the building
    np.savetxt(folder / "trajectory.txt", rows, fmt="%.17g")
    assert open_recording(folder).origin.tolist() == origin == [450_000.0, 5_400_000.0, 0.0]
    rows[2, 1] = 1e6 + 5e5
    np.savetxt(folder / "trajectory.txt", rows, fmt="%.17g")
    command = ["map", str(folder), "--field", "points", *SET]
    assert_refused(tmp_path, capsys, command, "frame 2 is no rigid transform")


def test_a_link_in_the_way_is_not_followed(tmp_path: Path) -> None:
    """Catches a file of the user's that is overwritten through a link with a name to be guessed."""
    (tmp_path / "victim").write_text("precious")
    for name in (f".result.txt.{os.getpid()}.tmp", "result.txt"):
        (tmp_path / name).symlink_to(tmp_path / "victim")
    files.write_atomic(tmp_path / "result.txt", "new")
    assert (tmp_path / "victim").read_text() == "precious"
    assert (tmp_path / "result.txt").read_text() == "new"
    assert not (tmp_path / "result.txt").is_symlink()


@pytest.mark.parametrize("format", ["neural_rgbd", "tum"])  # depth in mm, and in another unit
def test_shared_frames_are_those_read_anew(format: str, tmp_path: Path) -> None:
    """Catches frames that change places where others were read before, and copies of what a slice
    could view: twice the memory."""
    recording = open_recording(write_recording(format, tmp_path / "room"))
    whole = read_frames(open_recording(recording.folder), np.arange(N_FRAMES))
    for ids in ([4], [1, 2], [0, 2, 4], [0, 3, 4], [*range(N_FRAMES)], [5, 1]):
        some = read_frames(recording, np.array(ids), needs_poses=False)
        assert (some.colors == whole.colors[ids]).all()
        assert (some.depths_mm == whole.depths_mm[ids]).all()
    whole, part = (read_frames(recording, slice(first, None, 2)) for first in (1, 3))
    assert np.shares_memory(whole.colors, part.colors)
