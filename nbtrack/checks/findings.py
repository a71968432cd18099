"""What a recording and its fits say, each in a sentence: faults, doubts and remarks."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from jaxtyping import Int

from nbtrack.checks.conventions import MIN_OVERLAP, PLAUSIBLE_DEPTH, Convention, remedy
from nbtrack.checks.misfits import Misfit
from nbtrack.recordings.reading import FAR, far_limit
from nbtrack.recordings.recording import Recording

# A pose is odd if it is off the middle of its neighbours by more than both: metres, and medians of
# a step. Real recordings, and rooms thinned to every twentieth frame, have up to 1.1 medians.
_OFF = 0.05
_OFF_STEPS = 2.5
_MIN_REPEATED = 0.05  # share of frames whose depth is that of the frame before, though they moved
_MAX_STEP = 0.01  # share of the depth between depths that a camera can tell (our choice)
# A value is shared if it is so much of all depths, in so many frames, and so many times as often
# as any other (our choice).
SHARED, _SHARING, _SPIKE = 0.01, 0.25, 10
_BLACK = 0.02  # brightness, in [0, 1]


def misreading(own: Convention, best: Convention, main: list[Misfit]) -> tuple[str, str]:
    """What is wrong in how the numbers are read, in a sentence, and its kind.

    Both are empty where nothing is wrong. A cause is named if surfaces then agree as well as those
    of right recordings: the kind is "note" for a usual sensor's error, else "fault". Surfaces that
    lie apart without a known cause are a "doubt", and a "fault" if they lie far apart.
    """
    usual_mm = 1e3 * own.usual_apart * own.depth_m
    apart = f"lie {1e3 * own.apart * own.depth_m:.0f} mm apart" if own.overlap else "never meet"
    if best is not own:
        reading, name, left_mm = best.reading, str(best), 1e3 * best.apart * best.depth_m
    elif main and main[0].apart <= own.usual_apart:
        reading, left_mm = main[0].reading, 1e3 * main[0].apart * own.depth_m
        name = ", or as well that ".join(str(misfit) for misfit in main)
    elif own.overlap >= MIN_OVERLAP and own.apart > own.usual_apart:
        return (
            f"surfaces that two frames see {apart} (right recordings: up to {usual_mm:.0f} mm), "
            "and nothing that is tried explains it: no other axes, units or directions of poses "
            "and depth, no late depth, no focal lengths or principal point, no error of depth (a "
            "factor, a length, a square), no offset of the camera. What cannot be told: poses that "
            "drift or jump, a lens's distortion, and depth images that hold no depth (disparity, "
            "half floats, each frame scaled by itself)"
        ), "fault" if own.is_far_apart else "doubt"
    else:
        return "", ""
    tail = f"surfaces that two frames see then lie {left_mm:.0f} mm apart; as declared they {apart}"
    kind = "note" if best is own and main[0].is_usual else "fault"
    return f"{name}; {remedy(reading, own.reading)} ({tail})", kind


def doubts_of_poses(conventions: list[Convention], file: str, needs_proof: bool) -> Iterator[str]:
    """Why it cannot be told whether poses are read rightly, in a sentence; none where it can.

    Two frames see too little of the same; or, where proof is needed, the camera moves too little to
    tell conventions apart.
    """
    own, *others = conventions
    of_poses = [other for other in others if other.subject == "poses"]
    alike = [other.name for other in of_poses if not own.is_clearly_better(other)]
    if own.overlap < MIN_OVERLAP or np.isnan(own.apart):
        reason = f"two frames see too little of the same ({own.overlap:.0%} of the points)"
        yield f"{file} is not proved: {reason}: check it, and a piece with smaller steps"
    elif needs_proof and alike:
        reason = f"the camera moves too little to tell {len(alike)} other conventions apart"
        yield f"{file} is not proved: {reason}, such as {alike[0]}"


def shared_value(counts: Int[np.ndarray, "2 values"], frames: pd.DataFrame) -> int:
    """The depth value that many pixels share though the camera moves; 0 where there is none.

    `counts` are how often each value occurs, and in how many frames many share it.
    """
    next_most, most = np.argsort(counts[0])[-2:]
    is_often = counts[0, most] > SHARED * counts[0].sum() and np.count_nonzero(counts[0]) > _SPIKE
    # A camera's rounding makes many values frequent, but none so much more than all others.
    is_spike = counts[0, most] > _SPIKE * counts[0, next_most]
    is_shared = counts[1, most] > _SHARING * len(frames) and frames.moved_mm.median() > 0
    return int(most) if is_often and is_spike and is_shared else 0


def of_images(frames: pd.DataFrame, shared: int, often: Int[np.ndarray, "_"]) -> Iterator[str]:
    """What is wrong with images, whatever their numbers mean; `often` each depth value occurs."""
    if not frames.measured.any():
        advice = "check the depth folder, and no_depth in sequence.toml"
        yield f"no pixel that was looked at has a depth: all are 0, or saturated (65535); {advice}"
    if shared:
        found = f"{often[shared] / often.sum():.0%} of the depths are {shared}"
        yield f"{found}, which is no measurement; set no_depth = {shared} in sequence.toml"
    # The first frame repeats none, so that the share is below 1 and 1 / (1 - repeated) is finite.
    repeated = (frames.is_repeated & (frames.moved_mm > 0)).mean()
    if repeated > _MIN_REPEATED:
        found = f"{repeated:.0%} of the depth images repeat the one before, though the poses move"
        yield f"{found}: leave them out: --frames ::{1 / (1 - repeated):.0f} of map and track"
    if frames.brightness.median() < _BLACK:
        options = "--set tracking.lm.lambda_intensity=0, or tracking.sdf.lambda_color=0 for sdf"
        yield f"the colour images are black: check their folder, or track without colour: {options}"


def of_poses(frames: pd.DataFrame, recording: Recording) -> Iterator[str]:
    """What is wrong with poses that are read rightly: some lie beside their neighbours' path."""
    off = frames.off_mm / 1e3  # m
    is_odd = off > max(_OFF, _OFF_STEPS * frames.moved_mm.median() / 1e3)
    # An odd pose makes both of its neighbours off by half as much. So only the largest of three
    # frames in a row counts.
    largest_of_three = off.rolling(3, min_periods=1, center=True).max()
    odd = off[is_odd & (off == largest_of_three)]
    if len(odd):
        first = recording.color_files[odd.index[0]].name
        found = f"{len(odd)} of {len(off)} poses lie up to {100 * odd.max():.0f} cm beside the path"
        advice = "check the poses there, or leave frames out with --frames of map and track"
        yield f"{found} of their neighbours, first {first}: {advice}"


def of_units(depth: pd.Series) -> Iterator[str]:
    """What is wrong with depths that fit the poses: no camera measures them."""
    near, far = PLAUSIBLE_DEPTH
    median = depth.median()
    if median < near or median > far:
        advice = "set depth_scale, the depth values a metre, in sequence.toml"
        yield f"the median depth is {median:.3g} m, outside {near:g} to {far:g} m: {advice}"


def of_depths(frames: pd.DataFrame, depth: pd.Series, depth_scale: float) -> Iterator[str]:
    """What is worth knowing of depths that are read rightly.

    Depths and their steps are both as declared: only the ratio of the two decides.
    """
    is_far = depth > far_limit(depth)
    if is_far.any():
        low, high = depth[is_far].min(), depth[is_far].max()
        found = f"{is_far.mean():.2%} of the depths are outliers, {low:.3g} to {high:.3g} m away"
        rule = f"more than {FAR:g} times as far as nine in ten: maps and tracking leave them out"
        advice = "check the camera, or set no_depth in sequence.toml to what it gives for none"
        yield f"{found}, {rule}; {advice}"
    step_m = np.gcd.reduce(frames.depth_step) / depth_scale
    # With fewer than eight steps up to the farthest point, they may be chance.
    if _MAX_STEP * depth.median() < step_m < depth.max() / 8:
        advice = "look for those that the camera gave, or expect no better poses"
        yield f"depths come in steps of {100 * step_m:.1f} cm: {advice}"
