"""What the checks conclude from numbers, at their limits, by hand."""

from dataclasses import astuple, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from box_room import poses_at, sequence_of

from nbtrack.checks import findings
from nbtrack.checks.conventions import Convention, _best_of
from nbtrack.checks.misfits import Misfit, _best_start, _normal_equations, _solution
from nbtrack.checks.readings import FramePairs, Reading, cost_of, mean_apart
from nbtrack.core.camera import Intrinsics
from nbtrack.recordings.formats import Declaration
from nbtrack.recordings.recording import Recording

READING = Reading(Declaration(), Intrinsics(64, 48, 48.0, 48.0, 32.0, 24.0))
OWN = Convention(
    READING, np.zeros((1, 1)), apart=0.001, depth_m=2.0, overlap=0.5, agreement=0.4,
    subject="poses", name="own",
)  # fmt: skip


def frames(**changes) -> pd.DataFrame:
    """Eight frames of which nothing is to be said."""
    usual = {"measured": 1.0, "brightness": 0.5, "depth_step": 1, "is_repeated": False}
    usual |= {"moved_mm": 30.0, "turned_deg": 0.3, "off_mm": 1.0}
    return pd.DataFrame({**usual, **changes}, range(8))


def test_a_value_that_many_pixels_share() -> None:
    """Catches a value that is told although it is rare, no spike, in few frames or of a camera that
    looks one way, or where hardly any value occurs: of 20 values with 100 pixels each and one more,
    in three of eight frames."""
    counts = np.zeros((2, 6000), int)
    counts[0, 1:21], counts[:, 50] = 100, [1001, 3]
    assert findings.no_depth_values(counts, 8, 0.6) == [50]
    two = counts.copy()
    two[:, 7] = [1002, 3]
    assert findings.no_depth_values(two, 8, 0.6) == [7, 50]
    few, flat, seldom, rare = (counts.copy() for _ in range(4))
    few[0, 10:21], flat[0, 50], seldom[1, 50] = 0, 1000, 2
    rare[0, 100:], rare[0, 50] = 20, 1001
    assert not any(findings.no_depth_values(n, 8, 0.6) for n in (few, flat, seldom, rare))
    assert not findings.no_depth_values(counts, 8, 0.4)  # a surface may have one depth in all


def test_what_images_say() -> None:
    """Catches frames that count although the camera stands or sees nothing, and means in place of
    medians."""
    often, half = np.array([0, 3, 1]), [False, True] * 4
    (black,) = findings.of_images(frames(brightness=[0.01] * 5 + [0.9] * 3), [], often)
    assert "are black" in black
    for share, repeats in (("50%", half), ("12%", [False] * 7 + [True])):
        (repeated,) = findings.of_images(frames(is_repeated=repeats), [], often)
        assert f"{share} of the depth images repeat" in repeated
    (shared,) = findings.of_images(frames(), [1], often)
    assert "75% of the depths are 1," in shared
    (none,) = findings.of_images(frames(measured=0.0), [], often)
    assert "no pixel" in none
    still, empty = {"moved_mm": 0.9, "turned_deg": 0.04}, {"measured": [1.0, 0.0] * 4}
    for quiet in (still, empty):
        assert [*findings.of_images(frames(is_repeated=half, **quiet), [], often)] == []


def test_poses_beside_the_path() -> None:
    """Catches neighbours of an odd pose that count too, steps that do not, and a camera's one long
    step that hides it."""
    recording = mock.Mock(spec=Recording, color_files=[Path(f"img{k}.png") for k in range(8)])
    off = [1.0, 1, 100, 200, 100, 1, 1, 1]
    long = [30.0] * 7 + [2000.0]
    odd = findings.odd_poses(frames(off_mm=off, moved_mm=long))
    (said,) = findings.of_poses(odd, 8, recording)
    assert said.startswith("1 of 8 poses lie up to 20 cm beside")
    assert "first near img3.png" in said
    for quiet in (frames(off_mm=off, moved_mm=90.0), frames(off_mm=49.0, moved_mm=1.0)):
        assert findings.odd_poses(quiet).empty


def test_poses_that_are_held() -> None:
    """Catches poses of a slower source without a word, and a word about a camera that stands still
    or turns, and about images that repeat, too."""
    for held, changes in (
        (6, {}),
        (0, {}),
        (8, {}),
        (6, {"turned_deg": 0.3}),
        (6, {"is_repeated": True}),
    ):
        table = frames(
            **{"moved_mm": [0.0] * held + [30.0] * (8 - held), "turned_deg": 0.0, **changes}
        )
        assert len([*findings.of_held_poses(table)]) == (held == 6 and not changes)


def test_what_depths_say() -> None:
    """Catches another unit, and steps that are told of a camera that is near, or far."""
    usual = pd.Series(np.linspace(0.5, 1.5, 100))
    assert [*findings.of_units(usual)] == [*findings.of_units(usual * 20)] == []
    for factor in (0.15, 25):
        assert "median depth is" in next(findings.of_units(factor * usual))
    assert [*findings.of_depths(usual)] == []
    assert findings.steps_of(frames(depth_step=[50, 100] * 4), usual, 1000) == 0.05
    for step, depth in ((9, usual), (50, usual / 4)):
        assert findings.steps_of(frames(depth_step=step), depth, 1000) == 0
    far = pd.concat([usual, pd.Series([50.0, 60.0])], ignore_index=True)
    (outliers,) = findings.of_depths(far)
    assert outliers.startswith("1.96% of the depths are outliers, 50 to 60 m away")


APART = [
    (0.0054, 2.0, 0.5, []), (0.008, 2.0, 0.5, ["doubt"]), (0.012, 2.0, 0.5, ["fault"]),
    (0.0024, 10.0, 0.5, []), (0.0026, 10.0, 0.5, ["fault"]), (0.008, 2.0, 0.1, []),
]  # fmt: skip


@pytest.mark.parametrize(("apart", "depth_m", "overlap", "kind"), APART)
def test_how_far_apart_surfaces_may_lie(apart, depth_m, overlap, kind) -> None:
    """Catches another limit: 5.5 mm a metre, or 25 mm; and a fault from twice the former on."""
    own = replace(OWN, apart=apart, depth_m=depth_m, overlap=overlap)
    assert [*findings.misreading(own, own, [])] == kind


def test_a_cause_is_named() -> None:
    """Catches a usual sensor's error that is a fault, another one that is none, and a cause that is
    named although surfaces still lie apart."""
    own = replace(OWN, apart=0.008)
    reading = replace(READING, depth_error_per_m=0.003)
    numbers = {"depth_error_per_m": (0.003, 0.002, 0.004)}
    usual = Misfit("depths are short", reading, numbers, 0.001, 0.5)
    large = replace(usual, numbers={"depth_error_per_m": (0.005, 0.004, 0.006)})
    kinds = [[*findings.misreading(own, own, [main])] for main in (usual, large)]
    assert kinds == [["note"], ["fault"]]
    (text,) = findings.misreading(own, own, [replace(usual, apart=0.006)])["doubt"]
    assert "nothing that is tried" in text
    assert [*findings.misreading(own, replace(OWN, name="other", agreement=0.8), [])] == ["fault"]
    for left, low, is_significant in ((0.8, 0.002, True), (0.95, 0.002, False), (0.8, 4e-4, False)):
        one = replace(usual, cost_left=left, numbers={"depth_error_per_m": (0.003, low, 0.004)})
        assert one.is_significant is is_significant
    assert not replace(large, cost_left=0.8).is_significant
    assert not replace(usual, numbers={"depth_error_per_m": (0.016, 0.014, 0.018)}).is_significant


def test_several_numbers_must_explain_more() -> None:
    """Catches poses that jump, or fattened depth, taken for a camera that lies beside its poses:
    where surfaces lie near as they are, two numbers must leave little of the cost; and a second
    mistake beside the first that is not said."""
    numbers = dict.fromkeys(("right", "down"), (0.02, 0.01, 0.03))
    two = Misfit("the principal point", replace(READING, right=0.02), numbers, 0.001, 0.45)
    near, far = replace(OWN, apart=0.005), replace(OWN, apart=0.008)
    assert findings.misreading(near, near, [two]) == {}
    for own, main in ((near, replace(two, cost_left=0.35)), (far, two)):
        assert "the principal point" in findings.misreading(own, own, [main])["fault"][0]
    other = replace(far, name="OpenGL axes", apart=0.006)
    (both,) = findings.misreading(replace(OWN, apart=0.05), other, [two])["fault"]
    assert "OpenGL axes" in both
    assert "and then the principal point" in both
    (none,) = findings.misreading(replace(OWN, apart=0.05), other, [])["fault"]
    assert "nothing that is tried" in none  # as the other convention leaves more than is usual


def test_a_corrected_camera_by_hand() -> None:
    """Catches a sign, a share of the other side, an aspect without the common factor, and a turn
    in another unit or before the shift."""
    changed = replace(READING, focal_share=0.1, aspect=0.2, right=0.1, down=-0.1).calibration
    assert astuple(changed) == pytest.approx((64, 48, 52.8, 63.36, 38.4, 19.2))
    turned = replace(READING, turn_z=90.0, y=0.3).T_world_camera(np.eye(4)[None], "xyzw")
    np.testing.assert_allclose(turned[0, :2], [[0, -1, 0, 0], [1, 0, 0, 0.3]], atol=1e-12)


LIMITS = {
    "late": (0.3, 10.0), "focal_share": (0.01, 0.5), "depth_share": (0.01, 0.8),
    "depth_error_per_m": (5e-4, 0.015), "depth_offset": (0.02, 0.5), "right": (0.005, 0.25),
    "down": (0.005, 0.25), "aspect": (0.01, 0.3), "y": (0.02, 1.0), "turn_z": (1.0, 30.0),
}  # fmt: skip


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("key", LIMITS)
def test_what_is_negligible_and_what_a_fit_may_find(key: str, sign: int) -> None:
    """Catches another limit of a number, one in one direction alone, and an estimate at the end of
    what is tried that counts as found."""
    negligible, limit = LIMITS[key]

    def is_told(value: float, nearest: float) -> bool:
        numbers = {key: (sign * value, *sorted([sign * nearest, sign * 2 * limit]))}
        return Misfit("a cause", READING, numbers, 0.001, 0.5).is_significant

    assert [is_told(value, 1.01 * negligible) for value in (0.99 * limit, limit)] == [True, False]
    assert not is_told(0.99 * limit, 0.99 * negligible)


def test_which_convention_is_the_best() -> None:
    """Catches one that is taken although it is hardly better, meets too little, lies far apart or
    has absurd depths; of those that fit alike the first counts."""
    own = replace(OWN, apart=6e-3)
    first, second = (replace(own, name=name, agreement=0.6, apart=5.9e-3) for name in "ab")
    assert _best_of([own, first, second]) is first
    alike = replace(first, agreement=0.575)
    assert _best_of([own, alike, second]) is alike
    assert _best_of([own, replace(first, agreement=0.56), second]) is second
    nearer = replace(own, apart=1.9e-3, agreement=0.45)
    assert _best_of([own, nearer]) is nearer
    changes = {"agreement": 0.5}, {"overlap": 0.1}, {"apart": 6.1e-3}, {"depth_m": 0.1}
    for change in (*changes, {"depth_m": 21.0, "apart": 1e-5}):
        assert _best_of([own, replace(first, **change)]) is own
    flat = replace(own, apart=5.4e-3)  # where surfaces lie as near as usual, nearness counts alone
    assert _best_of([flat, replace(first, apart=5.3e-3)]) is flat
    assert _best_of([flat, replace(first, apart=1.7e-3)]) is not flat


def test_doubts_of_poses() -> None:
    """Catches proof that is asked for in vain, and overlap that is told in place of motion."""
    recording = mock.Mock(spec=Recording, pose_file=Path("p.txt"))

    def doubts(needs_proof: bool, *conventions: Convention) -> list[str]:
        found = findings.doubts_of_poses([*conventions], recording, needs_proof, frames())
        return list(found)

    other = replace(OWN, name="other")
    (alike,) = doubts(True, OWN, other)
    assert "1 other conventions fit about as well, such as other" in alike
    assert doubts(False, OWN, other) == []
    clear, depth = replace(other, agreement=0.3), replace(other, subject="depth")
    assert doubts(True, OWN, clear, depth) == []
    for unknown in (replace(OWN, overlap=0.14), replace(OWN, apart=np.nan)):
        assert "too little of the same" in doubts(False, unknown)[0]


def test_a_step_of_a_fit_by_hand() -> None:
    """Catches sums over the wrong axis, weights, a sign, and areas that are not known: gaps that
    are linear in two numbers are solved in one step."""
    random = np.random.default_rng(0)
    slopes, wanted = random.normal(size=(2, 5, 7)), np.array([0.3, -0.2])
    gaps = -np.tensordot(wanted, slopes, axes=1)
    gaps[2, 3] = np.nan
    H, g = _normal_equations(gaps, list(gaps + slopes), 0.5)
    np.testing.assert_allclose(_solution(H.sum(axis=0), g.sum(axis=0)), wanted)
    known = np.nan_to_num(gaps)
    weights = (1 + (known / 0.5) ** 2) ** -2 * np.isfinite(gaps)
    np.testing.assert_allclose(g, (weights * slopes * known).sum(axis=2).T)
    np.testing.assert_allclose(H[:, 0, 1], (weights * slopes[0] * slopes[1]).sum(axis=1))
    assert cost_of(np.array([[0.004, np.nan, -0.012]])) == pytest.approx((0.5 + 0.9) / 2)
    assert mean_apart(np.array([[0.01, np.nan, -0.3]])) == pytest.approx((0.01 + 0.05) / 2)


def test_where_a_fit_begins() -> None:
    """Catches a number that is sought near the declared one alone, starts of several numbers, and
    one that is taken although hardly more areas agree."""
    one, two = np.zeros(1), np.zeros(2)
    found = [
        _best_start(values, values + 1.0, lambda tried, far=far: np.full((1, 24), tried[0] - far))
        for values, far in ((one, 0.65), (two, 0.65), (one, 0.005))
    ]
    assert [*map(float, np.concatenate(found))] == pytest.approx([0.643, 0, 0, 0], abs=1e-3)


def ends_of(
    depths_mm: np.ndarray, poses: np.ndarray, camera: Intrinsics = READING.camera
) -> FramePairs:
    """The pair of the first frame and the last."""
    declared = Declaration(camera_axes="opencv")
    recording = mock.Mock(spec=Recording, file_poses=poses, declared=declared)
    sequence, n_frames = sequence_of(depths_mm, camera, poses=poses), len(poses)
    return FramePairs(recording, np.arange(n_frames), sequence, np.array([[0], [n_frames - 1]]))


def wall_from(place_m: float, n_frames: int = 2) -> FramePairs:
    """A wall 2 m ahead of the first frame, and seen 1.5 m away by the last one, whose pose says
    that it is so far ahead of the first one."""
    depths_mm = np.linspace(2000, 1500, n_frames)[:, None, None] * np.ones((48, 64))
    return ends_of(depths_mm, poses_at(np.outer(np.linspace(0, place_m, n_frames), [0, 0, 1])))


def test_a_leaning_wall_that_is_seen_twice() -> None:
    """Catches depth that is taken from beside where a point is seen, and a mean depth; and more
    than 24 areas of an image whose rows and columns they do not divide."""
    small, still = Intrinsics(35, 11, 30.0, 30.0, 17.5, 5.5), poses_at(np.zeros((2, 3)))
    assert len(ends_of(np.full((2, 11, 35), 2000.0), still, small).points_of_areas) == 24
    rows, columns = np.indices((48, 64)) + 0.5
    depth_mm = 2000 / (1 - 0.6 * (columns - 32) / 48 - 0.3 * (rows - 24) / 48)
    found = ends_of(np.stack([depth_mm] * 2), still).compare(READING)
    assert np.nanmax(np.abs(found.area_gaps)) < 5e-4
    assert found.overlap == pytest.approx(1, abs=0.1)
    assert found.depth_m == pytest.approx(np.median(depth_mm) / 1000, rel=0.01)


@pytest.mark.parametrize(
    ("place_m", "changes", "residual_m", "depth_m"),
    [
        (0.5, {}, 0.0, 1.5), (0.53, {}, -0.03, 1.5), (0.3, {}, 0.2, 1.5),
        (0.5, {"depth_share": 0.1}, 0.05, 1.65), (0.45, {"depth_offset": -0.1}, 0.05, 1.4),
        (0.5, {"depth_error_per_m": 0.1}, 0.175, 1.725), (0.25, {"metres": (1, 1, 2)}, 0.0, 1.5),
        (0.5, {"focal_share": 0.1, "aspect": 0.1}, 0.0, 1.5), (0.5, {"x": 0.3, "z": 0.2}, 0.0, 1.5),
    ],
)  # fmt: skip
def test_how_far_apart_a_wall_lies_by_hand(place_m, changes, residual_m, depth_m) -> None:
    """Catches a sign, an inverted pose, another unit or weight, and points beside the image."""
    found = wall_from(place_m).compare(replace(READING, **changes))
    gap = residual_m / depth_m
    gaps = found.area_gaps[np.isfinite(found.area_gaps)]
    np.testing.assert_allclose(gaps, gap, atol=1e-4)
    assert 8 <= len(gaps) < 24
    assert found.apart == pytest.approx(min(abs(gap), 0.05), abs=1e-4)
    assert found.depth_m == pytest.approx(depth_m, abs=1e-4)
    nearer = (2 - place_m) / 2
    if not changes:
        assert found.overlap == pytest.approx(nearer**2, abs=0.05)
    assert found.agreement == pytest.approx(found.overlap / (1 + (100 * gap) ** 2), rel=1e-2)


def test_what_is_hidden_or_late() -> None:
    """Catches points that count although a surface before them hides them; and lateness that is
    left out, or poses that are not interpolated: of 21 frames, each 2.5 cm ahead."""
    assert wall_from(0.2).compare(READING).overlap == 0
    for late in (0.0, 1.0, 0.5):
        # The first frame cannot be later: only the last one's pose is then too far ahead.
        found = wall_from(0.5, 21).compare(replace(READING, late=late))
        assert found.apart == pytest.approx(0.025 * late / 1.5, abs=1e-4)
