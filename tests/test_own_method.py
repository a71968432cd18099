"""Adding a field or a tracker: a short file or cell registers it, and it has rows in the tables."""

import contextlib
import json
import subprocess
import sys
from dataclasses import make_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from unittest import mock

import pytest
from forked import forking
from test_faults import assert_refused
from test_mapping import NETWORK, finished_wall, settings_of, wall_sequence
from tiny import TINY, tiny_words

import nbtrack
from nbtrack import load_preset, provenance
from nbtrack.beyond.correction import correct_map
from nbtrack.cli import main
from nbtrack.experiments.methods import METHODS, method_of
from nbtrack.fields import FIELDS, NeusMapping, field_class
from nbtrack.machinery import registry
from nbtrack.machinery.errors import ConfigError
from nbtrack.machinery.files import runs_folder
from nbtrack.machinery.settings import with_settings
from nbtrack.mapping.files import MAP_FILE, write_map
from nbtrack.mapping.fit import map_sequence
from nbtrack.tracking import TRACKERS, tracker_class

OWN = (Path(__file__).parent / "data/own_method.py").read_text()


@contextlib.contextmanager
def importing():
    """What a command imports is known in the block alone, as in a process of its own."""
    with contextlib.ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        for known in (FIELDS, TRACKERS, METHODS):
            stack.enter_context(mock.patch.dict(known))
        patch.setattr(sys, "path", [*sys.path])
        yield
        registry.IMPORTED.clear()
        for name in ("my-method", "helper", "own_method"):
            sys.modules.pop(name, None)


def test_installed_packages_join_by_their_entry_points(tmp_path: Path, monkeypatch, capsys) -> None:
    """Catches a package whose methods no command knows unless somebody imports it, a traceback from
    every command because of somebody else's broken one, and a package's results that are never
    kept, or outlive an update."""
    (tmp_path / "own_method.py").write_text(OWN)
    (tmp_path / "own_broken.py").write_text("1 / 0")
    about = tmp_path / "own_method-1.0.dist-info"
    about.mkdir()
    (about / "entry_points.txt").write_text("[nbtrack]\nmine = own_method\nno = own_broken\n")
    (about / "top_level.txt").write_text("own_method")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(provenance, "_SITE", str(tmp_path))
    codes = []
    for version in ("1.0", "1.0", "1.1"):
        metadata = f"Metadata-Version: 2.1\nName: own-method\nVersion: {version}\n"
        (about / "METADATA").write_text(metadata)
        provenance._installed.cache_clear()  # as in another process
        with importing():
            monkeypatch.setattr(registry, "_waiting", [*entry_points(group="nbtrack")])
            assert main(["methods"]) == 0
            codes.append(provenance.code_fingerprint(TRACKERS["distance"]))
    assert codes[0] == codes[1] != codes[2]
    said = capsys.readouterr()
    assert "Mine" in said.out
    broken = "plug-in own_broken is left out (ZeroDivisionError: division by zero)"
    assert [broken in line for line in said.err.splitlines()] == 3 * [True]


def test_a_file_joins_by_an_option_of_every_command(tmp_path: Path, monkeypatch, capsys) -> None:
    """Catches an extension that needs more than its own file: presets, layouts, registries; a file
    that some command, or a worker process, does not know; a map of its field that can be read only
    where it was made, or not be corrected, and a command that does not make a run again."""
    assert OWN.count("\n") <= 40
    (tmp_path / "own").mkdir()
    (tmp_path / "own/my-method.py").write_text("from helper import *\n" + OWN)
    (tmp_path / "own/helper.py").write_text("")
    own, far = ["--import", "own/my-method.py"], tmp_path / "own"
    words = tiny_words(
        "scenes.n_frames=3", "tables.rates_hz=[10]", "tracking.distance.n_pixels=8",
        "mapping.fading.iterations=6", "mapping.fading.n_rays=8", "mapping.fading.decay=0.1",
    )  # fmt: skip
    grid = ["--method", "mine,fine", "--workers", "2", "--scenes", "office,bedroom", "--out", "out"]
    monkeypatch.chdir(tmp_path)
    with importing(), forking():
        assert main(["tables", *own, *grid, *words]) == 0
    assert (tmp_path / "out/table_1.csv").read_text().count("Mine") == 4
    assert "DISTANCE,8," in (tmp_path / "out/table_2.csv").read_text()
    (made,) = (tmp_path / "runs/maps").glob("office-fading-corrected-*")
    run = ["track", "office", "--map-from", str(made), "--steps", "1", "--out", "run", *words]
    assert "--import" in assert_refused(tmp_path, capsys, run, "'fading', which is not registered")
    with importing():
        assert main([*run, "--tracker", "distance", *own]) == 0
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert f"--import={far / 'my-method.py'}" in metrics["command"]
    monkeypatch.chdir(far)
    monkeypatch.syspath_prepend(far)  # as for `python -m nbtrack`
    with importing():
        assert main(["export", str(made), "--to", "ply", "room.ply", "--import", "my-method"]) == 0


NOT_IMPORTED = [
    ("own.py", None, "no file"),
    ("own.py", "x = 1\n1 / 0\n", "own.py, line 2 (ZeroDivisionError: division by zero)"),
    ("own.py", "x = (\n", "own.py, line 1"),
    ("own.py", "import sys\nsys.exit(0)\n", "own.py, line 2 (SystemExit"),
    ("nbtrack_nowhere", None, "No module named 'nbtrack_nowhere'"),
    ("json.py", "", "rename"),
]


@pytest.mark.parametrize(("name", "text", "says"), NOT_IMPORTED)
def test_a_file_that_cannot_be_imported(
    name: str, text: str | None, says: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    """Catches a traceback, an error that does not say where the file is wrong, and a file that is
    passed over in silence for a module of its name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "own", raising=False)
    if text is not None:
        Path(name).write_text(text)
    assert_refused(tmp_path, capsys, ["methods", "--import", name], says)


def test_settings_of_own_classes_whenever_they_are_registered(monkeypatch) -> None:
    """Catches other settings of one class in a file, in a notebook and in an installed package: its
    own defaults, with what smoke changes in NeuS or SDF, and without a user's values of those; and
    a class written anew, as a cell run again does, that loses what was chosen for it."""

    def made(base: type, **defaults: object) -> type:
        fields = [(name, type(value), value) for name, value in defaults.items()]
        return make_dataclass("Own", fields, bases=(base,), frozen=True)

    Network, Mapping = made(object, width=48), made(NeusMapping, n_surface=5)
    Tracking = made(TRACKERS["sdf"].Settings, motion_model="constant_velocity")

    def register() -> None:
        field = {"name": "mine", "Network": Network, "Settings": Mapping}
        tracker = {"name": "mine", "Settings": Tracking}
        monkeypatch.setitem(FIELDS, "mine", type("Mine", (FIELDS["neus"],), field))
        monkeypatch.setitem(TRACKERS, "mine", type("Mine", (TRACKERS["sdf"],), tracker))

    chosen = ["mapping.neus.iterations=7", "network.neus.width=33", "tracking.sdf.lambda_sdf=3.0"]
    preset = load_preset("smoke", settings=chosen)
    register()
    mapping, tracking = preset.mapping_of("mine"), preset.tracking_of("mine")
    assert (mapping.iterations, mapping.n_rays, mapping.n_surface) == (2400, 96, 5)
    assert preset.network_of("mine").width == 96
    assert (tracking.n_pixels, tracking.lambda_sdf) == (512, 1.0)
    assert tracking.motion_model == "constant_velocity"
    preset = with_settings(preset, "tracking.mine.n_pixels=7")
    register()
    again = with_settings(preset, "tracking.mine.lambda_sdf=2.0").tracking_of("mine")
    assert (again.n_pixels, again.lambda_sdf) == (7, 2.0)


NOTHING, NAME = type("Mine", (), {}), {"name": "mine"}
NAMED = type("Mine", (nbtrack.LearnedField,), NAME)
OF_NO_KIND = {**NAME, "label": "Blank", "surface_level": 0.0, "is_distance": False, "forward": len}


LACKING = [
    (FIELDS, NOTHING, "'mine' lacks name"),
    (TRACKERS, NOTHING, "'mine' lacks name"),
    (FIELDS, FIELDS["neus"], "calls itself 'neus'"),  # its map would be read as its base's
    (FIELDS, NAMED, "'mine' lacks label, forward, mapping_losses, weights: give them to"),
    (FIELDS, type("Mine", (nbtrack.Field,), OF_NO_KIND), "no tracker works on field 'mine'"),
]


@pytest.mark.parametrize(("known", "kind", "says"), LACKING)
def test_classes_that_lack_something(known, kind: type, says: str, monkeypatch) -> None:
    """Catches an AttributeError in the middle of a command, and a StopIteration where no tracker of
    the package's works in an own field."""
    monkeypatch.setitem(known, "mine", kind)
    with pytest.raises(ConfigError, match=says):
        tracker_class("mine") if known is TRACKERS else method_of(None, "mine", None)


def test_a_place_too_large_for_a_correction() -> None:
    """Catches a refusal after minutes of mapping, and one that names no setting."""
    preset = load_preset(settings=[*TINY, "correction.neus_plus=0.001"])
    with pytest.raises(ConfigError, match=r"correction.neus_plus is 0.001 m.* set correction.neus"):
        nbtrack.map_scene(nbtrack.open_scenes(preset)[0], "neus_plus", preset)
    assert not [*(runs_folder() / "maps").glob("*/map*")]


NO_TERMS = [
    (lambda terms: sum(terms.values()), "mapping_losses of mine"),
    (lambda terms: {"color": terms["color"]}, "gave color after depth, color, eikonal: give"),
]


@pytest.mark.parametrize(("last", "says"), NO_TERMS)
def test_losses_that_are_no_terms(last, says: str, monkeypatch) -> None:
    """Catches torch's words about sizes or sparse tensors where a field returns the sum of its
    terms, or a term only now and then."""
    spoilt = iter([dict, dict, last])

    class Mine(FIELDS["neus"]):
        name = "mine"

        def mapping_losses(self, *arguments):
            return next(spoilt)(super().mapping_losses(*arguments))

    monkeypatch.setitem(FIELDS, "mine", Mine)
    with pytest.raises(ConfigError, match=says):
        map_sequence("mine", wall_sequence(), NETWORK, settings_of("neus"))


DOORS = """
import sys
from nbtrack import FIELDS, METHODS, Frame, make_tracker, read_sequence
assert {*FIELDS} > {"neus", "neus_plus"} and {*METHODS} > {"sdf", "corrected"}
assert not {"numba", "skimage", "nbtrack.experiments"} & {*sys.modules}
from nbtrack.mapping.files import read_map
print(read_map(sys.argv[1]).key)
"""


def test_what_the_doors_load(tmp_path: Path) -> None:
    """Catches a single frame or the paper's part that loads numba, and a corrected map that only a
    program which has imported all of the package can read."""
    corrected = correct_map(finished_wall(), wall_sequence(), 0.2)
    write_map(tmp_path / MAP_FILE, corrected)
    command = [sys.executable, "-c", DOORS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == (f"{corrected.key}\n", "")


def test_an_entry_as_a_text(monkeypatch) -> None:
    """Catches a class of a user's that cannot be named as entry points are, and a traceback where
    the name is wrong."""
    monkeypatch.setitem(FIELDS, "neus", "nbtrack.fields.neus:NeuSField")
    assert field_class("neus").name == "neus"
    monkeypatch.setitem(FIELDS, "neus", "nbtrack.fields.neus:NeusField")
    with pytest.raises(ConfigError, match="'neus' cannot be loaded from nbtrack"):
        field_class("neus")
