"""Settings: who overrides whom, and that a misspelt key can never pass for a valid one."""

import contextlib
import copy
import re
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from box_room import BoxRoom, walk
from tiny import TINY

from nbtrack import METHODS, Field, load_preset, make_tracker, open_scenes
from nbtrack.beyond.correction import correct_map
from nbtrack.beyond.points import PointMapping
from nbtrack.data.dataset import DATASET_SCENES
from nbtrack.experiments.bench import measure_steps
from nbtrack.experiments.methods import TABLE_1
from nbtrack.experiments.presets import PRESETS, Preset
from nbtrack.fields import NetworkSettings
from nbtrack.machinery.errors import ConfigError, NbtrackError
from nbtrack.machinery.settings import changed_settings, flat, with_settings
from nbtrack.mapping.fit import map_sequence
from nbtrack.synthetic import REPORTED_ROOMS
from nbtrack.tables import published_table_1
from nbtrack.tracking import StepBudget

KEY = "mapping.neus.iterations"


def iterations(preset: Preset) -> int:
    return preset.mapping_of("neus").iterations


def test_figures_of_the_presets() -> None:
    """Catches a drifted default: what the paper states, the paper's preset must say; and a preset
    that reports a room on which settings were chosen, or leaves one out."""
    paper = PRESETS["paper"]
    assert (paper.tracking_of("vr").n_pixels, paper.tracking_of("sdf").n_pixels) == (512, 4096)
    for name in TABLE_1:
        tracking = paper.tracking_of(METHODS[name].tracker)
        assert (tracking.position_rate, tracking.orientation_rate) == (5e-4, 1e-3)
        assert tracking.motion_model == "previous_pose"
    assert paper.tables.rates_hz == (10.0, 5.0, 2.0)
    assert paper.tables.budgets_ms == (50.0, 100.0, 500.0)
    assert paper.scenes.names == (*DATASET_SCENES,)
    assert {*DATASET_SCENES.values()} == {*published_table_1()["scene"]}
    assert METHODS["baked"].paper_steps(10) == 15.3
    assert PRESETS["synthetic"].scenes.names == REPORTED_ROOMS
    assert not {"bedroom", "kitchen_nook"} & {*REPORTED_ROOMS}
    assert {*PRESETS["smoke"].scenes.names} <= {*REPORTED_ROOMS}


def test_precedence(tmp_path: Path, monkeypatch) -> None:
    """Catches a wrong order: preset < file < environment < explicit, or smoke < environment <
    explicit of names; presets never change."""
    before = copy.deepcopy(PRESETS)
    assert load_preset() == PRESETS["smoke"]
    with monkeypatch.context() as patch:
        patch.setenv("NBTRACK_PRESET", "")  # as not set
        assert load_preset() == PRESETS["smoke"]
        patch.setenv("NBTRACK_PRESET", "synthetic")
        assert load_preset() == PRESETS["synthetic"]
        assert load_preset("paper") == PRESETS["paper"]
    path = tmp_path / "settings.toml"
    path.write_text("[mapping.neus]\niterations = 11\nn_rays = 12\n")
    assert iterations(load_preset(config_file=path)) == 11
    monkeypatch.setenv("NBTRACK_SET", f"{KEY}=22")
    assert iterations(load_preset(config_file=path)) == 22
    resolved = load_preset(config_file=path, settings=(f"{KEY}=33",))
    assert iterations(resolved) == 33
    assert resolved.mapping_of("neus").n_rays == 12  # the file's other line still counts
    assert resolved.mapping_of("imap") == PRESETS["smoke"].mapping_of("imap")
    assert iterations(load_preset(settings=(f"{KEY}=1", f"{KEY}=2"))) == 2
    monkeypatch.setenv("NBTRACK_SET", "")
    monkeypatch.setenv("NBTRACK_CONFIG", str(path))
    assert iterations(load_preset()) == 11
    (tmp_path / "other.toml").write_text(f"{KEY} = 6")
    assert iterations(load_preset(config_file=tmp_path / "other.toml")) == 6
    assert before == PRESETS


@pytest.mark.parametrize("source", ["file", "environment", "set"])
def test_a_method_gives_way_to_the_user(source: str, tmp_path: Path, monkeypatch) -> None:
    """Catches a method's settings that are applied last, so that a run has another n than the one
    that was asked for and that its caption names: preset < method < file < environment < --set."""
    method, key = METHODS["corrected"], "tracking.lm.n_pixels"
    assert load_preset().with_method(method.settings).tracking_of("lm").n_pixels == 2048
    (tmp_path / "own.toml").write_text(f"{key} = 64")
    given = {"config_file": tmp_path / "own.toml"} if source == "file" else {}
    if source == "environment":
        monkeypatch.setenv("NBTRACK_SET", f"{key}=64")
    preset = load_preset(**given, settings=[f"{key}=64"] if source == "set" else [])
    own = preset.with_method(method.settings)
    assert own.tracking_of("lm").n_pixels == 64
    assert own.correction["neus_plus"] == 0.04  # what the user left to the method
    chosen = load_preset(**given, settings=[f"{key}=32"], of_method=method.settings)
    assert chosen.tracking_of("lm").n_pixels == 32  # as `track` does
    changed = with_settings(load_preset(settings=[f"{KEY}=30"]), f"{KEY}=4")
    assert iterations(changed.with_method(())) == 4  # no earlier choice comes back


def test_values_take_the_type_of_the_preset(monkeypatch) -> None:
    """Catches integers left in real settings, single values where several are allowed, and, in the
    environment, a split at commas or within quotes."""
    settings = (
        "mapping.neus.learning_rate=1", "tables.rates_hz=[4, 2.5]",
        "scenes.track_frames=0:10:2", "scenes.width = 64", "mapping.neus.holdout_every=0",
    )  # fmt: skip
    resolved = load_preset(settings=(*settings, "scenes.names=office"))
    assert type(resolved.mapping_of("neus").learning_rate) is float
    assert resolved.mapping_of("neus").holdout_every == 0
    assert resolved.scenes.names == ("office",)
    assert [type(rate) for rate in resolved.tables.rates_hz] == [float, float]
    assert (resolved.scenes.track_frames, resolved.scenes.width) == ("0:10:2", 64)
    monkeypatch.setenv("NBTRACK_SET", """scenes.n_frames=7 "scenes.names=['office', 'bedroom']" """)
    scenes = load_preset().scenes
    assert (scenes.n_frames, scenes.names) == (7, ("office", "bedroom"))


REFUSED = dict.fromkeys(["tables.rates_hz=" + 5000 * "["], "is no TOML")
LISTED = pd.read_csv(Path(__file__).parent / "data/refused_settings.csv")
REFUSED |= dict(zip(LISTED["setting"], LISTED["says"], strict=True))


@pytest.mark.parametrize("setting", REFUSED, ids=range(len(REFUSED)))
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
    changed = changed_settings(preset.settings, PRESETS[name].settings)
    assert len(changed) == len(settings)
    assert with_settings(PRESETS[name], *changed) == preset
    assert load_preset(name) == PRESETS[name]


FLAT = flat(PRESETS["smoke"].settings)
# But for fields whose maps are made by the classes of others.
EVERY_KEY = [key for key in FLAT if not re.match(r"mapping\.(grid|vols|occ)|network\.occ", key)]
# Of each kind: the least, what casts, sums and casts of sums fail on, what is no value at all.
TRIED = {
    bool: ["true", "false"],
    int: ["0", "1", "-1", "0x" + "f" * 5000],
    float: ["0", "5e-324", "-1", "inf", "nan"],
    str: ['""', "x", ":", '"a/../x"', '"a\\u0000b"', "y" * 300],
}
TOO_MUCH = {int: [2**31, 2**63, 10**30], float: [1e9, 1e30, 1e308]}
SMALLEST = (
    *TINY, "scenes.n_frames=3", "scenes.names=['office']", "scenes.motion=tour",
    "tables.budgets_ms=[1]", "mapping.points.voxel=0.2", "tracking.lm.voxel=0.5",
    "tracking.vr.n_stratified=2", "tracking.vr.n_importance=1",
    *(
        f"mapping.{field}.{value}"
        for field in ("imap", "neus", "volsdf", "neus_plus", "grid_plus")
        for value in ("iterations=1", "n_rays=4", "n_stratified=2", "n_surface=1")
    ),
)  # fmt: skip
SEEN = walk(3)


@cache
def field_for(tracker: str) -> Field:
    if tracker == "icp":
        return map_sequence("points", SEEN, NetworkSettings(), PointMapping(voxel=0.2)).field
    return BoxRoom(as_density=tracker == "vr")


def use(preset: Preset, key: str) -> None:
    """Run what reads a key."""
    part, name, *_ = key.split(".")
    if part == "scenes":
        [len(scene.select(preset.scenes.track_frames)) for scene in open_scenes(preset)]
    elif part == "tables":
        measure_steps(preset, open_scenes(preset)[0], ["vr", "sdf"])
    elif part == "tracking":
        own = field_for(name), np.eye(4), StepBudget(1), preset.tracking_of(name)
        make_tracker(name, *own).track(SEEN[1])
    else:
        made = map_sequence(name, SEEN, preset.network_of(name), preset.mapping_of(name))
        if voxel := preset.correction.get(name):
            correct_map(made, SEEN, voxel)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NBTRACK_RUNS", str(tmp_path_factory.mktemp("small")))
        patch.setattr("nbtrack.beyond.correction._N_POINTS", 1000)
        patch.setattr("nbtrack.beyond.neus_plus._MIN_VOXEL", 0.5)
        yield load_preset("smoke", settings=SMALLEST)


@pytest.mark.parametrize("key", EVERY_KEY)
def test_every_key_at_its_limits(key: str, small: Preset) -> None:
    """Catches an allowed value that ends in a traceback of another library, by running what reads
    the key, and values that would fill the memory or never end."""
    old = FLAT[key]
    texts, kind = [], type(old)
    if kind is tuple:
        texts, kind = ["[]"], type(old[0]) if old else str
    for text in [*texts, *map(str, TOO_MUCH.get(kind, []))]:
        with pytest.raises(ConfigError):
            with_settings(small, f"{key}={text}")
    for text in TRIED[kind]:
        with contextlib.suppress(NbtrackError, OSError):  # which users are told in a line
            use(with_settings(small, f"{key}={text}"), key)
