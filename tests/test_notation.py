"""The glossary: what it names is there."""

import pydoc
import re
from pathlib import Path

import pytest

from nbtrack.experiments.presets import load_preset
from nbtrack.fields import NetworkSettings
from nbtrack.tracking.budget import paper_steps

TEXT = Path(__file__).parents[1].joinpath("docs/notation.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`(nbtrack\.[\w.]+)`", TEXT)))


@pytest.mark.parametrize("name", NAMES)
def test_names_exist(name: str) -> None:
    """Catches a name that was renamed in the code and not in the glossary."""
    found = pydoc.locate(name)
    assert found is not None
    assert found.__doc__


def test_sizes_are_those_of_the_preset() -> None:
    """Catches sizes that changed in the preset and not in the glossary."""
    preset = load_preset("smoke")
    width, pixels = preset.scenes.width, [preset.tracking_of(t).n_pixels for t in ("vr", "sdf")]
    paper = load_preset("paper")
    assert f"| images | 640×480 | {width}×{width * 3 // 4} |" in TEXT
    layers = NetworkSettings().width, preset.network_of("imap").width
    assert "| network | 4 layers of {} | 4 layers of {} |".format(*layers) in TEXT
    of_paper = [f"{paper.tracking_of(t).n_pixels:,}" for t in ("vr", "sdf")]
    row = f"| pixels a step, VR and SDF | {', '.join(of_paper)} | {pixels[0]}, {pixels[1]} |"
    assert row in TEXT
    for tracker in ("vr", "sdf"):
        steps = ", ".join(f"{paper_steps(tracker, rate):.1f}" for rate in (10, 5, 2))
        assert f"{tracker.upper()} | {steps} |" in TEXT
