"""Small misfits of recordings: each must be told with its size, and none where there is none."""

import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import (
    Change,
    Source,
    camera,
    color,
    depth,
    positions,
    real,
    source,
    with_noise,
    write_matrices,
)

from nbtrack.checks.check import check_recording
from nbtrack.recordings.recording import open_recording

REAL = ["real_room", "real_office"]
ROOMS = ["living_room", "office", "gallery", "grey_studio"]
N_FRAMES = 120


def warnings_of(folder: Path, data: Source) -> list[str]:
    return check_recording(open_recording(write_matrices(folder, data))).warnings


@cache
def room(name: str) -> Source:
    return with_noise(source(name, N_FRAMES, 1))


@cache
def recorded(name: str) -> Source:
    """A room, or a real recording at half its size, without which the test is skipped."""
    return real(name, slice(N_FRAMES), 2) if name in REAL else room(name)


def late(images: np.ndarray, n_frames: int) -> np.ndarray:
    """Each as so many frames earlier."""
    return images[(np.arange(len(images)) - n_frames).clip(0, len(images) - 1)]


def line(n: int) -> np.ndarray:
    return np.linspace(0, 1, n)[:, None]


def noise(t: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=0.01, size=t.shape)


def five_times(images: np.ndarray) -> np.ndarray:
    return images[np.arange(len(images)) // 5 * 5]


def saturated(depths: np.ndarray) -> np.ndarray:
    depths = depths.copy()
    depths[:, : depths.shape[1] // 5, depths.shape[2] // 3 : 2 * depths.shape[2] // 3] = 65535
    return depths


def of_elsewhere(colors: np.ndarray) -> np.ndarray:
    others = np.resize(room("gallery").colors, (len(colors), *room("gallery").colors.shape[1:]))
    return np.stack([cv2.resize(image, colors.shape[2:0:-1]) for image in others])


# What is said begins so; of numbers in braces the first must be as near as the second says.
CASES: dict[str, tuple[Change, str, float, float]] = {
    "depth one frame late": (depth(lambda d: late(d, 1)), "depth comes after", 1, 0.2),
    "poses one frame late": (
        lambda data: data._replace(poses=late(data.poses, 1)), "depth comes after", -1, 0.2
    ),
    "focal length 5 % short": (camera(0.95), "focal lengths should change", 5.26, 0.7),
    "depth 5 % long": (depth(lambda d: 1.05 * d), "depths should change", -4.76, 1),
    "depth growing by 4 %": (
        depth(lambda d: d * (1 + 0.04 * line(len(d))[..., None])), "depths grow", 4, 1.2
    ),
    "positions times 0.9": (positions(lambda t: 0.9 * t), "depths should change", -10, 1),
    "positions off by 1 cm": (positions(lambda t: t + noise(t)), "positions scatter", 0.016, 0.003),
    "one pose off by 20 cm": (
        positions(lambda t: t + 0.2 * (np.arange(len(t)) == 60)[:, None] * [1, 0, 0]),
        "1 of .* poses lie up to", 20, 2,
    ),
    "poses drifting by 30 cm": (
        positions(lambda t: t + 0.3 * line(len(t)) * [0, 1, 0]), "poses drift along y", 0.3, 0.05
    ),
    "every image five times": (
        lambda d: d._replace(colors=five_times(d.colors), depths_mm=five_times(d.depths_mm)),
        "", 80, 1,
    ),
    "depth in steps of 64 mm": (depth(lambda d: d // 64 * 64), "depths come in steps of", 6.4, 0),
    "positions in kilometres": (
        positions(lambda t: t / 1000), "your poses look like ones in kilometres; mul.* by", 1000, 0
    ),
    "black colours": (color(lambda c: 0 * c), "the colour images are black", 0, 0),
    "mirrored colours": (color(lambda c: c[:, :, ::-1]), "colours alone are mirrored: yes", 0, 0),
    "colours 4 % to the right": (
        color(lambda c: np.roll(c, round(c.shape[2] / 25), 2)), "colours lie too far right", 4, 1
    ),
    "colours three frames late": (color(lambda c: late(c, 3)), "colours come after depth", 3, 0.2),
    "colours of elsewhere": (color(of_elsewhere), "colours do not belong to the depth", 0, 0),
}  # fmt: skip
SILENT = {
    "right": lambda data: data,
    "saturated depth": depth(saturated),
    "red for blue": color(lambda c: c[..., ::-1].copy()),  # which no pair of frames can tell
}
SOME = (
    "depth one frame late", "focal length 5 % short", "depth 5 % long", "positions off by 1 cm",
    "mirrored colours", "colours three frames late", "colours of elsewhere",
)  # fmt: skip


@pytest.mark.parametrize("name", ["living_room", "office", *REAL])
def test_each_is_told_with_its_size(tmp_path: Path, name: str) -> None:
    """Catches misfits that pass without a word, that are taken for others, and wrong sizes; of some
    also in other places, so that none is told in one synthetic room alone."""
    wrong = {}
    for number, case in enumerate(CASES if name == "living_room" else SOME):
        change, says, size, within = CASES[case]
        first = (*warnings_of(tmp_path / str(number), change(recorded(name))), "nothing")[0]
        found = re.match(rf"{says}[^-+\d]*([-+]?[\d.]+\d|\d)?", first)
        if not found or (size and not abs(float(found[1]) - size) <= within):
            wrong[case] = first
    assert wrong == {}


@pytest.mark.parametrize("name", [*ROOMS, *REAL])
def test_nothing_is_told_of_right_recordings(tmp_path: Path, name: str) -> None:
    """Catches false alarms, of real noise, exposure and calibration too: the bar is none, but that
    a room may not prove its pose file."""
    for case in SILENT if name in ("living_room", "real_room") else ["right"]:
        said = warnings_of(tmp_path / case, SILENT[case](recorded(name)))
        assert [text for text in said if name in REAL or "is not proved" not in text] == []
