"""A run as a recording for the Rerun viewer."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_faults import assert_refused

from nbtrack.cli import main
from nbtrack.experiments.runs import read_trajectory
from nbtrack.plots.movie import rerun_bytes
from nbtrack.recordings.reading import read_sequence


def rows_of(file: Path) -> Counter[tuple[str, bool]]:
    """How many rows a file holds, by what they are of, and whether they hold at all times."""
    from rerun.chunk import RrdReader

    rows = Counter()
    for part in RrdReader(str(file)).stream():
        rows[part.entity_path, part.is_static] += part.num_rows
    return rows


def test_without_rerun(finished: Path, monkeypatch, capsys) -> None:
    """Catches a traceback of imports, or minutes of meshing before it is told."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setattr("nbtrack.experiments.exports.extract_mesh", None)
    command = ["export", str(finished / "run"), "--to", "rrd", str(finished / "run.rrd")]
    assert_refused(finished, capsys, command, "pip install 'nbtrack[rerun]'")


def test_what_the_file_holds(finished: Path, tmp_path: Path) -> None:
    """Catches frames, images, paths or verdicts that are missing in the viewer."""
    pytest.importorskip("rerun")
    out = tmp_path / "run.rrd"
    assert main(["export", str(finished / "run"), "--to", "rrd", str(out)]) == 0
    n_frames, rows = len(read_trajectory(finished / "run").frames), rows_of(out)
    assert all(rows[f"/world/{name}", True] == 1 for name in ("map", "tracked", "true", "camera"))
    assert rows["/world", True] == 1  # where the origin lies in the recording's world
    for name in ("world/camera", "world/camera/color", "world/camera/depth", "error_m", "lost"):
        assert rows[f"/{name}", False] == n_frames


def test_points_and_a_verdict(finished: Path, tmp_path: Path) -> None:
    """Catches a map of points that has no faces, and frames that were not all shown."""
    pytest.importorskip("rerun")
    tracked = read_trajectory(finished / "run")
    recording = read_sequence(tracked.metrics["recording"])
    points = trimesh.PointCloud(np.eye(3), np.full((3, 4), 255, np.uint8))
    run = replace(tracked, frames=tracked.frames.assign(lost=True))
    content = rerun_bytes(points, recording.select(slice(1, 3)), run, "points")
    (tmp_path / "points.rrd").write_bytes(content)
    rows = rows_of(tmp_path / "points.rrd")
    assert rows["/world/camera/color", False] == 2
    assert rows["/lost", False] == len(run.frames)
    assert rows["/world/map", True] == 1
