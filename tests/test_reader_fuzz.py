"""Texts of every format with anything in them: what is wrong is reported, nothing else is raised.

What can be read is also checked now and then: absurd numbers must not break the check either.

`NBTRACK_FUZZ_EXAMPLES` sets how many are tried (default 100).
"""

import os
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hypothesis")
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recordings import WRITERS, source, write_recording

from nbtrack.checks.check import check_recording
from nbtrack.machinery.errors import NbtrackError
from nbtrack.recordings.reading import read_sequence
from nbtrack.recordings.recording import open_recording

EXAMPLES = int(os.environ.get("NBTRACK_FUZZ_EXAMPLES", "100"))
WORDS = (
    "nan", "inf", "-inf", "1e400", "-1e308", "1e200", "1e7", "-0.5", "[" * 100_000,
    "1e-320", "0", "-0", "1", "1_0", "0x1p3", "٣", "½", "true", "null", "NaN", "1" * 400,
    "a" * 5000, "\0", "#", ",", '"', "{", "=", "..", "/", "rgb", "\ufeff", "\u2028", "wxyz",
    "plain", "depth_scale", "[x]", "-5", "1e9", "[]", '"ray"', '"up up up"', '"tum"', "1979-05-27",
)  # fmt: skip
DECLARED = """format = "plain"
depth_scale = 1000
no_depth = 65535
depth_along = "axis"
camera_axes = "right up forward"
poses = "world-to-camera"
quaternion = "wxyz"
frame_rate = 10
"""


@cache
def recording(format: str, base: Path) -> tuple[Path, list[Path]]:
    """Its folder, and its texts."""
    folder = write_recording(format, base / format / "r", source(n_frames=2))
    images = (".png", ".jpg", ".depth")
    texts = [path for path in folder.parent.rglob("*") if path.suffix not in ("", *images)]
    return folder, [*sorted(texts), folder / "metadata", folder / "sequence.toml"]


@st.composite
def changed(draw: Callable, original: bytes) -> bytes:
    """A text that is nearly right: words replaced, lines dropped, doubled, cut or joined."""
    lines = original.decode().splitlines()
    for _ in range(draw(st.integers(1, 4)) if lines else 0):
        number = draw(st.integers(0, len(lines) - 1))
        line = lines[number]
        # Mostly a number: what surrounds it decides little.
        spans = [match.span() for match in re.finditer(r"-?[\d.e+-]+|\S+", line)]
        start, stop = draw(st.sampled_from(spans or [(0, 0)]))
        any_word = st.sampled_from(WORDS)
        word = draw(any_word | any_word | any_word | st.text(max_size=8) | st.floats().map(str))
        replaced, cut = [line[:start] + word + line[stop:]], [line[:start]]
        others = ([], [line, line], cut, [f"{line} {lines[0]}"])
        lines[number : number + 1] = draw(st.sampled_from((replaced,) * 6 + others))
        lines = lines or [""]
    end = draw(st.sampled_from(("\n", "\r\n", "\r", "\n\n")))
    return end.join(lines).encode("utf-8", "surrogatepass")


@settings(
    max_examples=EXAMPLES, deadline=None, derandomize=EXAMPLES <= 100, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@given(data=st.data())
def test_only_our_own_errors(tmp_path_factory, data) -> None:
    """Catches any other exception or warning, and poses or pixels that are no numbers."""
    format = data.draw(st.sampled_from([*WRITERS]))
    folder, texts = recording(format, tmp_path_factory.getbasetemp() / "fuzz")
    path = data.draw(st.sampled_from(texts))
    original = path.read_bytes() if path.is_file() else None
    anything = st.binary(max_size=200), st.text(max_size=200).map(str.encode)
    nearly = changed(original or (DECLARED if path.suffix == ".toml" else "1 2 3 4").encode())
    path.write_bytes(data.draw(st.one_of(*anything, nearly, nearly, nearly)))
    message = "nothing wrong"
    try:
        sequence = read_sequence(folder, slice(0, 1), format=format)
        assert np.isfinite(sequence.T_world_camera).all()
        assert np.isfinite([sequence.intrinsics.fx, sequence.intrinsics.cx]).all()
        if data.draw(st.integers(0, 19)) == 0:
            str(check_recording(open_recording(folder, format)))
    except NbtrackError as error:
        message = str(error)
    finally:
        path.unlink()
        if original is not None:
            path.write_bytes(original)
    assert 0 < len(message) < 1000
