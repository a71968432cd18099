"""Small misfits of recordings: each must be told with its size, and none where there is none."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recordings import camera, depth, positions, real, short, source, with_noise, write_matrices
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from nbtrack.checks.check import DataReport, check_recording, quick_look
from nbtrack.checks.readings import cost_of
from nbtrack.recordings.recording import open_recording

REAL = ["real_room", "real_office"]
N_FRAMES = 120


def warnings_of(folder: Path, data) -> list[str]:
    return check_recording(open_recording(write_matrices(folder, data))).warnings


@cache
def recorded(name: str):
    """A room, or a real recording at half its size, without which the test is skipped."""
    if name in REAL:
        return real(name, slice(N_FRAMES), 2)
    return with_noise(source(name, N_FRAMES, 1))


def late(images: np.ndarray, n_frames: int) -> np.ndarray:
    """Each as so many frames earlier."""
    return images[(np.arange(len(images)) - n_frames).clip(0, len(images) - 1)]


def drifting(t: np.ndarray) -> np.ndarray:
    return t + np.linspace(0, 0.5, len(t))[:, None] * [0, 1, 0]


def saturated(depths: np.ndarray) -> np.ndarray:
    depths = depths.copy()
    depths[:, : depths.shape[1] // 5, depths.shape[2] // 3 : 2 * depths.shape[2] // 3] = 65535
    return depths


def cropped(data):
    """Columns and rows off the left and the top, the camera as it was for the whole image."""
    left, top = data.camera.width // 12, data.camera.height // 16
    size = {"width": data.camera.width - left, "height": data.camera.height - top}
    images = {"colors": data.colors[:, top:, left:], "depths_mm": data.depths_mm[:, top:, left:]}
    return data._replace(**images, camera=replace(data.camera, **size))


def beside(*metres: float):
    """Poses of a marker from where the camera is so far to the right, below and before."""
    T_marker_camera = np.eye(4)
    T_marker_camera[:3, 3] = metres
    return lambda data: data._replace(poses=data.poses @ np.linalg.inv(T_marker_camera))


def fill(value: int, share: float):
    """The farthest so many of the depths as a value that means none."""
    return depth(lambda d: np.where(d > np.quantile(d[d > 0], 1 - share), value, d))


def two_values(depths: np.ndarray) -> np.ndarray:
    depths = depths.copy()
    depths[:, :, :8], depths[:, :, -8:] = 1, 10000
    return depths


def halfway(data):
    """Poses of two frames and a half later."""
    numbers = np.arange(len(data.poses))
    later, poses = (numbers + 2.5).clip(0, numbers[-1]), data.poses.copy()
    poses[:, :3, :3] = Slerp(numbers, Rotation.from_matrix(poses[:, :3, :3]))(later).as_matrix()
    poses[:, :3, 3] = interp1d(numbers, poses[:, :3, 3], axis=0)(later)
    return data._replace(poses=poses)


def in_steps(data):
    return camera(0.95)(depth(lambda d: d // 50 * 50)(data))


def of_disparity(depths: np.ndarray) -> np.ndarray:
    return np.where(depths > 0, 1.7e6 / np.maximum(depths, 100), 0)


UNTOLD = "surfaces that two frames see lie .* nothing that is tried explains it"
# What is said begins so; of numbers in braces the first must be as near as the second says.
CASES = {
    "depth one frame late": (depth(lambda d: late(d, 1)), "depth comes after", 1, 0.2),
    "focal length 5 % short": (camera(0.95), ".*focal lengths should change", 5.26, 0.7),
    "camera of another": (camera(1.15, 1.06), "the calibration is another camera's", -13, 1),
    "images cropped": (cropped, "the principal point should move", -9.1, 0.5),
    "camera beside a marker": (beside(0.1, 0, 0), "the camera lies beside .* of, x", 0.1, 0.02),
    "depth 5 % long": (depth(lambda d: 1.05 * d), "depths should change", -4.76, 1),
    "a quadratic error": (short(0.008), "depths are short by a quadratic", 0.008, 0.002),
    "depth 8 cm long": (depth(lambda d: d + 80 * (d > 0)), "depths are short by", -0.08, 0.015),
    "none is 10000": (fill(10000, 0.3), "30% of the depths are 10000.*no_depth =", 10000, 0),
    "none is 1 or 10000": (depth(two_values), ".* are 1 or 10000.*no_depth = .1, 10000", 0, 0),
    "two poses and a half late": (halfway, "depth comes after", 2.5, 0.3),
    "positions of another scale": (positions(lambda t: 0.4 * t), "depths should change", -60, 1),
    "steps of 10 cm": (depth(lambda d: d // 100 * 100), "depths come in steps of", 10, 0),
    "focal, in steps": (in_steps, "focal lengths should", 5.26, 0.7),
    "disparity": (depth(of_disparity), UNTOLD, 0, 0),
    "poses drifting by 50 cm": (positions(drifting), UNTOLD, 0, 0),
}  # fmt: skip
SILENT = {"right": lambda data: data, "saturated depth": depth(saturated)}
SOME = ("focal length 5 % short", "images cropped", "disparity")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["living_room", "real_room"])
def test_each_is_told_with_its_size(tmp_path: Path, name: str) -> None:
    """Catches misfits that pass without a word, that are taken for others, and wrong sizes; of some
    also in another place, so that none is told in one synthetic room alone. What is not among the
    causes must have none of their names."""
    wrong = {}
    for number, case in enumerate(CASES if name == "living_room" else SOME):
        change, says, size, within = CASES[case]
        first = (*warnings_of(tmp_path / str(number), change(recorded(name))), "nothing")[0]
        found = re.match(rf"{says}[^-+\d]*([-+]?[\d.]+\d|\d)?", first)
        if not found or (size and not abs(float(found[1]) - size) <= within):
            wrong[case] = first
    assert wrong == {}


@pytest.mark.parametrize("name", ["living_room", "office", *REAL])
def test_nothing_is_told_of_right_recordings(tmp_path: Path, name: str) -> None:
    """Catches false alarms, of real noise, exposure and calibration too: the bar is none, but that
    a room may not prove its pose file."""
    for case in SILENT if name in ("living_room", "real_room") else ["right"]:
        said = warnings_of(tmp_path / case, SILENT[case](recorded(name)))
        assert [text for text in said if name in REAL or "is not proved" not in text] == []


def test_a_usual_sensors_error_is_noted_and_is_no_fault(tmp_path: Path) -> None:
    """Catches a dataset that nobody can check, as its depth has a structured light's quadratic
    error; a warning of that before each run; an estimate of another error than the one that
    `depth_error_per_m` takes away; and an interval that is too narrow."""
    b, data = 0.0025, source("office", N_FRAMES, 1)
    noise_mm = np.random.default_rng(0).normal(scale=4, size=data.depths_mm.shape)
    noisy = depth(lambda d: np.where(d > 0, d + noise_mm, 0))(short(b)(data))
    folder = write_matrices(tmp_path / "r", noisy)
    report, quickly = check_recording(open_recording(folder)), quick_look(open_recording(folder))
    assert report.verdict == "read rightly"
    assert re.match("note: .* depth_error_per_m = 0.00", quickly)
    assert "depth_error_per_m = 0.00" in report.remarks[0]
    low, high = interval(report)
    assert low < b < high < 2 * b
    (folder / "sequence.toml").write_text(f"depth_error_per_m = {b}\n")
    low, high = interval(check_recording(open_recording(folder)))
    assert low < 0 < high


def interval(report: DataReport) -> tuple[float, float]:
    """That of the quadratic error that is left."""
    (found,) = (m for m in report.misfits if "depth_error_per_m" in m.numbers)
    return found.numbers["depth_error_per_m"][1:]


@pytest.mark.parametrize(("n_frames", "stride"), [(24, 6), (40, 10)])
def test_late_depth_of_a_fast_camera_is_told(tmp_path: Path, n_frames: int, stride: int) -> None:
    """Catches a large misfit that is not looked for in few frames, and a cause that explains all,
    but for which numbers of other causes leave a smaller share of nearly nothing."""
    data = depth(lambda d: late(d, 1))(source("living_room", n_frames, stride))
    (said,) = warnings_of(tmp_path / "r", data)
    assert said.startswith("depth comes after the poses by +1.0 ")


def test_no_fit_ends_where_nothing_is_known() -> None:
    """Catches a fit that ends where the two images of a pair share nothing, as if all were well."""
    assert cost_of(np.full((2, 3), np.nan)) > cost_of(np.full((2, 3), 0.5))
