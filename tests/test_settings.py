"""Settings: who overrides whom, and that a misspelt key can never pass for a valid one."""

import copy
import json
from argparse import Namespace
from pathlib import Path

import pytest

from nbtrack.core.errors import ConfigError
from nbtrack.core.files import fingerprint
from nbtrack.core.settings import as_dict, changed_settings, with_settings
from nbtrack.data.sequence import parse_frames
from nbtrack.experiments.commands import _preset_of
from nbtrack.experiments.methods import METHODS, TABLE_1
from nbtrack.experiments.presets import PRESETS, Preset, load_preset
from nbtrack.fields import NetworkSettings
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.synthetic.make import MOTIONS
from nbtrack.synthetic.room import build_room
from nbtrack.tracking.metrics import still_metrics

KEY = "mapping.neus.iterations"


# What a camera that stands still must be off (m) in the frames that a preset tracks.
FLOORS = [("smoke", 0.5), ("nine_rooms", 1.0), ("synthetic", 1.0)]


def iterations(preset: Preset) -> int:
    return preset.mapping["neus"].iterations


def test_presets_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches another default than smoke, and an environment that outdoes an explicit name."""
    assert load_preset() == PRESETS["smoke"]
    monkeypatch.setenv("NBTRACK_PRESET", "synthetic")
    assert load_preset() == PRESETS["synthetic"]
    assert load_preset("paper") == PRESETS["paper"]


@pytest.mark.parametrize(("name", "floor_m"), FLOORS)
def test_tracked_frames_leave_their_start(name: str, floor_m: float) -> None:
    """Catches a preset that tracks frames in which a camera that stands still does nearly as well
    as one that is tracked."""
    scenes = PRESETS[name].scenes
    tracked = parse_frames(scenes.track_frames)
    for room in scenes.names:
        path = MOTIONS[scenes.motion](build_room(room), scenes.n_frames, scenes.seed)
        assert still_metrics(path[tracked])["still_ate_m"] > floor_m, room


def test_figures_of_the_presets() -> None:
    """Catches a drifted default: what the paper states, the paper's preset must say; and a preset
    that reports a room on which settings were chosen, or leaves one out."""
    paper = PRESETS["paper"]
    assert (paper.tracking["vr"].n_pixels, paper.tracking["sdf"].n_pixels) == (512, 4096)
    for name in TABLE_1:
        tracking = paper.tracking[METHODS[name].tracker]
        assert (tracking.position_rate, tracking.orientation_rate) == (5e-4, 1e-3)
        assert tracking.motion_model == "previous_pose"
    assert paper.tables.rates_hz == (10.0, 5.0, 2.0)
    assert paper.tables.budgets_ms == (50.0, 100.0, 500.0)
    assert paper.scenes.names[:2] == ("breakfast_room", "complete_kitchen")
    steps = {name: METHODS[name].paper_steps(10) for name in ("vr_neus", "sdf", "baked")}
    assert steps == {"vr_neus": 6.8, "sdf": 15.3, "baked": 15.3}
    assert PRESETS["synthetic"].scenes.names == REPORTED_ROOMS
    assert not {"bedroom", "kitchen_nook"} & {*REPORTED_ROOMS}
    assert {*PRESETS["smoke"].scenes.names} <= {*REPORTED_ROOMS}


def test_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a wrong order: preset < file < environment < explicit; presets never change."""
    before = copy.deepcopy(PRESETS)
    path = tmp_path / "settings.toml"
    path.write_text("[mapping.neus]\niterations = 11\nn_rays = 12\n")
    assert iterations(load_preset(config_file=path)) == 11
    monkeypatch.setenv("NBTRACK_SET", f"{KEY}=22")
    assert iterations(load_preset(config_file=path)) == 22
    resolved = load_preset(config_file=path, settings=(f"{KEY}=33",))
    assert iterations(resolved) == 33
    assert resolved.mapping["neus"].n_rays == 12  # the file's other line still counts
    assert resolved.mapping["imap"] == PRESETS["smoke"].mapping["imap"]
    assert iterations(load_preset(settings=(f"{KEY}=1", f"{KEY}=2"))) == 2
    monkeypatch.setenv("NBTRACK_SET", "")
    monkeypatch.setenv("NBTRACK_CONFIG", str(path))
    assert iterations(load_preset()) == 11
    (tmp_path / "other.toml").write_text(f"{KEY} = 6")
    assert iterations(load_preset(config_file=tmp_path / "other.toml")) == 6
    assert before == PRESETS


@pytest.mark.parametrize("source", ["file", "environment", "set"])
def test_a_method_gives_way_to_the_user(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a method's settings that are applied last, so that a run has another n than the one
    that was asked for and that its caption names: preset < method < file < environment < --set."""
    method, key = METHODS["corrected"], "tracking.lm.n_pixels"
    assert load_preset().with_method(method.settings).tracking["lm"].n_pixels == 2048
    (tmp_path / "own.toml").write_text(f"{key} = 64")
    given = {"config_file": tmp_path / "own.toml"} if source == "file" else {}
    if source == "environment":
        monkeypatch.setenv("NBTRACK_SET", f"{key}=64")
    preset = load_preset(**given, settings=[f"{key}=64"] if source == "set" else [])
    own = preset.with_method(method.settings)
    assert own.tracking["lm"].n_pixels == 64
    assert own.mapping["neus_plus"].correct_voxel == 0.04  # what the user left to the method
    options = Namespace(preset=None, config=given.get("config_file"), settings=[f"{key}=32"])
    assert _preset_of(options, method).tracking["lm"].n_pixels == 32  # as `track` does
    assert load_preset(settings=[f"{key}=512"]).with_method(method.settings) != own


def test_values_take_the_type_of_the_preset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches integers left in real settings, single values where several are allowed, and, in the
    environment, a split at commas or within quotes."""
    settings = (
        "mapping.neus.learning_rate=1", "tables.rates_hz=[4, 2.5]", "scenes.synthetic=false",
        "scenes.track_frames=0:10:2", "scenes.width = 64", "mapping.neus.holdout_every=0",
    )  # fmt: skip
    resolved = load_preset(settings=(*settings, "scenes.names=office"))
    assert type(resolved.mapping["neus"].learning_rate) is float
    assert resolved.mapping["neus"].holdout_every == 0
    assert resolved.scenes.names == ("office",)
    assert [type(rate) for rate in resolved.tables.rates_hz] == [float, float]
    assert resolved.scenes.synthetic is False
    assert (resolved.scenes.track_frames, resolved.scenes.width) == ("0:10:2", 64)
    monkeypatch.setenv("NBTRACK_SET", """scenes.n_frames=7 "scenes.names=['office', 'bedroom']" """)
    scenes = load_preset().scenes
    assert (scenes.n_frames, scenes.names) == (7, ("office", "bedroom"))


REFUSED = {  # beside those of test_faults.py
    # A misspelt or unused key that would be silently added.
    "tracking.sdf.npixels=5": "did you mean 'tracking.sdf.n_pixels'?",
    "scene.names=5": "did you mean 'scenes.names'?",
    "tracking.lm.lambda_color=5": "did you mean 'tracking.vr.lambda_color'?",  # LM has none
    # A whole branch, the preset's own name or an attribute replaced by a number.
    "__class__=5": "unknown config key '__class__'",
    # Values that would fail, or worse would not, somewhere in a run of hours.
    "mapping.neus.learning_rate=false": "it must be float, for example",
    "scenes.synthetic=1": "it must be bool, for example",
    "scenes.track_frames=10": "it must be str, for example",
    "scenes.names=[1, 2]": "it must be str, for example",
    "tables.pixels.vr=[1.5]": "it must be int, for example",
    # A sign that turns a loss into a reward, and a list whose quotes the shell ate.
    "mapping.imap.learning_rate=-1e-3": "it must be 0 or more",
    "tables.rates_hz=[5, -1]": "it must be 0 or more",
    "scenes.names=[office,bedroom]": "is no TOML",
}


@pytest.mark.parametrize("setting", REFUSED)
def test_settings_that_are_refused(setting: str) -> None:
    """Catches what is said beside each kind of them, and messages of several lines."""
    with pytest.raises(ConfigError) as caught:
        load_preset(settings=(setting,))
    assert REFUSED[setting] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", PRESETS)
def test_changed_settings_are_those_that_were_changed(name: str) -> None:
    """Catches settings that cannot be given again: every kind of value makes the round trip."""
    settings = (
        f"{KEY}=7", "tracking.sdf.motion_model=constant_velocity", "scenes.names=['a', 'b']",
        "tables.rates_hz=[3.5]", "network.imap.embedding_sigma=1.25", "tables.pixels.vr=[9]",
    )  # fmt: skip
    preset = with_settings(PRESETS[name], *settings)
    changed = changed_settings(preset, PRESETS[name])
    assert len(changed) == len(settings)
    assert with_settings(PRESETS[name], *changed) == preset
    assert changed_settings(load_preset(name), PRESETS[name]) == []
    assert json.loads(json.dumps(as_dict(preset))) == as_dict(preset)


def test_fingerprint() -> None:
    """Catches a cache that mixes up settings, or forgets them between two runs."""
    found = {fingerprint(NetworkSettings(), 0) for _ in range(2)}
    found |= {fingerprint(NetworkSettings(), 1), fingerprint(NetworkSettings(width=255), 0)}
    assert len(found) == 3
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert {len(text) for text in found} == {12}
