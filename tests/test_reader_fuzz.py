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
TEXTS = {
    "neural_rgbd": ("poses.txt", "focal.txt", "intrinsics.txt"),
    "tum": ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "sequence.toml"),
    "replica": ("traj.txt", "../cam_params.json"),
    "7scenes": ("frame-000000.pose.txt",),
    "scannet": ("pose/0.txt", "intrinsic/intrinsic_depth.txt"),
    "plain": ("trajectory.txt", "intrinsics.json", "sequence.toml"),
}
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
def recordings(base: Path) -> dict[str, Path]:
    few = source(n_frames=2)
    return {format: write_recording(format, base / format / "r", few) for format in WRITERS}


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
    format = data.draw(st.sampled_from(list(TEXTS)))
    folder = recordings(tmp_path_factory.getbasetemp() / "fuzz")[format]
    path = folder / data.draw(st.sampled_from(TEXTS[format]))
    original = path.read_bytes() if path.is_file() else None
    strategies = [st.binary(max_size=200), st.text(max_size=200).map(lambda t: t.encode("utf-8"))]
    usual = DECLARED.encode() if path.suffix == ".toml" else b"1 2 3 4"
    strategies.append(changed(original or usual))
    path.write_bytes(data.draw(st.one_of(*strategies, strategies[-1], strategies[-1])))
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
