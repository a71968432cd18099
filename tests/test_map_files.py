"""Maps as one file, what else they are exported to, and tracking in a map made earlier."""

import json
import os
import pickle
import re
from dataclasses import replace
from functools import cache, reduce
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import safetensors
import torch
import trimesh
from box_room import BoxRoom, box_sequence, narrow_room, poses_at
from finished import GIVEN
from safetensors.torch import save
from test_mapping import NETWORK, finished_wall, map_wall, wall_sequence

from nbtrack.beyond.points import PointMapping
from nbtrack.checks.in_map import check_belongs, outside_map_share
from nbtrack.cli import main
from nbtrack.core.bounds import SceneBounds
from nbtrack.experiments.runs import MARK
from nbtrack.fields import NetworkSettings, make_field
from nbtrack.machinery.errors import ConfigError, DataError
from nbtrack.machinery.files import digest_of
from nbtrack.mapping.files import MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.mapping.holdout import misfit_of
from nbtrack.plots.meshes import mesh_bytes
from nbtrack.recordings.pose_files import read_tum


@cache
def fused_wall() -> Map:
    return map_sequence("points", wall_sequence(), NETWORK, PointMapping(voxel=0.05))


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    """A NeuS map of a wall as a file."""
    write_map(tmp_path / MAP_FILE, finished_wall())
    return tmp_path / MAP_FILE


@pytest.mark.parametrize("name", ["imap", "neus", "neus_plus", "points"])
def test_any_field_comes_back_as_it_was(name: str, tmp_path: Path) -> None:
    """Catches weights that lose a bit, a lost history, and points, which have no fixed number."""
    made = fused_wall() if name == "points" else map_wall(name, None)
    made = replace(made, record={**made.record, "quality": {"psnr_db": 20.5}})
    write_map(tmp_path / MAP_FILE, made)
    stored = read_map(tmp_path)
    for part in ("key", "camera", "record"):
        assert getattr(stored, part) == getattr(made, part)
    assert stored.field.bounds == made.field.bounds
    pd.testing.assert_frame_equal(stored.history, made.history, check_exact=True)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    found, expected = (m.field(points)[1] for m in (stored, made))
    assert torch.equal(found, expected)


def test_a_file_is_small_and_always_the_same(sound: Path, tmp_path: Path) -> None:
    """Catches optimiser states in the file, and files that are not equal."""
    stored = read_map(sound)
    assert stored.history.empty
    write_map(tmp_path / "again" / MAP_FILE, stored)
    assert (tmp_path / "again" / MAP_FILE).read_bytes() == sound.read_bytes()
    full = NetworkSettings()
    field = make_field("neus", full, SceneBounds((-3.0, -3.0, -1.5), (3.0, 3.0, 1.5)), seed=0)
    made = {**stored.record, "network": {"width": 256, "n_frequencies": 93, "embedding_sigma": 2.5}}
    write_map(tmp_path / "full", replace(stored, field=field, record=made))
    assert vars(full) == read_map(tmp_path / "full").record["network"]
    assert (tmp_path / "full").stat().st_size < 1.1e6


GONE, WEIGHT = object(), "mlp.layer_2.weight"
CHANGED = "is not what was written"
# What a file may hold in place of a map: a part of its header or a tensor, and what it is instead.
# Where something else than the digest must tell, the file has one that is right.
MAP_CONTENT = {
    "a weight less": ("mlp.head.bias", GONE, "Missing key"),
    "other shape": (WEIGHT, lambda w: w[:3].contiguous(), "size mismatch"),
    "changed weights": (WEIGHT, lambda w: w + 1e-6, CHANGED),
    "weights of NaN": (WEIGHT, lambda w: w * np.nan, "is not finite"),
    "no digest": ("digest", GONE, CHANGED),
}
for row in pd.read_csv(Path(__file__).parent / "data/map_files.csv", index_col="case").itertuples():
    MAP_CONTENT[row.Index] = (row.place, json.loads(row.value), row.says)


@pytest.mark.parametrize("case", MAP_CONTENT)
def test_map_content(case: str, sound: Path) -> None:
    """Catches trust in a file that comes from anybody."""
    place, value, says = MAP_CONTENT[case]
    with safetensors.safe_open(sound, "pt") as opened:
        header = json.loads(opened.metadata()["nbtrack map"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    *outer, name = place.split("/")
    part = tensors if place in tensors else reduce(dict.get, outer, header)
    if value is GONE:
        del part[name]
    else:
        part[name] = value(part[name]) if callable(value) else value
    if says != CHANGED:
        del header["digest"]
        header["digest"] = digest_of(header, tensors)
    sound.write_bytes(save(tensors, {"nbtrack map": json.dumps(header)}))
    assert_refused(sound, says)


def assert_refused(path: Path, says: str) -> None:
    with pytest.raises((DataError, ConfigError)) as caught:
        read_map(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


class Bomb:
    """Runs a command where it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch exploded",)


MAP_BYTES = {
    "empty": lambda sound: b"",
    "a bit flipped": lambda s: s[:-90] + bytes([s[-90] ^ 1]) + s[-89:],
    "an endless header": lambda sound: b"\xff" * 8 + sound[8:],
    "another's header": lambda sound: save({"a": torch.ones(3)}, {"format": "pt"}),
    "a header that is no JSON": lambda sound: save({}, {"nbtrack map": "{"}),
    "a header that is a list": lambda sound: save({}, {"nbtrack map": "[1, 2]"}),
    "a bomb": lambda sound: pickle.dumps(Bomb()),
}


@pytest.mark.parametrize("case", MAP_BYTES)
def test_map_bytes(case: str, sound: Path, monkeypatch) -> None:
    """Catches code that is run from a file, and damage that gives a traceback."""
    monkeypatch.chdir(sound.parent)
    sound.write_bytes(MAP_BYTES[case](sound.read_bytes()))
    assert_refused(sound, "is not a readable map file")
    assert not Path("exploded").exists()


def moved(metres: float, turned: float = 0.0) -> np.ndarray:
    """A pose shifted along the view, and turned about the vertical by an angle."""
    return poses_at([[0, 0, metres]], [0, turned, 0])[0]


BELONGS = {
    "at home": (0.01, moved(0.0), True),
    "another frame's place": (0.01, moved(0.03), True),
    "a shifted world": (0.01, moved(0.3), False),
    "a turned world": (0.01, moved(0.0, 0.6), False),
    "a map that is no better": (0.2, moved(0.3), True),
    "a map that is little better": (0.08, moved(0.3), False),
}


@pytest.mark.parametrize("case", BELONGS)
@pytest.mark.parametrize("field_name", ["neus", "points"])
def test_whether_a_map_belongs(case: str, field_name: str) -> None:
    """Catches a refusal of the room's own map, and tracking in a room that the camera is not in."""
    usual, T_world_camera, belongs = BELONGS[case]
    wall = fused_wall() if field_name == "points" else finished_wall()
    stored = replace(wall, record={**wall.record, "misfit_m": usual})
    frame = replace(wall_sequence()[2], T_world_camera=T_world_camera)
    if belongs:
        assert check_belongs(stored, frame) is None
    else:
        assert misfit_of(stored.field, frame) > 0.1
        with pytest.raises(DataError, match=r"frame 2 of wall is off the map of wall by 0\.\d+ m"):
            check_belongs(stored, frame)


def test_a_frame_without_depth_tells_nothing() -> None:
    """Catches NaN that passes for a good fit without a word."""
    sequence = wall_sequence()
    sequence.depths_mm[:] = 0
    assert np.isnan(misfit_of(finished_wall().field, sequence[0]))
    assert "frame 0 of wall has no depth" in check_belongs(finished_wall(), sequence[0])


ROOM = BoxRoom(half=(1.5, 1.2, 2.0))


def seen(n_frames: int = 12):
    """From before the middle, turned to all sides a little: most see four or five walls."""
    random = np.random.default_rng(0)
    turns = random.normal(scale=0.2, size=(n_frames, 3))
    poses = poses_at(random.uniform(-0.2, 0.2, (n_frames, 3)) - [0, 0, 0.4], turns)
    return box_sequence(poses, narrow_room(), 24)  # with three walls a motion does the same


def test_frames_outside_of_what_was_mapped() -> None:
    """Catches a camera in a part that no map holds, without a word, and one that counts for a few
    points: the map ends at x = 0, and half of the frames look to where it is not, known by their
    true poses alone; of the others some see a little beyond its height."""
    poses = poses_at(np.zeros((10, 3)), np.outer([1] * 5 + [-1] * 5, [0, np.pi / 2, 0]))
    half = BoxRoom(half=(1.5, 1.2, 2.0))
    half.bounds = SceneBounds((-1.6, -0.6, -2.1), (0.0, 0.6, 2.1))
    astray = np.tile(poses[9], (10, 1, 1))
    assert outside_map_share(half, box_sequence(poses, ROOM, 48), astray) == 0.5
    assert outside_map_share(ROOM, seen(), seen().T_world_camera) == 0


def test_a_file_gives_the_same_trajectory(work: Path, tmp_path: Path, monkeypatch) -> None:
    """Catches weights that lose a bit on the way, a file that needs what is not in it, a folder of
    twice the size, and a map's parts that are not written together; of an exported trajectory
    another order of numbers, lost digits, and inverted poses."""
    monkeypatch.setenv("NBTRACK_RUNS", str(tmp_path / "runs"))
    assert main([*GIVEN, "room", "--out", "again"]) == 0
    for name in ("trajectory.txt", "groundtruth.txt"):
        assert (work / "again" / name).read_bytes() == (work / "run" / name).read_bytes()
    metrics = json.loads((work / "again/metrics.json").read_text())
    assert (metrics["map_record"]["scene"], metrics["field"]) == ("living_room", "neus")
    assert metrics["map_record"]["network"]["width"] == 16
    assert {*os.listdir("map")} == {MAP_FILE, "history.csv", "mesh.ply", MARK}
    assert (work / "room").read_bytes() == (work / "map" / MAP_FILE).read_bytes()
    assert len(read_map("map").history) == 30
    assert main(["export", "run", "--to", "kitti", "kitti"]) == 0
    expected = read_tum(work / "run/trajectory.txt")[1][:, :3]
    np.testing.assert_allclose(np.loadtxt("kitti").reshape(-1, 3, 4), expected, atol=1e-15)


MESHES = [("map", "ply"), ("room", "ply"), ("run", "ply"), ("run", "glb")]


@pytest.mark.parametrize(("source", "kind"), MESHES)
def test_meshes_keep_their_colours(work: Path, source: str, kind: str) -> None:
    """Catches meshes that come out grey, empty, or on another side of the world, and that of a run
    that is refused."""
    assert main(["export", source, "--to", kind, f"mesh.{kind}"]) == 0
    mesh = trimesh.load_mesh(f"mesh.{kind}", process=False)
    assert len(mesh.faces) > 10
    assert np.asarray(mesh.visual.vertex_colors)[:, :3].std(axis=0).max() > 1
    bounds = read_map("room").field.bounds
    assert (mesh.bounds[0] > np.array(bounds.minimum) - 0.1).all()  # y is up in both
    assert (mesh.bounds[1] < np.array(bounds.maximum) + 0.1).all()


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0]])
def test_up_is_up(up: list[int]) -> None:
    """Catches rooms that lie on their side in a viewer of GLB files, or are mirrored there; meshes
    near 0 beside trajectories in map coordinates, decimetres that are lost there; and colours in a
    GLB file, where they are linear, that are too bright."""
    points = np.array([up, [0, 0, 0], [1, 2, 3], [3, -1, 2]], dtype=float)
    mesh = trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3], [1, 3, 2]], process=False)
    mesh.visual.vertex_colors = [10, 128, 255, 255]
    origin, found = np.array([500_000.0, 4_649_000.0, 0.0]), {}
    for kind, colors in (("ply", [10, 128, 255]), ("glb", [1, 55, 255])):
        content = trimesh.util.wrap_as_stream(mesh_bytes(mesh, kind, origin, up))
        read = trimesh.load_mesh(content, file_type=kind, process=False)
        assert (read.faces == mesh.faces).all()
        assert (np.asarray(read.visual.vertex_colors)[:, :3] == colors).all()
        found[kind] = np.asarray(read.vertices)
    np.testing.assert_allclose(found["ply"], points + origin, rtol=0, atol=1e-6)
    turned = found["glb"]
    np.testing.assert_allclose(turned[0] - turned[1], [0, 1, 0], atol=1e-6)
    before, after = (np.linalg.det(p[[0, 2, 3]] - p[1]) for p in (points, turned))
    assert after == pytest.approx(before, rel=1e-5)


def test_the_readmes_example(work: Path, capsys) -> None:
    """Catches a README that shows what no longer runs."""
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    assert len(example.strip().splitlines()) <= 11
    (name,) = re.findall(r'read_map\("(.*?)"\)', example)
    Path("room").rename(name)
    next(Path("runs/rooms").glob("*/living_room")).rename("recording")
    exec(compile(example, "README.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) == 5
