"""Maps as one file, what else results are exported to, and tracking in a map made earlier."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_lm import furnished

from nbtrack.cli import main
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.core.config import FieldConfig
from nbtrack.core.errors import DataError
from nbtrack.fields import make_field
from nbtrack.mapping.files import StoredMap, read_map, write_map
from nbtrack.mapping.fits import MapFit, warn_of_misfit
from nbtrack.mapping.seen_volume import SEEN_VOXEL, SeenVolume, seen_volume
from nbtrack.tracking.trajectories import read_tum

SETTINGS = (
    "scenes.n_frames=8", "scenes.width=32", "network.neus.width=24", "mapping.neus.iterations=60",
    "mapping.neus.n_rays=64", "mapping.neus.holdout_every=0", "mapping.neus.learning_rate=3e-3",
    "tracking.lm.n_pixels=64",
)  # fmt: skip
TRACK = ("--tracker", "lm", "--steps", "4", "--frames", "2:6")


def with_settings(*words: str) -> list[str]:
    return [*words, *(word for setting in SETTINGS for word in ("--set", setting))]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small map (`map`), the same as one file (`map.pt`), and a run (`run`)."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        for name in ("NBTRACK_PRESET", "NBTRACK_CONFIG", "NBTRACK_SET", "NBTRACK_DATA"):
            patch.delenv(name, raising=False)
        patch.setenv("NBTRACK_RUNS", str(folder / "runs"))
        assert (
            main(
                with_settings("map", "living_room", "--field", "neus", "--out", str(folder / "map"))
            )
            == 0
        )
        assert main(["export", str(folder / "map"), "--to", "map", str(folder / "map.pt")]) == 0
        assert (
            main(
                with_settings(
                    "track",
                    "living_room",
                    "--map-from",
                    str(folder / "map"),
                    *TRACK,
                    "--out",
                    str(folder / "run"),
                )
            )
            == 0
        )
    return folder


@pytest.fixture(autouse=True)
def same_runs(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The room that the map was made of is found, not made again."""
    monkeypatch.setenv("NBTRACK_RUNS", str(made / "runs"))


def test_a_file_in_a_fresh_process_gives_the_same_trajectory(made: Path, tmp_path: Path) -> None:
    """Catches weights that lose a bit on the way, and a file that needs what is not in it."""
    command = [sys.executable, "-m", *with_settings(
        "nbtrack", "track", "living_room", "--map-from", str(made / "map.pt"), *TRACK,
        "--out", str(tmp_path / "run"),
    )]  # fmt: skip
    environment = {**os.environ, "NBTRACK_RUNS": str(tmp_path / "runs")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    for name in ("trajectory.txt", "groundtruth.txt"):
        assert (tmp_path / "run" / name).read_bytes() == (made / "run" / name).read_bytes()
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["map_from"]["scene"], metrics["field"]) == ("living_room", "neus")
    assert metrics["config"]["preset"]["network"]["neus"]["width"] == 24


def test_a_file_is_small_and_tells_where_it_comes_from(made: Path, tmp_path: Path) -> None:
    """Catches optimiser states in the file, lost provenance, and files that are not equal."""
    stored = read_map(made / "map.pt")
    assert stored.made["scene"] == "living_room"
    assert stored.made["seconds"] > 0
    assert {"torch", "nbtrack"} <= set(stored.made["versions"])
    assert (stored.camera.width, stored.network.width) == (32, 24)
    assert stored.key == read_map(made / "map").key
    write_map(tmp_path / "again.pt", stored)
    assert (tmp_path / "again.pt").read_bytes() == (made / "map.pt").read_bytes()
    full = FieldConfig()
    bounds = SceneBounds((-3.0, -3.0, -1.5), (3.0, 3.0, 1.5))
    field = make_field("neus", full, bounds, seed=0)
    write_map(tmp_path / "full.pt", replace(stored, field=field, network=full))
    assert (tmp_path / "full.pt").stat().st_size < 1.1e6


def test_trajectories(made: Path, tmp_path: Path) -> None:
    """Catches another order of numbers, lost digits, and inverted poses."""
    for name in ("tum", "kitti"):
        assert main(["export", str(made / "run"), "--to", name, str(tmp_path / name)]) == 0
    assert (tmp_path / "tum").read_bytes() == (made / "run" / "trajectory.txt").read_bytes()
    rows = np.loadtxt(tmp_path / "kitti")
    assert rows.shape == (3, 12)
    np.testing.assert_allclose(
        rows.reshape(-1, 3, 4), read_tum(made / "run" / "trajectory.txt")[1][:, :3], atol=1e-15
    )


@pytest.mark.parametrize("source", ["map", "map.pt"])
@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_meshes_keep_their_colours(made: Path, tmp_path: Path, source: str, kind: str) -> None:
    """Catches meshes that come out grey, empty, or on another side of the world."""
    out = tmp_path / f"mesh.{kind}"
    assert main(["export", str(made / source), "--to", kind, str(out)]) == 0
    mesh = trimesh.load_mesh(out, process=False)
    mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
    assert len(mesh.faces) > 10
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
    assert colors.std(axis=0).max() > 1
    bounds = read_map(made / "map.pt").field.bounds
    assert (mesh.bounds[0] > np.array(bounds.minimum) - 0.1).all()
    assert (mesh.bounds[1] < np.array(bounds.maximum) + 0.1).all()


def test_a_field_may_be_named_and_must_then_be_the_maps(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Catches a name that is ignored, and `--field` where the map says it all."""
    track = with_settings("track", "living_room", "--map-from", str(made / "map"), *TRACK)
    assert main([*track, "--field", "neus", "--out", str(tmp_path / "run")]) == 0
    assert main([*track, "--field", "imap"]) == 2
    assert "is a map of field 'neus', not 'imap'" in capsys.readouterr().err


def test_a_map_of_another_scene_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Catches tracking in a room that the camera is not in; earlier results stay."""
    before = (made / "run" / "metrics.json").read_bytes()
    # The map itself is poor: what is usual in it is said to be what a good map shows.
    content = torch.load(made / "map.pt", weights_only=True)
    content["usual_fit"] = MapFit(0.98, 0.97, 0.01).to_dict()
    torch.save(content, tmp_path / "good.pt")
    assert (
        main(
            with_settings(
                "track",
                "long_hall",
                "--map-from",
                str(tmp_path / "good.pt"),
                *TRACK,
                "--out",
                str(made / "run"),
            )
        )
        == 2
    )
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("nbtrack: at its given pose frame 2 of long_hall is off the map of")
    assert "usual in this map: median 0.010 m, 97 % within 10 cm; it is a map of" in error
    assert (made / "run" / "metrics.json").read_bytes() == before


def test_the_verdict_on_a_map() -> None:
    """Catches a refusal of the room's own map, or of one whose room has changed a little."""
    usual = MapFit(0.95, 0.9, 0.01)
    name = ("the map", "frame 0")
    assert warn_of_misfit(MapFit(0.9, 0.85, 0.02), usual, *name) is None
    assert "may have changed" in warn_of_misfit(MapFit(0.2, 0.6, 0.05), usual, *name)
    assert "cannot be told" in warn_of_misfit(None, usual, *name)
    assert "too poor" in warn_of_misfit(MapFit(0.0, 0.0, 9.0), MapFit(0.1, 0.9, 0.01), *name)
    with pytest.raises(DataError, match="another scene"):
        warn_of_misfit(MapFit(0.9, 0.4, 0.3), usual, *name)
    with pytest.raises(DataError, match="nothing in view that the map has seen"):
        warn_of_misfit(MapFit(0.0, 0.0, float("inf")), usual, *name)


def test_what_was_seen() -> None:
    """Catches cells that lie elsewhere than the points, and a grid that text does not restore."""
    field, sequence = furnished()
    low, high = np.array(field.bounds.minimum) - 0.1, np.array(field.bounds.maximum) + 0.1
    bounds = SceneBounds(tuple(low.tolist()), tuple(high.tolist()))
    seen = seen_volume(sequence, np.array([0, 2]), bounds)
    again = SeenVolume.from_dict(json.loads(json.dumps(seen.to_dict())))
    assert torch.equal(again.cells, seen.cells)
    assert 10 < int(seen.cells.sum()) < seen.cells.numel() / 4
    depth = sequence.depth(0)[24, 32]
    T = sequence.T_world_camera[0]
    x, y = 0.5 / sequence.intrinsics.fx * depth, 0.5 / sequence.intrinsics.fy * depth
    point = T[:3, :3] @ np.array([x, y, depth]) + T[:3, 3]
    points = torch.tensor(np.stack([point, T[:3, 3], point + 100]), dtype=torch.float32)
    assert seen.contains(points).tolist() == [True, False, False]
    assert pytest.approx(0.2) == SEEN_VOXEL


def test_stored_maps_open_whatever_the_field(tmp_path: Path) -> None:
    """Catches a field whose state the file does not hold: points have no fixed number."""
    bounds = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    made = dict.fromkeys(("scene", "frames", "seed", "key", "device", "versions"), "x")
    seen = SeenVolume(bounds.minimum, torch.ones(11, 11, 11, dtype=torch.bool))
    for name in ("imap", "neus", "neus_plus", "points"):
        field = make_field(name, FieldConfig(width=8), bounds, seed=1)
        if name == "points":
            field.points, field.colors = torch.rand(7, 3), torch.rand(7, 3)
        stored = StoredMap(
            field, FieldConfig(width=8), Intrinsics.from_focal(4, 3, 3.0),
            {**made, "seconds": 1.0}, None, seen,
        )  # fmt: skip
        write_map(tmp_path / name, stored)
        assert read_map(tmp_path / name).key == stored.key


def test_the_readmes_example(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Catches a README that shows what no longer runs."""
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    assert len(example.strip().splitlines()) <= 11
    monkeypatch.chdir(tmp_path)
    shutil.copy(made / "map.pt", "room.pt")
    (room,) = (made / "runs" / "rooms").glob("*/living_room")
    shutil.copytree(room, "recording")
    exec(compile(example, "README.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == 7
