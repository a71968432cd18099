"""Keys follow the code: what changes a result changes its key, what does not leaves it alone."""

from pathlib import Path

import pytest

from nbtrack.core import provenance
from nbtrack.core.provenance import code_fingerprint, versions
from nbtrack.tracking.sequence import track_sequence
from nbtrack.tracking.trackers import TRACKERS


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A function that pretends that a module's source reads otherwise."""
    original = provenance._file_of

    def change(module: str, old: str, new: str) -> None:
        text = original(module).read_text(encoding="utf-8")
        assert old in text
        path = tmp_path / f"{module}.py"
        path.write_text(text.replace(old, new), encoding="utf-8")
        monkeypatch.setattr(provenance, "_file_of", lambda m: path if m == module else original(m))
        provenance._modules_fingerprint.cache_clear()

    provenance._modules_fingerprint.cache_clear()
    yield change
    provenance._modules_fingerprint.cache_clear()


def keys() -> tuple[str, str]:
    """Of runs with both trackers of the paper."""
    return tuple(code_fingerprint(track_sequence, TRACKERS[name]) for name in ("vr", "sdf"))


def test_a_changed_tracker_is_computed_again(changed) -> None:
    """Catches a researcher's edited loss that is answered with the old, cached result."""
    vr, sdf = keys()
    changed("nbtrack.tracking.trackers.sdf", "field_sdf.abs().mean()", "field_sdf.square().mean()")
    assert keys()[1] != sdf
    assert keys()[0] == vr


def test_a_module_behind_an_import_counts(changed) -> None:
    """Catches imports that are not followed: rendering is three imports away from tracking."""
    before = keys()
    changed("nbtrack.fields.rendering", "weights", "wights")
    assert keys()[0] != before[0]


def test_words_do_not_count(changed) -> None:
    """Catches days of results thrown away for a comment or a docstring."""
    before = keys()
    changed("nbtrack.tracking.trackers.sdf", "Paper, Sec. II-B.2.", "See the paper.  # and more")
    assert keys() == before


def test_modules_that_only_tell_do_not_count(changed) -> None:
    """Catches results thrown away for the wording of an error."""
    before = keys()
    changed("nbtrack.core.errors", "did you mean", "perhaps")
    assert keys() == before


def test_versions_name_what_results_depend_on() -> None:
    """Catches results that do not tell the torch they were made with."""
    assert set(versions()) == {"nbtrack", "torch", "python"}
