"""The unit of the learning rates, how far steps reach, and what that bounds."""

from pathlib import Path

import numpy as np
import pytest
from box_room import poses_at
from numpy.testing import assert_allclose

from nbtrack import load_preset, read_sequence
from nbtrack.data.dataset import DATASET_UNITS
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.map_jobs import MapJob
from nbtrack.experiments.scenes import Scene, open_scene
from nbtrack.experiments.track_jobs import TrackJob, reach_warnings
from nbtrack.synthetic import make_room
from nbtrack.tracking import SdfSettings
from nbtrack.tracking.reach import (
    Reach,
    greedy_ate,
    greedy_follower,
    motion_of,
    reach,
    reach_metrics,
)


def straight(speed_m: float) -> np.ndarray:
    """Eleven poses that move evenly along x."""
    return poses_at(np.outer(speed_m * np.arange(11), [1, 0, 0]))


def test_units_of_the_dataset(tmp_path: Path, monkeypatch) -> None:
    """Catches a scene of the dataset in another unit than its authors', where a data manager keeps
    it under a digest too, by path, by scene name and in the folder; and one that a user cannot
    change. Other folders have the unit of their map."""
    for name in ("3f9a81c0", "my_kitchen"):
        make_room("office", tmp_path / name, 2, 16, 12)
    (tmp_path / "kitchen").symlink_to(tmp_path / "3f9a81c0")
    monkeypatch.setenv("NBTRACK_DATA", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for given in (tmp_path / "kitchen", "kitchen", "./kitchen", "kitchen/../kitchen"):
        scene = open_scene(given, load_preset("paper"))
        assert scene.name == scene.recording.name == "kitchen"
        assert scene.recording.declared.metres_per_unit == DATASET_UNITS["kitchen"] == 4.0
    assert observed_bounds(read_sequence("kitchen")).metres_per_unit == 4.0
    (tmp_path / "kitchen" / "sequence.toml").write_text("metres_per_unit = 3.0")
    assert observed_bounds(read_sequence("kitchen")).metres_per_unit == 3.0
    bounds = observed_bounds(read_sequence(tmp_path / "my_kitchen"))
    assert bounds.metres_per_unit == np.subtract(bounds.maximum, bounds.minimum).max() / 2


def test_reach_by_hand() -> None:
    """Catches steps or rates that count twice, and a quaternion's half angle that is forgotten."""
    assert reach(6.8, 5e-4) == pytest.approx(3.4e-3)
    of_frame = SdfSettings().reach(10, metres_per_unit=2.0)
    assert of_frame.position == pytest.approx(10e-3)
    assert of_frame.orientation == pytest.approx(20e-3)


def test_the_greedy_follower_by_hand() -> None:
    """Catches a follower that overshoots, cuts a corner or looks at the wrong axis: with 2 mm of
    reach for 3 mm of motion it falls behind by 1 mm a frame; with 3 mm it never does."""
    path = straight(0.003)
    assert_allclose(greedy_follower(path, 0.002)[:, 0, 3], 0.002 * np.arange(11), atol=1e-12)
    behind = 1e-3 * np.arange(1, 11)
    assert greedy_ate(path, 0.002) == pytest.approx(np.sqrt(np.mean(behind**2)))
    assert greedy_ate(path, 0.0031) == 0.0
    diagonal = path.copy()
    diagonal[:, 2, 3] = -path[:, 0, 3]  # each axis has a reach of its own, both ways
    assert greedy_ate(diagonal, 0.002) == pytest.approx(np.sqrt(2 * np.mean(behind**2)))


def test_motion_and_metrics_by_hand() -> None:
    """Catches a motion from another start than the tracker's, degrees for radians, and motion one
    way alone."""
    path = straight(0.003)
    path[1, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    offsets, turns = motion_of(path)
    assert_allclose(offsets[:, 0], 0.003)
    assert_allclose(turns[0], [0, 0, np.pi / 2])
    one = SdfSettings().reach(4, 1.0)  # 2 mm and 0.46 degrees
    metrics = reach_metrics(one, straight(-0.003), "previous_pose")
    assert metrics["beyond_reach_share"] == 1.0
    assert metrics["reach_deg"] == pytest.approx(0.458, abs=1e-3)
    moved = reach_metrics(one, straight(0.003), "constant_velocity")
    assert moved["beyond_reach_share"] == pytest.approx(0.1)  # the first frame has no velocity
    assert reach_metrics(None, path, "previous_pose") == {}
    path[3] = np.nan
    assert "greedy_ate_m" not in reach_metrics(one, path, "previous_pose")


@pytest.mark.parametrize("way", [-1, 1])
def test_a_turn_asks_for_reach_too(way: int) -> None:
    """Catches degrees for radians, a turn that needs a motion besides, turns one way alone, and a
    turn that counts in other frames: the camera turns in every second one."""
    path = poses_at(np.zeros((11, 3)), np.outer(np.arange(11) // 2, [0.0, way * 0.01, 0.0]))
    for reach_rad, share in ((0.011, 0.0), (0.009, 0.5)):
        metrics = reach_metrics(Reach(0.001, reach_rad), path, "previous_pose")
        assert metrics["beyond_reach_share"] == share
        assert metrics["greedy_ate_m"] == pytest.approx(0.0)


def test_the_nearer_of_two_starts_is_taken() -> None:
    """Catches the farther one: of a camera that starts and stops, each start fits some frames."""
    path = poses_at(np.outer([0, 0, 1, 2, 2, 2], [0.01, 0.0, 0.0]))
    found = [motion_of(path, model)[0][:, 0] for model in ("better_of_both", "previous_pose")]
    assert_allclose(found, [[0, 0.01, 0, 0, 0], [0, 0.01, 0.01, 0, 0]], atol=1e-12)


def test_a_warning_before_the_work(tmp_path: Path) -> None:
    """Catches a run that cannot follow and says so only by its error; a warning where the steps
    suffice; and a bound that the finished run contradicts."""
    folder = make_room("office", tmp_path / "office", 12, 32, 24, motion="keyframes")
    scene, few, many = Scene("office", folder), 2, 60
    preset = load_preset("smoke")
    job = MapJob.of(scene, "neus", preset)
    sdf, lm = preset.tracking_of("sdf"), preset.tracking_of("lm")
    runs = {n: TrackJob(job, scene, "sdf", sdf, n) for n in (few, many)}
    (said,) = reach_warnings([*runs.values()])
    assert said.startswith(f"{few} steps of sdf")
    assert runs[few].expected_reach()["greedy_ate_m"] > runs[many].expected_reach()["greedy_ate_m"]
    assert not [*reach_warnings([TrackJob(job, scene, "lm", lm, few)])]
    assert TrackJob(job, scene, "sdf", sdf, rate_hz=10).expected_reach() == {}
