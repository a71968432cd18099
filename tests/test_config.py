"""Settings: who overrides whom, and that a misspelt key can never pass for a valid one."""

import copy
import json
from pathlib import Path

import pytest

from nbtrack.core.config import PRESETS, FieldConfig, Preset, as_dict
from nbtrack.core.errors import ConfigError, MissingError
from nbtrack.core.provenance import fingerprint
from nbtrack.core.settings import resolve_preset
from nbtrack.experiments.scenes import DATASET_SCENES
from nbtrack.synthetic import REPORTED_ROOMS


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings of whoever runs the tests must not count."""
    for name in ("NBTRACK_PRESET", "NBTRACK_CONFIG", "NBTRACK_SET"):
        monkeypatch.delenv(name, raising=False)


def iterations(preset: Preset) -> int:
    return preset.mapping["neus"].iterations


def toml_file(folder: Path, text: str) -> Path:
    (folder / "settings.toml").write_text(text)
    return folder / "settings.toml"


def refused(*settings: str) -> str:
    with pytest.raises(ConfigError) as caught:
        resolve_preset(settings=settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_presets_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches another default than smoke, and an environment that outdoes an explicit name."""
    assert resolve_preset() == PRESETS["smoke"]
    monkeypatch.setenv("NBTRACK_PRESET", "synthetic")
    assert resolve_preset() == PRESETS["synthetic"]
    assert resolve_preset("paper") == PRESETS["paper"]


def test_papers_figures() -> None:
    """Catches a drifted default: what the paper states, the paper's preset must say."""
    paper = PRESETS["paper"]
    assert (paper.tracking["vr"].n_pixels, paper.tracking["sdf"].n_pixels) == (512, 4096)
    for tracking in paper.tracking.values():
        assert (tracking.position_rate, tracking.orientation_rate) == (5e-4, 1e-3)
    assert paper.tables.rates_hz == (10.0, 5.0, 2.0)
    assert paper.tables.budgets_ms == (50.0, 100.0, 500.0)
    assert paper.scenes.names == DATASET_SCENES
    of_the_paper = [paper.tracking[name] for name in ("vr", "vr_neus", "sdf")]
    assert {t.motion_model for t in of_the_paper} == {"previous_pose"}
    assert {t.bake_voxel for t in of_the_paper} == {0.0}


def test_nothing_is_tuned_on_what_is_reported() -> None:
    """Catches a preset that reports a room on which settings were chosen, or leaves one out."""
    assert PRESETS["synthetic"].scenes.names == REPORTED_ROOMS
    assert set(PRESETS["smoke"].scenes.names) <= set(REPORTED_ROOMS)


def test_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a wrong order: preset < file < environment < explicit."""
    key = "mapping.neus.iterations"
    path = toml_file(tmp_path, "[mapping.neus]\niterations = 11\nn_rays = 12\n")
    assert iterations(resolve_preset(config_file=path)) == 11
    monkeypatch.setenv("NBTRACK_SET", f"{key}=22")
    assert iterations(resolve_preset()) == 22
    assert iterations(resolve_preset(config_file=path)) == 22
    resolved = resolve_preset(config_file=path, settings=(f"{key}=33",))
    assert iterations(resolved) == 33
    assert resolved.mapping["neus"].n_rays == 12  # the file's other line still counts
    assert resolved.mapping["imap"] == PRESETS["smoke"].mapping["imap"]
    assert iterations(resolve_preset(settings=(f"{key}=1", f"{key}=2"))) == 2


def test_config_file_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a named file that is ignored, or wins over the one given explicitly."""
    monkeypatch.setenv("NBTRACK_CONFIG", str(toml_file(tmp_path, "mapping.neus.iterations = 5")))
    assert iterations(resolve_preset()) == 5
    other = tmp_path / "other.toml"
    other.write_text("mapping.neus.iterations = 6")
    assert iterations(resolve_preset(config_file=other)) == 6


def test_several_settings_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a split at commas or within quotes."""
    monkeypatch.setenv("NBTRACK_SET", """scenes.n_frames=7 "scenes.names=['office', 'bedroom']" """)
    scenes = resolve_preset().scenes
    assert (scenes.n_frames, scenes.names) == (7, ("office", "bedroom"))
    monkeypatch.setenv("NBTRACK_SET", "scenes.names=['office")
    with pytest.raises(ConfigError, match="NBTRACK_SET"):
        resolve_preset()


def test_values_take_the_type_of_the_preset() -> None:
    """Catches integers left in real settings, and single values where several are allowed."""
    resolved = resolve_preset(
        settings=(
            "mapping.neus.learning_rate=1", "scenes.names=office", "tables.rates_hz=[4, 2.5]",
            "scenes.synthetic=false", "scenes.track_frames=0:10:2", "scenes.width = 64",
        )
    )  # fmt: skip
    assert type(resolved.mapping["neus"].learning_rate) is float
    assert resolved.scenes.names == ("office",)
    assert resolved.tables.rates_hz == (4.0, 2.5)
    assert [type(rate) for rate in resolved.tables.rates_hz] == [float, float]
    assert resolved.scenes.synthetic is False
    assert (resolved.scenes.track_frames, resolved.scenes.width) == ("0:10:2", 64)


@pytest.mark.parametrize(
    ("key", "nearest"),
    [
        ("mapping.neus.iteration", "mapping.neus.iterations"),
        ("tracking.sdf.npixels", "tracking.sdf.n_pixels"),
        ("scene.names", "scenes.names"),
    ],
)
def test_unknown_key_names_the_nearest(key: str, nearest: str) -> None:
    """Catches a misspelt key that is silently added."""
    assert f"unknown config key '{key}': did you mean '{nearest}'?" in refused(f"{key}=5")


@pytest.mark.parametrize("key", ["name", "mapping", "mapping.neus", "", "__class__"])
def test_keys_that_are_no_settings(key: str) -> None:
    """Catches a whole branch, the preset's own name or an attribute replaced by a number."""
    assert f"unknown config key '{key}'" in refused(f"{key}=5")


def test_unknown_key_in_a_file(tmp_path: Path) -> None:
    """Catches files that are checked less than settings are."""
    with pytest.raises(ConfigError, match=r"did you mean 'mapping\.neus\.n_rays'"):
        resolve_preset(config_file=toml_file(tmp_path, "[mapping.neus]\nn_ray = 5"))


def test_unknown_preset_names_the_nearest() -> None:
    """Catches a fallback to the default preset."""
    with pytest.raises(ConfigError, match="'papper': did you mean 'paper'"):
        resolve_preset("papper")


@pytest.mark.parametrize(
    ("setting", "wanted"),
    [
        ("mapping.neus.iterations=1.5", "int"),
        ("mapping.neus.iterations=many", "int"),
        ("mapping.neus.iterations=true", "int"),
        ("mapping.neus.iterations=", "int"),
        ("mapping.neus.learning_rate=false", "float"),
        ("scenes.synthetic=1", "bool"),
        ("scenes.track_frames=10", "str"),
        ("scenes.names=[1, 2]", "str"),
        ("tables.rates_hz=['fast']", "float"),
        ("tables.pixels.vr=[1.5]", "int"),
    ],
)
def test_wrong_type(setting: str, wanted: str) -> None:
    """Catches values that would fail, or worse would not, somewhere in a run of hours."""
    message = refused(setting)
    assert setting.partition("=")[0] in message
    assert f"it must be {wanted}, for example" in message


@pytest.mark.parametrize(
    "setting",
    ["mapping.neus.iterations=-1", "mapping.imap.learning_rate=-1e-3", "tables.rates_hz=[5, -1]",
     "mapping.neus.lambda_eikonal=nan"],
)  # fmt: skip
def test_negative_values(setting: str) -> None:
    """Catches a sign that turns a loss into a reward."""
    assert "or more" in refused(setting)


def test_malformed_settings() -> None:
    """Catches a list whose quotes the shell has eaten, taken for one long name."""
    assert "write key=value" in refused("mapping.neus.iterations")
    assert "is no TOML" in refused("scenes.names=[office,bedroom]")


def test_bad_files(tmp_path: Path) -> None:
    """Catches a missing or broken file that is passed over."""
    with pytest.raises(MissingError, match=r"nowhere\.toml"):
        resolve_preset(config_file=tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match=r"settings\.toml is no TOML") as caught:
        resolve_preset(config_file=toml_file(tmp_path, "iterations : 5\n"))
    assert "\n" not in str(caught.value)


def test_presets_are_never_changed(tmp_path: Path) -> None:
    """Catches overrides that leak into the next run of the same process."""
    before = copy.deepcopy(PRESETS)
    resolved = resolve_preset(
        "smoke",
        toml_file(tmp_path, "tracking.sdf.n_pixels = 3\ntables.pixels.sdf = [1]"),
        ("mapping.neus.iterations=9", "network.neus.width=8"),
    )
    assert before == PRESETS
    assert resolved != PRESETS["smoke"]
    assert resolved.tracking["sdf"].n_pixels == 3


def test_settings_of_unknown_methods() -> None:
    """Catches a new field or tracker that cannot run before somebody edits the presets."""
    smoke = PRESETS["smoke"]
    assert smoke.mapping_of("imap") == smoke.mapping["imap"]
    assert smoke.mapping_of("my field") == smoke.mapping["neus"]
    assert smoke.tracking_of("vr") == smoke.tracking["vr"]
    assert smoke.tracking_of("my tracker") == smoke.tracking["sdf"]


def test_as_dict_is_plain() -> None:
    """Catches values that JSON turns into others: a saved config must compare equal."""
    for preset in PRESETS.values():
        plain = as_dict(preset)
        assert json.loads(json.dumps(plain)) == plain
        assert plain["mapping"]["neus"]["iterations"] == iterations(preset)


def test_fingerprint() -> None:
    """Catches a cache that mixes up settings, or forgets them between two runs."""
    assert fingerprint(FieldConfig(), 0) == fingerprint(FieldConfig(), 0)
    others = [fingerprint(FieldConfig(), 1), fingerprint(FieldConfig(width=255), 0)]
    assert len({fingerprint(FieldConfig(), 0), *others}) == 3
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert len(fingerprint("x")) == 12
