"""Validate a recording, and find from its own depth maps whether its numbers are read rightly."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from nbtrack.checks.conventions import PLAUSIBLE_DEPTH, Convention, diagnosis, fit_all
from nbtrack.checks.misfits import MAX_SHIFT, MIN_CORRELATION, Misfit, find_misfits, main_misfit
from nbtrack.checks.readings import FramePairs, Pairs, Reading, on_grid
from nbtrack.core.arrays import Frames, Poses
from nbtrack.data.sequence import ARRAYS, RgbdSequence
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.reading import FAR, far_limit, read_frames, select_frames
from nbtrack.recordings.recording import Recording

_FRAMES_AT_ONCE = 32  # 50 MB at 640x480
_CLOUD_FRAMES = 60  # spread over the sequence
_POINTS_PER_FRAME = 3000
_N_PAIRS = 60  # of frames that are compared
_QUICK_PAIRS = 6  # of frames that are compared in a quick look
_MIN_FRAMES = 30  # without which pairs share too much to tell a small misfit
_GAPS = (5, 10, 20, 40)  # frames between the two of a pair: they moved, and still see the same
_TURNED_DEG = 60  # by which the camera may turn in between; more, and they see other things
_CUT = [0.002, 0.998]  # quantiles of points that bounds leave out, as in observed_bounds
# A pose is odd if it is off the middle of its neighbours by more than both: metres, and medians of
# a step. Real recordings, and rooms thinned to every twentieth frame, have up to 1.1 medians.
_OFF = 0.05
_OFF_STEPS = 2.5
_MIN_REPEATED = 0.05  # share of frames whose depth is that of the frame before, though they moved
_MAX_STEP = 0.01  # share of the depth between depths that a camera can tell (our choice)
_BLACK = 0.02  # brightness, in [0, 1]
_PRINTED = ["measured", "brightness", "moved_mm", "turned_deg"]
_XYZ = ["x", "y", "z"]


@dataclass(frozen=True, eq=False)
class DataReport:
    """What a recording holds, and how well its frames agree with each other."""

    recording: Recording
    frames: pd.DataFrame  # what `_read` tells of each
    T_world_camera: Poses  # of the frames that have one, as declared
    cloud: pd.DataFrame  # x y z (m, world), red green blue (0 to 255), depth (m); no outliers
    conventions: list[Convention]  # the declared one first
    best: Convention  # the declared one unless another is clearly better
    misfits: list[Misfit]  # of depth and poses, then of colours; where conventions are right
    warnings: list[str]  # what is wrong, each in a sentence; how numbers are read comes first

    def __str__(self) -> str:
        recording, cloud = self.recording, self.cloud
        own, *others = self.conventions
        rivals = sorted((r for r in others if r.overlap > 0), key=lambda r: -r.agreement)[:3]
        c = own.reading.camera
        wide_deg = 2 * np.degrees(np.arctan(c.width / 2 / c.fx))
        near, far = cloud.depth.quantile([0.01, 0.99])
        x, y, z = np.ptp(cloud[_XYZ].quantile(_CUT), axis=0)
        facts = self.frames[_PRINTED].agg(["mean", "min", "max"]).T
        lines = [
            f"{recording.name}: {recording.format.label}, {len(self.frames)} of {len(recording)} "
            f"frames have a pose, {c.width} x {c.height} px",
            f"  camera: focal lengths {c.fx:.2f} and {c.fy:.2f} px ({wide_deg:.1f} deg wide), "
            f"principal point ({c.cx:g}, {c.cy:g})",
            *(f"  note: {text}" for text in recording.notes),
            f"  depth: {near:.2f} to {far:.2f} m (1% and 99%)",
            f"  scene: {x:.2f} x {y:.2f} x {z:.2f} m",
            facts.to_string(float_format="{:10.2f}".format),
            "  overlap of two frames' surfaces (median distance, share of points), read as",
            *(f"{1e3 * r.median_m:12.1f} mm {r.overlap:5.0%}  {r.name}" for r in (own, *rivals)),
            f"  misfits, as pairs of frames tell them (95 %): {len(self.misfits)} looked for",
            *(f"    {misfit}" for misfit in self.misfits),
            *(f"  warning: {text}" for text in self.warnings),
            f"  start with: track {recording.folder}",
        ]
        return "\n".join(lines)


def check_recording(recording: Recording, is_whole: bool = True) -> DataReport:
    """Read every frame of a recording and report what is there and whether it fits together.

    Unless `is_whole`, only a few pairs of frames are read, in about a second. Raises what
    `read_frames` does, and DataError where the whole has no depth.
    """
    ids = select_frames(recording, slice(None))
    T_world_camera = recording.T_world_camera[ids]
    T_world_camera[:, :3, 3] -= recording.origin
    pairs = _pairs(T_world_camera, _N_PAIRS if is_whole else _QUICK_PAIRS)
    shown, kept = _kept(pairs, ids, is_whole)
    sequence, frames = _read(recording, ids if is_whole else kept, kept)
    if is_whole and not frames.measured.any():
        raise DataError(f"no pixel of {recording.name} has a depth: check its folder and no_depth")
    own = Reading(recording.declared, sequence.intrinsics)
    seen = FramePairs(recording, ids, sequence, pairs)
    conventions, best = fit_all(seen, own)
    cloud = _cloud(own, sequence.select(np.flatnonzero(np.isin(kept, ids[shown]))))
    is_right = best is conventions[0]
    misfits, correlation = [], np.nan
    if is_right and is_whole and len(ids) >= _MIN_FRAMES:
        misfits, correlation = find_misfits(seen, best.reading)
    is_far = cloud.depth > far_limit(cloud.depth)
    warnings = list(_of_depth_images(frames, cloud, recording))
    main = main_misfit(misfits)  # replaces a diagnosis, which would not say why surfaces lie apart
    needs_proof = is_whole and not warnings  # that the camera moves enough to prove poses
    warnings.append(main or diagnosis(conventions, best, recording, needs_proof))
    if is_right:  # else poses and depths mean something else than is judged here
        warnings += [*_of_poses(frames, recording), *_of_depths(cloud.depth, is_far)]
    if not main:
        warnings += _of_colors(frames.brightness, correlation)
    return DataReport(
        recording, frames, T_world_camera, cloud[~is_far], conventions=conventions, best=best,
        misfits=misfits, warnings=[text for text in warnings if text],
    )  # fmt: skip


def quick_warning(recording: Recording) -> str:
    """The first thing that a look at a few pairs of frames finds wrong; empty where nothing is."""
    if recording.has_pose.sum() < 2:
        return ""
    return next(iter(check_recording(recording, is_whole=False).warnings), "")


def _of_depth_images(
    frames: pd.DataFrame, cloud: pd.DataFrame, recording: Recording
) -> Iterator[str]:
    """What is wrong with depth images, whatever their numbers mean.

    Depths and their steps are both as declared: only the ratio of the two decides.
    """
    if not frames.measured.any():
        advice = "check the depth folder, and no_depth in sequence.toml"
        yield f"no pixel that was looked at has a depth: all are 0, or saturated (65535); {advice}"
    step_m = np.gcd.reduce(frames.depth_step) / recording.declared.depth_scale
    # With fewer than eight steps up to the farthest point, they may be chance.
    if _MAX_STEP * cloud.depth.median() < step_m < cloud.depth.max() / 8:
        advice = "look for those that the camera gave, or expect no better poses"
        yield f"depths come in steps of {100 * step_m:.1f} cm: {advice}"
    # The first frame repeats none, so that the share is below 1 and 1 / (1 - repeated) is finite.
    repeated = (frames.is_repeated & (frames.moved_mm > 0)).mean()
    if repeated > _MIN_REPEATED:
        found = f"{repeated:.0%} of the depth images repeat the one before, though the poses move"
        every = round(1 / (1 - repeated))
        yield f"{found}: leave them out, as with --frames ::{every} of map and track"


def _of_poses(frames: pd.DataFrame, recording: Recording) -> Iterator[str]:
    """What is wrong with poses that are read rightly: some lie beside their neighbours' path."""
    off = frames.off_mm / 1e3  # m
    is_odd = off > max(_OFF, _OFF_STEPS * frames.moved_mm.median() / 1e3)
    # Both neighbours of an odd pose are off by half as much: of three in a row the worst counts.
    odd = off[is_odd & (off == off.rolling(3, 1, center=True).max())]
    if len(odd):
        first = recording.color_files[odd.index[0]].name
        found = f"{len(odd)} of {len(off)} poses lie up to {100 * odd.max():.0f} cm beside the path"
        advice = "check the poses there, or leave frames out with --frames of map and track"
        yield f"{found} of their neighbours, first {first}: {advice}"


def _of_depths(depth: pd.Series, is_far: pd.Series) -> Iterator[str]:
    """What is wrong with depths that are read rightly: no camera measures them."""
    if is_far.any():
        low, high = depth[is_far].min(), depth[is_far].max()
        found = f"{is_far.mean():.2%} of the depths are outliers, {low:.3g} to {high:.3g} m away"
        rule = f"more than {FAR:g} times as far as nine in ten: maps and tracking leave them out"
        advice = "check the camera, or set no_depth in sequence.toml to what it gives for none"
        yield f"{found}, {rule}; {advice}"
    near, far = PLAUSIBLE_DEPTH
    median = depth[~is_far].median()
    if median < near or median > far:
        advice = "set depth_scale, the depth values a metre, in sequence.toml"
        yield f"the median depth is {median:.3g} m, outside {near:g} to {far:g} m: {advice}"


def _of_colors(brightness: pd.Series, correlation: float) -> Iterator[str]:
    """What is wrong with colours; a correlation that is not known is NaN, and nothing is said."""
    if brightness.median() < _BLACK:
        options = "--set tracking.lm.lambda_intensity=0, or tracking.sdf.lambda_color=0 for sdf"
        yield f"the colour images are black: check their folder, or track without colour: {options}"
    if correlation < MIN_CORRELATION:
        found = f"of points that two frames see they correlate by {correlation:.2f}"
        yield f"colours do not belong to the depth images: {found}; check their folder and order"


def _turned_deg(T_world_camera: Poses) -> Float[np.ndarray, "_"]:
    """How far the camera turns from frame to frame, by the trace of the rotation in between."""
    R = T_world_camera[:, :3, :3]
    cosine = ((R[:-1] * R[1:]).sum(axis=(1, 2)) - 1) / 2  # the sum is the trace of R_a^T R_b
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def _pairs(T_world_camera: Poses, maximum: int) -> Pairs:
    """At most `maximum` pairs of frames that see much the same, as indices of their poses.

    They are spread over the sequence, and every gap of `_GAPS` occurs about equally often. How far
    the camera turns, which limits the gaps, is the same in all conventions.
    """
    n_frames = len(T_world_camera)
    if n_frames < 2:
        return np.empty((2, 0), int)
    # At least 1, so that nothing is divided by 0; up to there no gap of `_GAPS` is limited.
    step_deg = max(1.0, np.median(_turned_deg(T_world_camera)))
    largest_gap = max(1, min(n_frames - 1, int(_TURNED_DEG / step_deg)))
    gaps = np.minimum(np.resize(_GAPS, maximum), largest_gap)
    first = np.rint(np.linspace(0, 1, maximum) * (n_frames - 1 - gaps)).astype(int)
    return np.unique([first, first + gaps], axis=1)


def _kept(pairs: Pairs, ids: Frames, is_whole: bool) -> tuple[Frames, Frames]:
    """Which frames' points are shown, as indices in `ids`, and ids of those whose images are kept.

    If `is_whole`, frames spread over the recording are shown, and kept are these, the compared
    frames and the neighbours of these, which `find_misfits` needs. In a quick look the frames that
    are compared are both shown and kept.
    """
    compared = np.unique(pairs)
    if not is_whole:
        return compared, ids[compared]
    last = len(ids) - 1
    shown = np.unique(np.linspace(0, last, _CLOUD_FRAMES).astype(int))
    shifts = np.arange(-MAX_SHIFT, MAX_SHIFT + 1)
    return shown, ids[np.union1d(np.add.outer(compared, shifts).clip(0, last), shown)]


def _read(
    recording: Recording, looked_at: Frames, kept: Frames
) -> tuple[RgbdSequence, pd.DataFrame]:
    """The frames to be kept, as a sequence, and a table with a row for each frame looked at.

    Images are read in parts, so that memory holds few besides those kept; those of a single part
    are left for whoever reads next. `depths_mm` are the files' values, for any reading of them.
    A row holds the share that is measured, the brightness in [0, 1], the greatest number that
    divides all depth values, whether these are those of the row before, by what the camera moved
    and turned since the frame before, and how far it is off the middle between the frames before
    and after; NaN where one of these has no pose.
    """
    parts = []
    rows = []
    is_short = len(looked_at) <= _FRAMES_AT_ONCE
    with ProgressBar("reading frames", len(looked_at)) as bar:
        for ids in np.split(looked_at, range(_FRAMES_AT_ONCE, len(looked_at), _FRAMES_AT_ONCE)):
            part = read_frames(recording, ids, as_stored=True, is_kept=is_short)
            for values, color in zip(part.depths_mm, part.colors, strict=True):
                step = np.gcd.reduce(values, axis=None)
                rows.append(((values > 0).mean(), color.mean() / 255, step, zlib.crc32(values)))
            parts.append(part.select(np.isin(ids, kept)))
            bar.update(len(part))
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    frames = pd.DataFrame(rows, looked_at, ["measured", "brightness", "depth_step", "checksum"])
    frames["is_repeated"] = frames.pop("checksum").diff() == 0
    T_world_camera = recording.T_world_camera
    moves_mm = 1e3 * np.diff(T_world_camera[:, :3, 3], axis=0, prepend=np.nan)
    off_mm = np.diff(moves_mm, axis=0, append=np.nan) / 2  # from the middle of both neighbours
    frames["moved_mm"] = np.linalg.norm(moves_mm, axis=1)[looked_at]
    frames["turned_deg"] = np.array([np.nan, *_turned_deg(T_world_camera)])[looked_at]
    frames["off_mm"] = np.linalg.norm(off_mm, axis=1)[looked_at]
    return replace(parts[0], **arrays), frames


def _cloud(own: Reading, stored: RgbdSequence) -> pd.DataFrame:
    """Coloured points (m, world) of some frames, as `own` reads them, with the columns of `cloud`.

    `stored` has the files' own values as `depths_mm`.
    """
    stride = max(1, round((stored.depths_mm[0].size / _POINTS_PER_FRAME) ** 0.5))
    points_camera = own.points(*on_grid(stored.depths_mm, stride)).numpy()
    T = stored.T_world_camera
    points_world = points_camera @ T[:, :3, :3].mT + T[:, None, :3, 3]
    colors = stored.colors[:, ::stride, ::stride].reshape(points_camera.shape)
    table = np.concatenate([points_world, colors, points_camera[..., 2:]], axis=-1).reshape(-1, 7)
    cloud = pd.DataFrame(table, columns=[*_XYZ, "red", "green", "blue", "depth"])
    return cloud[cloud.depth > 0]
