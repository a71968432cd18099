"""Adam's trackers, and what all trackers share, in fields whose answers are known exactly."""

import hashlib
from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
import torch
from box_room import BoxRoom, box_sequence, poses_at, walk

from nbtrack import Frame, Tracker, make_tracker
from nbtrack.beyond.grid import BakedField
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import NetworkSettings, field_class
from nbtrack.machinery.errors import ConfigError, DataError, NumericalError
from nbtrack.mapping.fit import map_sequence
from nbtrack.tracking import ClockBudget, StepBudget, TrackerSettings, Trajectory, tracker_class
from nbtrack.tracking.paper import SdfSettings, VrSettings
from nbtrack.tracking.starts import expected_poses, rigid
from nbtrack.tracking.trajectories import track_sequence

SETTINGS = {"vr": VrSettings(n_pixels=128), "sdf": SdfSettings(n_pixels=256, lambda_color=0.1)}


def tracker_of(name: str, steps: float, settings: TrackerSettings | None = None) -> Tracker:
    """In the box room, at its middle."""
    field, settings = BoxRoom(as_density=name == "vr"), settings or SETTINGS[name]
    return make_tracker(name, field, np.eye(4), StepBudget(steps), settings)


def track(name: str, sequence: RgbdSequence, steps: float) -> Trajectory:
    return track_sequence(tracker_of(name, steps), sequence)


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_known_offset_shrinks_and_the_true_pose_stays(name: str) -> None:
    """Catches a gradient with the wrong sign: from 2 cm off, 60 steps must halve the error; and
    drift: noise of random pixels may move the true pose by millimetres only."""
    offset = [0.02, -0.01, 0.015]
    frames = track(name, box_sequence([[0.0, 0.0, 0.0], offset]), 60).frames
    assert frames["translation_error_m"].iloc[0] < np.linalg.norm(offset) / 2
    assert frames["rotation_error_deg"].iloc[0] < 1.0
    assert frames["steps"].tolist() == [60]
    frames = track(name, box_sequence([[0.1, 0.0, -0.1]] * 2), 20).frames
    assert frames["translation_error_m"].iloc[0] < 0.008
    assert frames["rotation_error_deg"].iloc[0] < 0.5


@pytest.mark.parametrize("n_samples", [(2, 0), (2, 12)])
def test_the_fewest_samples_move_the_camera(n_samples: tuple[int, int]) -> None:
    """Catches a tracker that stands still in silence: of one sample alone, which is refused, the
    rendered depth has no gradient."""
    few = dict(zip(("n_stratified", "n_importance"), n_samples, strict=True))
    tracker = tracker_of("vr", 5, replace(SETTINGS["vr"], **few))
    found = track_sequence(tracker, box_sequence([[0.0, 0.0, 0.0], [0.02, -0.01, 0.015]]))
    assert np.abs(found.T_estimated[0, :3, 3]).max() > 1e-3


def test_colour_alone() -> None:
    """Catches a depth term that is still on, or was never: of a frame whose depths are all 5 cm too
    long, the same pixels' colours are the same."""
    frame, losses = box_sequence([[0.05, 0.04, 0.03]])[0], {}
    longer = replace(frame, depth_mm=frame.depth_mm + 50)
    for seen, weight in product((frame, longer), (0.0, 1.0)):
        tracker = tracker_of("vr", 1, VrSettings(n_pixels=128, lambda_depth=weight))
        tracker.begin(seen, torch.eye(4)[None])
        losses[seen is frame, weight] = float(tracker.step())
    assert losses[True, 0.0] == losses[False, 0.0] > 0
    assert losses[True, 1.0] != losses[False, 1.0]


def test_where_a_frame_starts() -> None:
    """Catches a start from the truth: without steps, all estimates are the first pose, and errors
    are those of standing still; and a motion model that is named in the settings and not used, or
    not reset."""
    sequence = walk(3)
    tracked = track("sdf", sequence, 0.1)
    assert tracked.frames["steps"].sum() == 0
    assert tracked.frames["seconds"].between(0, 60).all()
    assert np.allclose(tracked.T_estimated, np.eye(4), atol=1e-7)
    still, errors = (tracked.frames[f"{name}_error_m"] for name in ("still", "translation"))
    np.testing.assert_allclose(still, errors, atol=1e-7)
    np.testing.assert_array_equal(tracked.T_true, sequence.T_world_camera[1:])
    assert sequence.digest == walk(3).digest  # what a tracker writes in place is its own
    tracked.T_true[:] = np.nan  # as a user may: the sequence stays
    tracker = tracker_of("sdf", 0.1, SdfSettings(motion_model="constant_velocity"))
    tracker.estimates.append(sequence.T_world_camera[1])
    assert np.allclose(tracker.track(sequence[2]).T_world_camera, sequence.T_world_camera[2])
    tracker.restart(np.eye(4))
    assert np.allclose(tracker.track(sequence[2]).T_world_camera, np.eye(4))


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_killed_run_goes_on_as_before(name: str, tmp_path: Path, monkeypatch) -> None:
    """Catches pixels drawn twice, a budget that forgets its fractions, frames done again."""
    sequence, frames = walk(6), []
    whole = track(name, sequence, 2.4)
    monkeypatch.setattr("nbtrack.machinery.files.CHECKPOINT_SECONDS", 0.0)

    def die_at_fourth(frame: int, error: float) -> None:
        frames.append(frame)
        if len(frames) == 4:
            raise KeyboardInterrupt

    run = tmp_path / "run.pt"
    with pytest.raises(KeyboardInterrupt):
        track_sequence(tracker_of(name, 2.4), sequence, run, die_at_fourth)
    resumed = track_sequence(tracker_of(name, 2.4), sequence, run, die_at_fourth)
    # Frame 4 was done, but not kept: it is the only one that is done again.
    assert frames == [1, 2, 3, 4, 4, 5]
    np.testing.assert_array_equal(resumed.T_estimated, whole.T_estimated)
    kept = ["steps", "loss", "translation_error_m"]
    pd.testing.assert_frame_equal(resumed.frames[kept], whole.frames[kept])


def test_an_unknown_start_is_searched_beyond_the_budget(monkeypatch) -> None:
    """Catches a search for a camera somewhere in the map that ends with the budget of a frame."""
    monkeypatch.setattr("nbtrack.tracking.trajectories.STEPS_TO_FIND", 9)
    tracker = tracker_of("sdf", 2)
    tracker.restart_anywhere = lambda: tracker.restart(np.eye(4))
    tracker.report = lambda: {"lost": len(tracker.estimates) < 3}  # in the first two frames
    found = track_sequence(tracker, walk(5), is_start_known=False)
    assert found.frames["steps"].tolist() == [9, 9, 9, 2, 2]
    tracker.report = lambda: {}  # that does not judge itself
    found = track_sequence(tracker, walk(3), is_start_known=False)
    assert found.frames["steps"].tolist() == [9, 2, 2]


def test_warm_up_steps_count_nowhere() -> None:
    """Catches a first call that loads and allocates within the first frame's time, and a
    preparation that does not: with a quarter of a second for each, three steps fit in one."""
    seconds, steps = iter([0.0, *np.arange(0.25, 9, 0.25)]), []
    tracker = tracker_of("sdf", 1)
    tracker.budget, step = ClockBudget(1, lambda: next(seconds)), tracker.step
    tracker.step = lambda: steps.append(1) or step()
    assert tracker.track(walk(1)[0]).steps == 3
    assert len(steps) > 3


def test_wrong_arguments() -> None:
    """Catches a grid to render, tracking on nothing, and poses that are not numbers. What commands
    refuse: `test_faults.py`."""
    with pytest.raises(ConfigError, match="'vr' does not work on field 'baked'"):
        make_tracker("vr", BakedField(BoxRoom(), 0.2), np.eye(4), StepBudget(1))
    for name, in_corrected in (("sdf", True), ("lm", False)):
        with pytest.raises(ConfigError, match="finds no unknown first pose"):
            tracker_class(name).check_finds(in_corrected)
    sequence, tracker = walk(3), tracker_of("sdf", 2)
    with pytest.raises(DataError, match="too short to track"):
        track_sequence(tracker, sequence.select(slice(1)))
    tracker.field.forward = lambda points: (points * float("nan"), points[:, 0] * float("nan"))
    with pytest.raises(NumericalError, match="frame 1 of box"):
        track_sequence(tracker, sequence)
    sequence.depths_mm[:] = 0
    with pytest.raises(DataError, match="no frame of box has a measured depth"):
        track_sequence(tracker, sequence)


def test_a_grid_is_tracked_in_by_one_thread() -> None:
    """Catches a wide network, kept with the grid that was made from it, that sets the threads."""
    seen = []

    class Watched(BakedField):
        def forward(self, points_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            seen.append(torch.get_num_threads())
            return super().forward(points_world)

    grid = Watched(BoxRoom(), 0.2)
    grid.source = torch.nn.Linear(3, 512)
    torch.set_num_threads(2)
    make_tracker("sdf", grid, np.eye(4), StepBudget(2)).track(walk(2)[1])
    assert {*seen} == {1}
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("name", ["vr", "sdf"])
def test_a_frame_without_depth_keeps_the_expected_pose_and_is_marked(name: str) -> None:
    """Catches a run that one blind frame ends, a pose from nothing, and NaN in the results; and a
    frame without depth that is lost as an estimate, and neither lost nor found in the table."""
    sequence = walk(5)
    sequence.depths_mm[[0, 2]] = 0
    tracked = track(name, sequence, 20)
    assert tracked.frames["without_depth"].tolist() == [False, True, False, False]
    assert tracked.frames["steps"].tolist() == [20, 0, 20, 20]
    np.testing.assert_allclose(tracked.T_estimated[1], tracked.T_estimated[0], atol=1e-6)
    assert np.isfinite(tracked.T_estimated).all()
    assert tracked.frames["translation_error_m"].iloc[3] < 0.01
    tracker = tracker_of(name, 1)
    assert [tracker.track(sequence[i]).lost for i in (1, 2)] == [False, True]
    tracker.report = lambda: {"lost": False}
    assert track_sequence(tracker, sequence).frames["lost"].tolist() == [False, True, False, False]


def test_a_long_time_without_depth() -> None:
    """Catches rotations that stretch, as rounding gathers where poses are predicted from poses."""
    sequence = walk(3)
    dark = replace(sequence[2], depth_mm=0 * sequence[2].depth_mm)
    tracker = tracker_of("sdf", 1, SdfSettings(motion_model="constant_velocity"))
    tracker.track(sequence[1])
    for _ in range(300):
        R = tracker.track(dark).T_world_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


class Sliding(Tracker):
    """It moves by 10 cm in every step, in place, and remembers its frames."""

    name, remembers = "sliding", ("seen",)
    seen: ClassVar = []
    T_world_camera = torch.eye(4, dtype=torch.float64)

    def begin(self, frame: Frame, T_starts: torch.Tensor) -> None:
        self.seen.append(frame.name)

    def step(self) -> torch.Tensor:
        self.T_world_camera[0, 3] += 0.1
        return self.T_world_camera[0, 3]


def test_an_estimate_is_the_users_own() -> None:
    """Catches an estimate that a later step moves, and one whose change by the user is taken for
    what was found."""
    tracker, frame = Sliding(BoxRoom(), np.eye(4), StepBudget(1)), walk(1)[0]
    first, second = tracker.track(frame), tracker.track(frame)
    assert second.T_world_camera[0, 3] - first.T_world_camera[0, 3] == pytest.approx(0.1)
    second.T_world_camera[:] = np.nan
    assert np.isfinite(np.stack(tracker.estimates)).all()


def test_a_report_adds_columns(monkeypatch) -> None:
    """Catches a column of the table that an own tracker's report replaces, as steps in its unit,
    and a list in its memory that warm-up, or another tracker, has filled."""
    for column, outcome in (("steps", pytest.raises(ConfigError)), ("gain", nullcontext())):
        monkeypatch.setattr(Sliding, "report", lambda self, column=column: {column: len(self.seen)})
        with outcome:
            frames = track_sequence(Sliding(BoxRoom(), np.eye(4), StepBudget(1)), walk(3)).frames
    assert frames["gain"].tolist() == [1, 2]


@pytest.mark.parametrize("pose", [2 * torch.eye(4), torch.eye(4)[None], np.eye(3)])
def test_a_pose_that_a_tracker_of_ones_own_gives(pose) -> None:
    """Catches errors of an absurd size, or torch's words, where an own tracker gives no pose."""
    tracker = Sliding(BoxRoom(), np.eye(4), StepBudget(1))
    tracker.T_world_camera = pose
    tracker.step = lambda: torch.zeros(())
    with pytest.raises(DataError, match="no rigid transform"):
        tracker.track(walk(1)[0])


def test_motion_models() -> None:
    """Catches velocities of the world, which leave a circle along its tangent, or of nothing."""
    start, step = poses_at([[1, 2, 3], [0.05, 0, 0]], [[0.3, -0.5, 0.2], [0, 0.1, 0]])
    poses = [start @ np.linalg.matrix_power(step, k) for k in range(4)]
    models = ("previous_pose", "constant_velocity", "better_of_both")
    for model in models:
        np.testing.assert_array_equal(expected_poses(model, poses[:1]), poses[:1])
    still, moving, both = (expected_poses(model, poses[:3]) for model in models)
    np.testing.assert_allclose([*still, *moving], poses[2:], atol=1e-12)
    np.testing.assert_array_equal(both, [*moving, *still])
    stretched = np.diag([2.0, 1.0, 1.0, 1.0])
    assert rigid(stretched)[0, 0] < stretched[0, 0] == 2  # of the estimates none is changed
    with pytest.raises(ConfigError, match="did you mean 'constant_velocity'"):
        expected_poses("constant_velocty", poses)


PAIRS = {"vr": "imap", "sdf": "neus", "lm": "neus_plus"}
SMALL = {"iterations": 6, "n_rays": 32, "n_stratified": 8, "n_surface": 8, "n_surface_points": 64}


def digest_of(tracker: str, seed: int) -> str:
    """Hash of a small map's weights and of the trajectory that is tracked in it."""
    sequence = box_sequence([[0.004 * i, 0.002 * i, 0.0] for i in range(4)])
    mapping = field_class(PAIRS[tracker]).Settings()
    mapping = replace(mapping, **{k: v for k, v in SMALL.items() if hasattr(mapping, k)})
    network = NetworkSettings(width=24, n_frequencies=16)
    field = map_sequence(PAIRS[tracker], sequence, network, mapping, seed).field
    settings = tracker_class(tracker).Settings(n_pixels=64, motion_model="better_of_both")
    run = make_tracker(tracker, field, sequence.T_world_camera[0], StepBudget(3.5), settings, seed)
    found = hashlib.sha256(track_sequence(run, sequence).T_estimated.tobytes())
    for name, tensor in field.state_dict().items():
        found.update(name.encode() + tensor.numpy().tobytes())
    return found.hexdigest()


@pytest.mark.parametrize("tracker", PAIRS)
def test_again_and_with_other_threads(tracker: str) -> None:
    """Catches hidden randomness, and sums whose order depends on how many share them.

    Networks this narrow are computed by one thread however many there are.
    """
    torch.set_num_threads(1)
    once = digest_of(tracker, 1)
    assert digest_of(tracker, 2) != once
    torch.set_num_threads(2)
    assert digest_of(tracker, 1) == once
