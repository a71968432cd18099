"""Adding a field or a tracker: one short file that registers it, and it has rows in the tables."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny import tiny_words

from nbtrack.cli import main
from nbtrack.experiments.methods import METHODS
from nbtrack.fields import FIELDS
from nbtrack.tracking import TRACKERS

OWN = '''
"""A field whose distances fade, and a tracker that only looks at distances."""

from dataclasses import dataclass

import nbtrack
from nbtrack.core.geometry import transform_points
from nbtrack.fields import FIELDS, NeuSField, NeusMapping
from nbtrack.tracking import TRACKERS, AdamTracker


@dataclass(frozen=True)
class FadingMapping(NeusMapping):
    decay: float = 0.5


class FadingField(NeuSField):
    name, label, Settings = "fading", "Fading NeuS", FadingMapping

    def mapping_losses(self, batch, settings, generator):
        losses = super().mapping_losses(batch, settings, generator)
        return {name: settings.decay * loss for name, loss in losses.items()}


class DistanceTracker(AdamTracker):
    name = "distance"

    def loss(self, T_world_camera, directions_camera, color, depth):
        points_camera = directions_camera * depth[:, None]
        return self.field(transform_points(T_world_camera, points_camera))[1].square().mean()


FIELDS["fading"] = FadingField
TRACKERS["distance"] = DistanceTracker
nbtrack.METHODS["mine"] = nbtrack.Method("Mine", "fading", "distance")
'''


@pytest.fixture
def own_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The file, imported as any other; what it adds is taken away afterwards."""
    (tmp_path / "own_method.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("own_method")
    yield
    del FIELDS["fading"], TRACKERS["distance"], METHODS["mine"], sys.modules["own_method"]


def test_a_row_in_both_tables(own_file: None, tmp_path: Path) -> None:
    """Catches an extension that needs more than its own file: presets, layouts, registries."""
    assert OWN.count("\n") <= 40
    words = tiny_words(
        "tables.rates_hz=[10]", "tracking.distance.n_pixels=8", "mapping.fading.decay=0.1",
        "mapping.fading.iterations=6", "mapping.fading.n_rays=8",
    )  # fmt: skip
    words += ["--scenes", "office", "--workers", "1", "--out", str(tmp_path / "out")]
    assert main(["tables", "--method", "sdf,mine", *words]) == 0
    assert (tmp_path / "out/table_1.csv").read_text().count("Mine,office") == 1
    assert "DISTANCE,8," in (tmp_path / "out/table_2.csv").read_text()
