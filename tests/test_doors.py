"""Doors: what a public entry is given is right or refused, and what is the user's stays theirs."""

import copy
import pickle
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import BoxRoom, box_sequence, poses_at, walk
from tiny import TINY

import nbtrack
from nbtrack.beyond import correction
from nbtrack.beyond.grid import BakedField
from nbtrack.beyond.neus_plus import GridNetwork, GridPlusMapping
from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import Intrinsics
from nbtrack.data.frame import Frame
from nbtrack.fields import FIELDS, MappingSettings, NetworkSettings, NeusMapping, make_field
from nbtrack.machinery.device import constant
from nbtrack.machinery.errors import NbtrackError
from nbtrack.machinery.files import absolute
from nbtrack.machinery.settings import read_setting
from nbtrack.mapping.files import MAP_FILE, Map, read_map, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.tracking import ClockBudget, StepBudget, make_budget, paper_steps, track_sequence
from nbtrack.tracking.methods import METHODS, find_methods
from nbtrack.tracking.paper import SdfSettings, SdfTracker

SEQUENCE, CAMERA = walk(4), walk(1).intrinsics
COLOR, DEPTH = SEQUENCE.colors[0], SEQUENCE.depths_mm[0]
NETWORK, UNIT = NetworkSettings(width=16, n_frequencies=8), ((-1.0,) * 3, (1.0,) * 3)
SMALL = {"iterations": 3, "n_rays": 8, "holdout_every": 0}


def mapped(sequence=SEQUENCE, name="neus", settings=None, network=NETWORK, **more) -> Map:
    return map_sequence(name, sequence, network, settings or NeusMapping(**SMALL), **more)


def tracker(field=None, pose=None, name="sdf", budget=3, **options):
    pose = np.eye(4) if pose is None else pose
    settings = SdfSettings(**{"n_pixels": 16} | options) if name == "sdf" else None
    return nbtrack.make_tracker(name, field or BoxRoom(), pose, StepBudget(budget), settings)


def scenes() -> dict:
    preset = nbtrack.load_preset(settings=[*TINY, "scenes.names=['office']"])
    return {"scenes": nbtrack.open_scenes(preset), "methods": ["sdf"], "preset": preset}


def tracked_with(**options):
    return lambda: nbtrack.track_scenes(**scenes() | options)


def poses_with(pose) -> np.ndarray:
    poses = SEQUENCE.T_world_camera.copy()
    poses[2] = pose
    return poses


SDF = METHODS["sdf"]
DENSITY = make_field("imap", NETWORK, SceneBounds(*UNIT), 0)
REFUSED = {
    "mirrored pose": lambda: tracker(pose=np.diag([1.0, 1.0, -1.0, 1.0])),
    "zero pose for a picture": lambda: DENSITY.render_view(CAMERA, np.zeros((4, 4))),
    "part of a pixel": lambda: tracker(n_pixels=16.7),
    "part of a seed": lambda: mapped(seed=0.5),
    "part of an iteration": lambda: mapped(settings=NeusMapping(**SMALL | {"iterations": 2.5})),
    "settings of others": lambda: mapped(settings=SdfSettings()),
    "grid of a density": lambda: tracker(BakedField(DENSITY, 0.3)),
    "its tracker": lambda: SdfTracker(BakedField(DENSITY, 0.3), np.eye(4), StepBudget(1)),
    "density corrected": lambda: correction.corrected(DENSITY, SEQUENCE, np.arange(4), 0.3),
    "bounds upside down": lambda: SceneBounds((1, 1, 1), (0, 0, 0)),
    "unit of zero": lambda: SceneBounds(*UNIT, 0.0),
    "half a column": lambda: Intrinsics(32.5, 24, 24.0, 24.0, 16.0, 12.0),
    "no frames": lambda: mapped(SEQUENCE.select(slice(3, 3))),
    "a frame without pose": lambda: mapped(replace(SEQUENCE, T_world_camera=poses_with(np.nan))),
    "a pose that stretches": lambda: mapped(replace(SEQUENCE, T_world_camera=poses_with(2))),
    "depth in metres": lambda: replace(SEQUENCE, depths_mm=SEQUENCE.depths_mm / 1000),
    "fewer depths": lambda: replace(SEQUENCE, depths_mm=SEQUENCE.depths_mm[:2]),
    "millimetres as float": lambda: nbtrack.Frame.of_images(CAMERA, COLOR, DEPTH.astype(float)),
    "colour as integers": lambda: nbtrack.Frame.of_images(CAMERA, COLOR.astype(np.int64), DEPTH),
    "grey": lambda: nbtrack.Frame.of_images(CAMERA, COLOR[..., 0], DEPTH),
    "another size": lambda: nbtrack.Frame.of_images(CAMERA, COLOR, DEPTH[::2, ::2]),
    "part of a frame": lambda: SEQUENCE[1.5],
    "a frame for frames": lambda: SEQUENCE.select(3),
    "points of two": lambda: BoxRoom()(torch.zeros(5, 2)),
    "points of numpy": lambda: BakedField(BoxRoom(), 0.5).channels(np.zeros((5, 3))),
    "a float depth": lambda: replace(SEQUENCE[1], depth_mm=SEQUENCE[1].depth_mm / 1000),
    "camera last": lambda: Frame.of_images(SEQUENCE.colors[0], SEQUENCE.depths_mm[0], CAMERA),
    "images for a frame": lambda: tracker().track(SEQUENCE.colors[0]),
    "a number for a budget": lambda: SdfTracker(BoxRoom(), np.eye(4), 20),
    "a number for one frame": lambda: tracker().track(SEQUENCE[1], 5),
    "no settings": lambda: nbtrack.make_tracker("sdf", BoxRoom(), np.eye(4), StepBudget(1), {}),
    "fewer times": lambda: replace(SEQUENCE, times=SEQUENCE.times[:2]),
    "fewer numbers": lambda: replace(SEQUENCE, frame_ids=SEQUENCE.frame_ids[:2]),
    "a text for a length": lambda: replace(CAMERA, fx="24"),
    "arguments swapped": lambda: track_sequence(SEQUENCE, tracker()),
    "mapped when swapped": lambda: map_sequence(SEQUENCE, "neus", NETWORK, NeusMapping(**SMALL)),
    "written when swapped": lambda: write_map(mapped(), "here"),
    "no path": lambda: read_map(None),
    "an empty name": lambda: nbtrack.open_scene("", nbtrack.load_preset()),
    "a preset's name": lambda: nbtrack.open_scene("office", "smoke"),
    "no frame of this number": lambda: nbtrack.read_sequence(scenes()["scenes"][0].folder, [99]),
    "frames as a text": lambda: nbtrack.read_sequence(scenes()["scenes"][0].folder, "0:3"),
    "a slice for a text": lambda: scenes()["scenes"][0].read(slice(0, 3)),
    "true steps": lambda: make_budget(True, None),
    "200 Hz": lambda: paper_steps("vr", 200),
    "a tracker without a row": lambda: paper_steps("lm", 10),
    "two lines": lambda: read_setting("a=1\nb=2"),
    "one text of settings": lambda: nbtrack.load_preset(settings="scenes.width=32"),
    "nobody": lambda: absolute("~nobody_of_this_name/x"),
    "scenes once": lambda: nbtrack.track_scenes(**scenes() | {"scenes": iter([])}),
    "names for scenes": tracked_with(scenes=["office"]),
    "no methods": tracked_with(methods=[]),
    "no steps to track": tracked_with(steps=0),
    "steps and rates": tracked_with(steps=3, rates_hz=[10]),
    "steps by the clock": tracked_with(steps=3, clock=True),
    "a rate for rates": tracked_with(rates_hz=10),
    "a number for a method": lambda: find_methods([3]),
    "a text for settings": lambda: find_methods([replace(SDF, settings="tracking.sdf.seed=1")]),
    "two of one label": lambda: find_methods([SDF, replace(SDF, field="neus_plus")]),
    "a number for a clock": lambda: ClockBudget(10, clock=5),
    "no table of losses": lambda: write_map("here", replace(mapped(), history=None)),
    "a size for a camera": lambda: replace(SEQUENCE, intrinsics=(32, 24)),
    "a picture without a camera": lambda: DENSITY.render_view(None, np.eye(4)),
    "a start in another world": lambda: tracker(pose=poses_at([[1e3, 0, 0]])[0]),
    "a pose in the complex plane": lambda: tracker(pose=np.eye(4) * 1j),
    "an array of one number": tracked_with(rates_hz=np.array(10)),
    "fewer tracked": lambda: nbtrack.track_scenes(**scenes(), tracked=2 * scenes()["scenes"]),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_refused(case: str) -> None:
    """Catches arguments that are taken in silence, or end in somebody else's error later on, where
    types are not checked at each call."""
    with pytest.raises(NbtrackError):
        REFUSED[case]()


def test_right_in_another_form() -> None:
    """Catches what depends on the form of right input: its precision, order in memory, or type."""
    point = torch.tensor([[0.1, 0.2, 0.3]])
    for field in (DENSITY, BakedField(BoxRoom(), 0.2)):
        assert torch.equal(field(point.double())[1], field(point)[1])
    poses = [
        track_sequence(tracker(field), SEQUENCE).T_estimated
        for field in (mapped().field, mapped().field.half(), mapped().field.double())
    ]
    assert np.array_equal(poses[0], poses[2])
    assert np.allclose(poses[0], poses[1], rtol=0, atol=1e-3)
    backwards = SEQUENCE.select(slice(None, None, -1))
    foreign = replace(backwards, depths_mm=backwards.depths_mm.astype(">u2"))
    assert mapped(foreign).key == mapped(backwards.select(np.arange(4))).key
    assert SceneBounds(*np.array(UNIT)) == SceneBounds(*UNIT)
    of_numpy = [np.int64(32), np.int64(24), *map(np.float32, (24, 24, 16, 12))]
    assert repr(Intrinsics(*of_numpy)) == repr(Intrinsics(32, 24, 24.0, 24.0, 16.0, 12.0))
    listed = replace(SDF, label="SDF", settings=["tracking.sdf.n_pixels=16"])
    assert find_methods([listed, SDF, "sdf", listed]) == [listed, SDF]


def default_dtype() -> ExitStack:
    torch.set_default_dtype(torch.float64)
    stack = ExitStack()
    stack.callback(torch.set_default_dtype, torch.float32)
    return stack


MODES = {
    "inference": torch.inference_mode, "no gradients": torch.no_grad, "double": default_dtype,
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "another device": lambda: torch.device("meta"),
}  # fmt: skip


def everything() -> list[np.ndarray]:
    """Numbers that maps, their grids, pictures and trackers come to."""
    grid = mapped(name="grid_plus", settings=GridPlusMapping(**SMALL), network=GridNetwork())
    imap = mapped(name="imap", settings=MappingSettings(**SMALL))
    better = correction.correct_map(mapped(), SEQUENCE, 0.3).field
    paths = [
        track_sequence(tracker(field, name=name), SEQUENCE).T_estimated
        for name, field in {"vr": imap.field, "sdf": grid.field, "lm": better}.items()
    ]
    return [*paths, *imap.field.render_view(CAMERA, np.eye(4)), better.volume.numpy()]


@pytest.mark.parametrize("mode", MODES)
def test_modes_do_not_matter(mode: str, monkeypatch) -> None:
    """Catches a result, or a failure, by a mode of the program, also one left behind in a cache;
    and a default or random numbers of the program that are changed."""
    monkeypatch.setattr(correction, "_N_POINTS", 2000)
    constant.cache_clear()
    with MODES[mode]():
        before = torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_rng_state().tolist()
        found = everything()
        after = torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_rng_state().tolist()
    assert after == before
    assert all(np.array_equal(a, b) for a, b in zip(found, everything(), strict=True))


COPIES = [copy.copy, copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))]


@pytest.mark.parametrize("name", ["sdf", "lm"])
@pytest.mark.parametrize("copied", COPIES)
def test_trackers_are_copied_and_fields_are_theirs(copied, name: str) -> None:
    """Catches a copy that goes elsewhere or moves the original, and a field that the tracker
    freezes, or that moves the tracker when its owner changes it."""
    field = make_field("neus", NETWORK, SceneBounds((-1.2,) * 3, (1.2,) * 3), 0)
    first = tracker(field, name=name)
    assert field.training
    assert all(part.requires_grad for part in field.parameters())
    assert not any(part.requires_grad for part in first.field.parameters())
    first.track(SEQUENCE[1])
    second = copied(first)
    found = [each.track(SEQUENCE[2]).T_world_camera for each in (first, second)]
    with torch.no_grad():
        field.mlp.head.bias += 1.0
    found += [copied(each).track(SEQUENCE[3]).T_world_camera for each in (first, second)]
    assert np.array_equal(*found[:2])
    assert np.array_equal(*found[2:])
    first.estimates[-1][0, 3] = 1e3  # lost
    assert copied(first).estimates[-1][0, 3] == 1e3


def test_a_map_of_the_cache_stays_as_it_was_read() -> None:
    """Catches a change of a map that was handed out in what the next caller gets."""
    (scene,), preset = scenes()["scenes"], scenes()["preset"]
    one = nbtrack.map_scene(scene, "neus", preset)
    key = one.key
    one.field.mlp.head.bias += 1.0
    one.record["quality"].clear()
    with pytest.raises(ValueError, match="read-only"):  # what the next map would be made of
        scene.read().depths_mm[:] = 0
    assert one.key != key
    other = nbtrack.map_scene(scene, "neus", preset)
    assert other.key == key
    assert other.record["quality"]


def test_a_recording_stays_as_it_was_read() -> None:
    """Catches a change of poses that were handed out in what the next reader gets."""
    recording = scenes()["scenes"][0].recording
    known, origin = recording.T_world_camera.copy(), recording.origin.copy()
    for array in (recording.T_world_camera, recording.has_pose, recording.origin):
        array[:] = 7
    for array in (recording.times, recording.file_poses):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 7
    assert np.array_equal(recording.T_world_camera, known)
    assert np.array_equal(recording.origin, origin)
    assert recording.has_pose.all()


OTHERS: dict[str, dict] = {
    "recording": {"sequence": box_sequence([[0, 0.002 * i, 0] for i in range(4)])},
    "map": {"field": mapped().field}, "budget": {"budget": 4}, "settings": {"lambda_color": 0.1},
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERS)
def test_a_checkpoint_knows_whose_it_is(case: str, tmp_path: Path, monkeypatch) -> None:
    """Catches the path of another run, returned as this one's."""
    monkeypatch.setattr("nbtrack.machinery.files.CHECKPOINT_SECONDS", -1)
    path = tmp_path / "run.pt"
    known = track_sequence(tracker(mapped(seed=1).field), SEQUENCE, str(path))
    again = track_sequence(tracker(mapped(seed=1).field), SEQUENCE, path)
    assert np.array_equal(known.T_estimated, again.T_estimated)
    other = {"field": mapped(seed=1).field, "sequence": SEQUENCE, **OTHERS[case]}
    sequence = other.pop("sequence")
    with pytest.raises(NbtrackError, match="was made with another"):
        track_sequence(tracker(**other), sequence, path)


class Kept(FIELDS["neus"]):
    name = "kept"

    @classmethod
    def from_state(cls, state, made, bounds: SceneBounds):
        raise NotImplementedError


UNREADABLE = {
    "grid": lambda made: replace(made, field=BakedField(made.field, 0.3)),
    "class": lambda made: replace(made, field=Kept(NETWORK, made.field.bounds, torch.Generator())),
    "record": lambda made: replace(made, record={**made.record, "network": {"width": 9}}),
    "no seconds": lambda made: replace(made, record={**made.record, "seconds": np.nan}),
    "no record": lambda made: replace(made, record={"network": {}}),
    "numpy": lambda made: replace(made, record={**made.record, "mine": np.ones(3)}),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_what_could_not_be_read_is_not_written(case: str, tmp_path: Path, monkeypatch) -> None:
    """Catches a map that is lost when it is written, and one with another map's history
    or mesh."""
    monkeypatch.setitem(FIELDS, "kept", Kept)
    write_map(tmp_path / MAP_FILE, mapped())
    with pytest.raises(NbtrackError):
        write_map(tmp_path / MAP_FILE, UNREADABLE[case](mapped(seed=1)))
    assert read_map(tmp_path).record["seed"] == 0
    write_map(tmp_path / "alone", mapped(seed=2))
    assert len(read_map(tmp_path).history) == 3
    (tmp_path / "mesh.ply").write_text("of the first")
    write_map(tmp_path, read_map(tmp_path / "alone"))
    assert read_map(tmp_path).history.empty
    assert not (tmp_path / "mesh.ply").exists()
