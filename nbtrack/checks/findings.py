"""Sentences about a recording: faults, doubts and remarks, from what `check` measured.

Each function looks at one kind of mistake, and yields or returns a sentence for each one it finds.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from jaxtyping import Int

from nbtrack.checks.conventions import MIN_OVERLAP, PLAUSIBLE_DEPTH, Convention, remedy
from nbtrack.checks.misfits import Misfit
from nbtrack.recordings.reading import FAR, far_limit
from nbtrack.recordings.recording import Recording

# A pose is odd if it lies farther from the middle of its neighbours than both of these. Real
# recordings, and rooms thinned to every twentieth frame, have up to 1.1 median steps.
_OFF = 0.05  # m
_OFF_STEPS = 2.5  # medians of the distance between frames
# It is a fault if a larger share of the depth images repeats the one before.
_MIN_REPEATED = 0.05
_MAX_HELD = 0.9  # where more poses repeat the one before, the camera stands still (our choice)
_MAX_STEP = 0.01  # share of the depth: coarser steps of a camera's depth are remarked (our choice)
# Coarse steps of depth explain a gap below this share of a step. In right recordings with such
# steps surfaces lie 0.13 to 0.19 of a step apart.
_OF_STEP = 0.2
# A depth value is no measurement if three things hold: more than SHARED of all depths have the
# value, more than _SHARING of the frames have it at more than SHARED of their pixels, and it is
# more than _SPIKE times as frequent as any value that is a measurement (our choice).
SHARED, _SHARING, _SPIKE = 0.01, 0.25, 10
# What a cause with several numbers leaves of the cost, at most. Where poses jump by 5 cm, or depth
# is wrong at edges, six numbers leave 0.44 or more; of a camera beside its poses 0.06 (our choice).
_MAX_COST_OF_SEVERAL = 0.4
# If the directions in which the camera looks spread by less (degrees), as from a gantry, a surface
# may have one depth in all images.
_LOOKS_DEG = 0.5
# A camera that moves and turns less from frame to frame may measure the same again (our choice).
_MOVES_MM, _TURNS_DEG = 1.0, 0.05
_VALUES = 3  # a camera has at most so many values for no measurement (our choice)
_FEW_VALUES = 10  # images of at most so many different depths do not tell (our choice)
_BLACK = 0.02  # images are black if their median brightness, in [0, 1], is below this


def misreading(
    declared: Convention, best: Convention, main: list[Misfit], step_m: float = 0.0
) -> dict[str, list[str]]:
    """Say how the numbers are misread: one sentence under its kind, "fault", "doubt" or "note".

    `best` is from `fit_all`, `main` from `main_misfits`, and `step_m` from `steps_of`. The first of
    these that holds is said, and the dictionary is empty if none holds:
    - Coarse steps of depth explain the gaps: a "doubt", or a "note" if the gaps are usual.
    - Another convention than the declared one is the best, or a cause explains the gaps under the
      best one, or both: a "fault", or a "note" if usual sensors have such an error.
    - Surfaces lie apart without a known cause: a "doubt", or a "fault" if they lie far apart.
    """
    apart_mm = 1e3 * declared.apart * declared.depth_m
    apart = "hardly meet" if np.isnan(apart_mm) else f"lie {apart_mm:.0f} mm apart"
    if best is declared and apart_mm < _OF_STEP * 1e3 * step_m:
        advice = "use the camera's own depth files, or expect no better poses"
        text = f"depths come in steps of {100 * step_m:.1f} cm: {advice}"
        return {"note" if declared.apart <= declared.usual_apart else "doubt": [text]}
    parts, kind, left = [], "fault", best.apart
    if best is not declared:
        parts.append(f"{best}; {remedy(best.reading, declared.reading)}")
    main = [misfit for misfit in main if _explains(misfit, best)]
    if main and not (parts and main[0].is_usual):
        names = ", or as well that ".join(str(misfit) for misfit in main)
        parts.append(f"{names}; {remedy(main[0].reading, best.reading)}")
        kind, left = "note" if main[0].is_usual else "fault", main[0].apart
    if parts and left <= best.usual_apart:
        left_mm = 1e3 * left * best.depth_m
        tail = f"surfaces that two frames see then lie {left_mm:.0f} mm apart; as declared they"
        return {kind: [f"{', and then '.join(parts)} ({tail} {apart})"]}
    return _unexplained(declared, apart)


def _unexplained(declared: Convention, apart: str) -> dict[str, list[str]]:
    """Say that surfaces lie apart without a known cause, if they do: see `misreading`."""
    if declared.overlap < MIN_OVERLAP or not declared.apart > declared.usual_apart:
        return {}
    usual_mm = 1e3 * declared.usual_apart * declared.depth_m
    text = (
        f"surfaces that two frames see {apart} (right recordings: up to {usual_mm:.0f} mm), and "
        "nothing that is tried explains it by itself: no other axes or directions of poses and "
        "depth, no usual unit, no depth that comes up to ten frames late, no focal lengths (a "
        "factor of 0.5 to 1.5) or principal point, no error of depth (a factor of 0.2 to 1.8, a "
        "length, a square), no offset of the camera (1 m, 30 degrees). What cannot be told: two "
        "mistakes at once, poses that drift, jump, belong to other frames or have a scale of their "
        "own, things that move, a lens's distortion, and depth images that hold no depth "
        "(disparity, half floats, each frame scaled by itself)"
    )
    return {"fault" if declared.is_far_apart else "doubt": [text]}


def _explains(misfit: Misfit, best: Convention) -> bool:
    """Whether surfaces lie as near with the cause as those of right recordings, and because of it.

    Several numbers fit also what they do not cause. So if surfaces lie near without the cause, too,
    one of several numbers must leave little of the cost.
    """
    is_sure = len(misfit.numbers) == 1 or misfit.cost_left < _MAX_COST_OF_SEVERAL
    return misfit.apart <= best.usual_apart and (best.apart > best.usual_apart or is_sure)


def doubts_of_poses(
    conventions: list[Convention], recording: Recording, needs_proof: bool, frames: pd.DataFrame
) -> Iterator[str]:
    """A doubt if it cannot be told whether the poses are read rightly.

    It cannot be told if two frames see too little of the same. With `needs_proof` it cannot be told
    either if other conventions fit about as well. The declared convention must come first in
    `conventions`. `frames` is the table of `check`.
    """
    declared, *others = conventions
    file, measured = recording.pose_file.name, frames.measured.mean()
    of_poses = [other for other in others if other.subject == "poses"]
    alike = [other.name for other in of_poses if not declared.is_clearly_better(other)]
    if declared.overlap < MIN_OVERLAP or np.isnan(declared.apart):
        reason = f"two frames see too little of the same ({declared.overlap:.0%} of the points, "
        reason += f"whose neighbours need a depth, which {measured:.0%} of the pixels have)"
        moved_m = frames.moved_mm.median() / 1e3
        reason += f"; the camera moves {moved_m:.2g} m a frame" if moved_m > 0 else ""
        yield f"{file} is not proved: {reason}: check it, and a piece with smaller steps"
    elif needs_proof and alike:
        reason = f"{len(alike)} other conventions fit about as well, such as {alike[0]}"
        why = "the camera moves too little, or surfaces are flat or lie apart"
        yield f"{file} is not proved: {reason}: {why}"


def no_depth_values(
    counts: Int[np.ndarray, "2 values"], n_read: int, looks_deg: float
) -> list[int]:
    """The depth values, at most `_VALUES`, that the camera gives for no measurement.

    Many pixels share such a value, although the directions in which the camera looks spread by
    `looks_deg` on average. `counts[0]` tells how often each depth value occurs in `n_read` frames,
    and `counts[1]` in how many of them a share of the pixels above `SHARED` has it.
    """
    n_pixels, n_frames = counts
    is_shared = (n_pixels > SHARED * n_pixels.sum()) & (n_frames > _SHARING * n_read)
    is_shared &= (looks_deg > _LOOKS_DEG) & (np.count_nonzero(n_pixels) > _FEW_VALUES)
    most_frequent = np.argsort(-n_pixels)[: _VALUES + 1]
    # Frequencies fall by a factor above _SPIKE after the last value that is no measurement. Among
    # measurements a camera's rounding makes some frequent, but none by so much.
    falls = n_pixels[most_frequent[:-1]] > _SPIKE * n_pixels[most_frequent[1:]]
    n_spikes = 1 + max(np.flatnonzero(falls), default=-1)
    return sorted(int(value) for value in most_frequent[:n_spikes] if is_shared[value])


def of_images(
    frames: pd.DataFrame, no_depth: list[int], often: Int[np.ndarray, "_"]
) -> Iterator[str]:
    """Faults of images that do not depend on what their numbers mean.

    `no_depth` is the result of `no_depth_values`; `often[v]` is how often the depth value v occurs.
    """
    if not frames.measured.any():
        advice = "check the depth folder, and no_depth in sequence.toml"
        yield f"no pixel that was looked at has a depth: all are 0, or saturated (65535); {advice}"
    if no_depth:
        found = f"{often[no_depth].sum() / often.sum():.0%} of the depths are "
        found += " or ".join(map(str, no_depth))
        yield f"{found}, which is no measurement; set no_depth = {no_depth} in sequence.toml"
    moves = (frames.moved_mm > _MOVES_MM) | (frames.turned_deg > _TURNS_DEG)
    repeated = (frames.is_repeated & moves & (frames.measured > 0)).mean()
    if repeated > _MIN_REPEATED:
        found = f"{repeated:.0%} of the depth images repeat the one before, though the poses move"
        yield f"{found}: leave the repetitions out of the recording, or give them no pose"
    if frames.brightness.median() < _BLACK:
        options = "--set tracking.lm.lambda_intensity=0, or tracking.sdf.lambda_color=0 for sdf"
        yield f"the colour images are black: check their folder, or track without colour: {options}"


def odd_poses(frames: pd.DataFrame) -> pd.Series:
    """How far (m) those poses are off the path of their neighbours that lie far beside it.

    Call it only if the declared convention is the best one: the path is distorted under others.
    """
    off = frames.off_mm / 1e3  # m
    is_odd = off > max(_OFF, _OFF_STEPS * frames.moved_mm.median() / 1e3)
    # An odd pose also makes its two neighbours look odd by half as much, since they are compared
    # with the middle of their own neighbours. So of three frames in a row only the one that is
    # farthest off counts.
    largest_of_three = off.rolling(3, min_periods=1, center=True).max()
    return off[is_odd & (off == largest_of_three)]


def of_poses(odd: pd.Series, n_read: int, recording: Recording) -> Iterator[str]:
    """A fault if some of `n_read` poses lie beside the path, and surfaces contradict them: `odd`.

    `odd` has a row for each of them, as `odd_poses` has.
    """
    if len(odd):
        first = recording.color_files[odd.index[0]].name
        found = f"{len(odd)} of {n_read} poses lie up to {100 * odd.max():.0f} cm beside the path"
        advice = "check the poses there, or leave frames out with --frames of map and track"
        yield f"{found} of their neighbours, first near {first}: {advice}"


def of_held_poses(frames: pd.DataFrame) -> Iterator[str]:
    """A remark if some poses repeat the one before: of a slower source they are held between."""
    is_held = (frames.moved_mm == 0) & (frames.turned_deg < 1e-3) & ~frames.is_repeated
    if _MIN_REPEATED < is_held.mean() < _MAX_HELD:
        found = f"{is_held.mean():.0%} of the poses repeat the one before, though the images change"
        yield f"{found}: if the camera moved, give each image the pose of its own time"


def of_units(depth: pd.Series) -> Iterator[str]:
    """A doubt if the median depth (m) is too small or too large for a depth camera.

    Depths and poses agree with each other even so, if both have the same wrong unit.
    """
    near, far = PLAUSIBLE_DEPTH
    median = depth.median()
    if median < near or median > far:
        advice = "if its unit and that of the poses are others, set depth_scale in sequence.toml"
        yield f"the median depth is {median:.3g} m, outside {near:g} to {far:g} m: {advice}"


def of_depths(depth: pd.Series) -> Iterator[str]:
    """A remark if some depths (m) are outliers, as `far_limit` defines them."""
    is_far = depth > far_limit(depth)
    if is_far.any():
        low, high = depth[is_far].min(), depth[is_far].max()
        found = f"{is_far.mean():.2%} of the depths are outliers, {low:.3g} to {high:.3g} m away"
        rule = f"more than {FAR:g} times as far as nine in ten: maps and tracking leave them out"
        advice = "check the camera, or set no_depth in sequence.toml to what it gives for none"
        yield f"{found}, {rule}; {advice}"


def steps_of(frames: pd.DataFrame, depth: pd.Series, depth_scale: float) -> float:
    """The step (m) between two values that depths (m) can have, if it is coarse, else 0.

    The step is compared with the depths alone. So it does not matter if the declared unit is wrong,
    and both are wrong by the same factor.
    """
    step_m = np.gcd.reduce(frames.depth_step) / depth_scale
    # If the farthest point is fewer than eight steps away, the step may be chance.
    return step_m if _MAX_STEP * depth.median() < step_m < depth.max() / 8 else 0.0
