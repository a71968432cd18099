"""Validate a recording, and find from its own depth maps whether its numbers are read rightly."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from nbtrack.core.arrays import Frames, Poses
from nbtrack.core.errors import DataError
from nbtrack.core.progress import ProgressBar
from nbtrack.data.recording import Recording
from nbtrack.data.sequence import FAR, RgbdSequence, far_limit, joined, read_frames, select_frames
from nbtrack.recordings.conventions import (
    PLAUSIBLE_DEPTH,
    Convention,
    best_convention,
    diagnosis,
    fit_all,
)
from nbtrack.recordings.misfits import (
    MAX_SHIFT,
    MIN_CORRELATION,
    Misfit,
    find_misfits,
    told_misfit,
)
from nbtrack.tracking import SdfSettings

_FRAMES_AT_ONCE, _MAX_KEPT = 32, 1000  # frames: 50 MB and 1.5 GB at 640x480
_CLOUD_FRAMES = 60  # spread over the sequence
_POINTS_PER_FRAME = 3000
# Of frames that are compared: for conventions, in a quick look, and for small misfits.
_N_PAIRS, _QUICK_PAIRS, _FIT_PAIRS = 20, 6, 60
_GAPS = (5, 10, 20, 40)  # frames between the two: they moved, and still see the same,
_TURNED_DEG = 60  # which they do where the camera has not turned by more in between
_CELL = 0.1  # m: edge of the cells of surface that coverage counts
_CUT = [0.002, 0.998]  # quantiles of points that bounds leave out, as in observed_bounds
_JUMP = 0.3  # m between consecutive frames, and five times what is usual; a hand moves 0.02
_FLICKER = 0.35  # share by which brightness may change between frames (our choice)
_SAME_VIEW_DEG = 10  # where they are turned by no more
_OFF, _OFF_STEPS = 0.05, 5  # m, and usual steps: a pose so far from the middle of its neighbours
_MIN_REPEATED = 0.05  # share of frames whose depth is that of the frame before, though they moved
_MAX_STEP = 0.01  # share of the depth between depths that a camera can tell (our choice)
_BLACK = 0.02  # brightness, in [0, 1]
_MIN_MEASURED = 0.3  # share of pixels with a depth, below which maps have holes (our choice)
# What the second-order tracker still followed, of a real recording thinned to every third frame.
_FOLLOWED_MM, _FOLLOWED_DEG = 70, 3.6
_PRINTED = ["measured", "brightness", "moved_mm", "turned_deg", "flicker"]
_XYZ, _RGB = ["x", "y", "z"], ["red", "green", "blue"]


@dataclass(frozen=True, eq=False)
class DataReport:
    """What a recording holds, and how well its frames agree with each other."""

    recording: Recording
    frames: pd.DataFrame  # what `_by_frame` tells
    T_world_camera: Poses  # of the frames that have one, as declared
    cloud: pd.DataFrame  # x y z (m, world), red green blue (0 to 255), depth (m), frame
    outliers: pd.DataFrame  # the same of depths beyond `far_limit`
    conventions: list[Convention]  # the declared one first
    best: Convention  # the declared one unless another is clearly better
    misfits: list[Misfit]  # of depth and poses, then of colours; where conventions are right
    correlation: float  # of intensities that two frames see; NaN where not looked at
    is_whole: bool  # every frame was looked at

    @property
    def warnings(self) -> list[str]:
        """What is wrong, each in a sentence; first of all how the numbers are read."""
        if not self.frames.measured.any():
            return [
                "no pixel that was looked at has a depth: all are 0, or saturated (65535); check "
                "the depth folder, and no_depth in sequence.toml"
            ]
        coarse = _says(_image_rules(self))
        told = told_misfit(self.misfits) or diagnosis(
            self.conventions, self.recording, needs_proof=self.is_whole and not coarse
        )
        is_misread = self.best is not self.conventions[0]
        others = [] if is_misread else [*_pose_rules(self), *_depth_rules(self)]
        return [*coarse, *([told] if told else []), *_says([*others, *_color_rules(self)])]

    @property
    def suggestion(self) -> str:
        """What to do first, by how the camera moved."""
        mm, deg = self.frames[["moved_mm", "turned_deg"]].quantile(0.95).fillna(0)  # not jumps
        size = np.ptp(self.cloud[_XYZ].quantile(_CUT), axis=0).max()
        unit = self.recording.declared.metres_per_unit or size / 2
        one = SdfSettings().reach(1, unit)  # of the paper's trackers
        n_steps = max(mm / 1e3 / one.position, np.radians(deg) / one.orientation)
        n_steps = max(10, math.ceil(n_steps))
        advice = f"track {self.recording.folder}; the paper's way: --method sdf --steps {n_steps}"
        if mm > _FOLLOWED_MM or deg > _FOLLOWED_DEG:
            apart = f"frames are up to {mm / 10:.0f} cm and {deg:.1f} deg apart"
            advice += f"; {apart}: if it gets lost, record slower or at a higher rate"
        return advice

    def __str__(self) -> str:
        cloud, recording, (own, *others) = self.cloud, self.recording, self.conventions
        rivals = sorted((r for r in others if r.overlap > 0), key=lambda r: r.relative)[:3]
        c = own.camera
        wide = 2 * np.degrees(np.arctan(c.width / 2 / c.fx))
        near, far = cloud.depth.quantile([0.01, 0.99])
        x, y, z = np.ptp(cloud[_XYZ].quantile(_CUT), axis=0)
        cells = (cloud[_XYZ] // _CELL).assign(frame=cloud.frame).drop_duplicates()
        n_seen = cells.frame.nunique()
        covered = (cells.groupby(_XYZ).size() >= min(3, n_seen)).mean()
        lines = [
            f"{recording.name}: {recording.format.label}, {len(self.frames)} of {len(recording)} "
            f"frames have a pose, {c.width} x {c.height} px",
            f"  camera: focal lengths {c.fx:.2f} and {c.fy:.2f} px ({wide:.1f} deg wide), "
            f"principal point ({c.cx:g}, {c.cy:g})",
            *(f"  note: {text}" for text in recording.notes),
            f"  depth: {near:.2f} to {far:.2f} m (1% and 99%)",
            f"  scene: {x:.2f} x {y:.2f} x {z:.2f} m, {covered:.0%} of the surface seen by 3 of "
            f"{n_seen} frames looked at",
            self.frames[_PRINTED]
            .agg(["mean", "min", "max"])
            .T.to_string(float_format="{:10.2f}".format),
            "  overlap of two frames' surfaces (median distance, share of points), read as",
            *(f"{1e3 * r.median_m:12.1f} mm {r.overlap:5.0%}  {r.name}" for r in (own, *rivals)),
            *["  misfits, as pairs of frames tell them (95 %)"][: len(self.misfits)],
            *(f"    {misfit}" for misfit in self.misfits),
            *(f"  warning: {text}" for text in self.warnings),
            f"  start with: {self.suggestion}",
        ]
        return "\n".join(lines)


Rules = list[tuple[bool, str]]  # whether something is so, and what to say then


def _says(rules: Rules) -> list[str]:
    return [text for is_so, text in rules if is_so]


def _pose_rules(report: DataReport) -> Rules:
    frames, files = report.frames, report.recording.color_files
    moved, off = frames.moved_mm / 1e3, frames.off_mm / 1e3
    jumps = moved[moved > max(_JUMP, 5 * moved.median())]
    odd = off[off > max(_OFF, _OFF_STEPS * moved.median())]
    odd = odd[odd == odd.rolling(3, 1, center=True).max()]  # its neighbours are off by half
    advice = "check the poses there, or leave frames out with --frames of map and track"
    return [
        (
            len(jumps) > 0,
            f"{len(jumps)} of {moved.count()} steps are longer than {_JUMP} m, first to "
            f"{''.join(files[i].name for i in jumps.index[:1])}: {advice}",
        ),
        (
            len(odd) > 0 and not len(jumps),
            f"{len(odd)} of {len(frames)} poses lie up to {100 * odd.max():.0f} cm beside the path "
            f"of their neighbours, first {''.join(files[i].name for i in odd.index[:1])}: {advice}",
        ),
    ]


def _image_rules(report: DataReport) -> Rules:
    """On depth images that tell too little, whatever their numbers mean."""
    frames, depth = report.frames, report.cloud.depth
    step = np.gcd.reduce(frames.depth_step.to_numpy()) / report.recording.declared.depth_scale
    repeated = (frames.is_repeated & (frames.moved_mm > 0)).mean()
    return [
        (
            _MAX_STEP * depth.median() < step < depth.max() / 8,
            f"depths come in steps of {100 * step:.1f} cm: look for those that the camera gave, or "
            "expect no better poses",
        ),
        (
            repeated > _MIN_REPEATED,
            f"{repeated:.0%} of the depth images repeat the one before, though the poses move: "
            f"leave them out, as with --frames ::{round(1 / (1 - repeated))} of map and track",
        ),
    ]


def _depth_rules(report: DataReport) -> Rules:
    (near, far), depth = PLAUSIBLE_DEPTH, report.cloud.depth.median()
    measured, outliers = report.frames.measured.mean(), report.outliers.depth
    share = len(outliers) / max(1, len(outliers) + len(report.cloud))
    return [
        (
            len(outliers) > 0,
            f"{share:.2%} of the depths are outliers, {outliers.min():.3g} to {outliers.max():.3g} "
            f"m away, more than {FAR:g} times as far as nine in ten: maps and tracking leave them "
            "out; check the camera, or set no_depth in sequence.toml to what it gives for none",
        ),
        (
            not near <= depth <= far,
            f"the median depth is {depth:.3g} m, outside {near:g} to {far:g} m: set depth_scale, "
            "the depth values a metre, in sequence.toml",
        ),
        (
            measured < _MIN_MEASURED,
            f"only {measured:.0%} of the pixels have a depth: stay within the camera's range, or "
            "record less glass and black; maps will have holes",
        ),
    ]


def _color_rules(report: DataReport) -> Rules:
    frames = report.frames
    flicker = frames.flicker[frames.turned_deg < _SAME_VIEW_DEG].max()
    no_color = "--set tracking.lm.lambda_intensity=0, or tracking.sdf.lambda_color=0 for sdf"
    return [
        (
            frames.brightness.median() < _BLACK,
            f"the colour images are black: check their folder, or track without colour: {no_color}",
        ),
        (
            report.correlation < MIN_CORRELATION and not told_misfit(report.misfits),
            f"colours do not belong to the depth images: of points that two frames see they "
            f"correlate by {report.correlation:.2f}; check their folder and order",
        ),
        (
            flicker > _FLICKER,
            f"brightness changes by {flicker:.0%} between two frames: fix exposure and white "
            f"balance when recording, or track without colour: {no_color}",
        ),
    ]


def check_recording(
    recording: Recording, progress: bool = False, is_whole: bool = True
) -> DataReport:
    """Read every frame of a recording and report what is there and whether it fits together.

    Of long ones only images of pairs that are compared are kept meanwhile. Unless the whole is
    asked for, only a few pairs of frames are read, which takes about a second. Raises what
    `read_frames` does, and DataError where the whole has no depth.
    """
    ids = select_frames(recording, slice(None))
    ids = ids[recording.has_pose[ids]]
    poses = recording.T_world_camera[ids]
    poses[:, :3, 3] -= recording.origin
    pairs = ids[_pairs(poses, _N_PAIRS if is_whole else _QUICK_PAIRS)]
    looked_at = kept = ids if is_whole else np.unique(pairs)
    fitted = _pairs(poses, _FIT_PAIRS, MAX_SHIFT) if is_whole else pairs[:, :0]
    if len(kept) > _MAX_KEPT:
        around = np.arange(-MAX_SHIFT, MAX_SHIFT + 1)
        kept = np.union1d(pairs, ids[np.add.outer(fitted, around)])
    sequence, frames = _read(_as_in_files(recording), looked_at, kept, progress)
    if is_whole and not frames.measured.any():
        raise DataError(f"no pixel of {recording.name} has a depth: check its folder and no_depth")
    results = fit_all(sequence, recording, np.searchsorted(kept, pairs))
    cloud, best = _cloud(results[0], sequence), best_convention(results)
    is_far = cloud.depth > far_limit(cloud.depth)
    found, correlation = [], math.nan
    if is_whole and best is results[0]:
        places = np.searchsorted(kept, ids[fitted])
        found, correlation = find_misfits(sequence, poses, fitted, places, best)
    seen = recording, frames, poses, cloud[~is_far], cloud[is_far]
    return DataReport(*seen, results, best, found, correlation, is_whole)


def quick_warning(recording: Recording) -> str:
    """The first thing that a look at a few pairs of frames finds wrong; empty where nothing is."""
    if recording.has_pose.sum() < 2:
        return ""
    return next(iter(check_recording(recording, is_whole=False).warnings), "")


def _as_in_files(recording: Recording) -> Recording:
    """The recording with depth values as they stand in the files, so that any unit can be tried."""
    declared = replace(recording.declared, depth_scale=1000.0, depth_along="axis")
    return replace(recording, declared=declared)


def _pairs(T_world_camera: Poses, maximum: int, margin: int = 0) -> Int[np.ndarray, "2 pairs"]:
    """Positions of frames that see much the same, spread over a sequence, with all gaps alike.

    None are within the margin of its ends. How far the camera turns is the same in all conventions.
    """
    n_frames = len(T_world_camera) - 2 * margin
    turns = Rotation.from_matrix(T_world_camera[:-1, :3, :3].mT @ T_world_camera[1:, :3, :3])
    turn = max(1.0, np.degrees(np.median(turns.magnitude())) if n_frames > 1 else 0.0)
    gaps = np.minimum(np.resize(_GAPS, maximum), max(1, min(n_frames - 1, int(_TURNED_DEG / turn))))
    first = margin + np.rint(np.linspace(0, 1, maximum) * (n_frames - 1 - gaps)).astype(int)
    return np.unique([first, first + gaps], axis=1)[:, : maximum * (n_frames > 1)]


def _read(
    recording: Recording, looked_at: Frames, kept: Frames, progress: bool
) -> tuple[RgbdSequence, pd.DataFrame]:
    """The frames to keep of those looked at, and what `_by_frame` tells of all, read in parts."""
    parts = []

    def images() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        with ProgressBar("reading frames", len(looked_at), progress) as bar:
            for first in range(0, len(looked_at), _FRAMES_AT_ONCE):
                part = read_frames(recording, looked_at[first : first + _FRAMES_AT_ONCE])
                parts.append(part.select(np.isin(part.frame_ids, kept)))
                yield from zip(part.depths_mm, part.colors, strict=True)
                bar.move_to(first + len(part))

    frames = _by_frame(images(), looked_at, recording.T_world_camera[looked_at])
    return joined(parts), frames


def _by_frame(
    images: Iterator[tuple[np.ndarray, np.ndarray]], numbers: Frames, T: Poses
) -> pd.DataFrame:
    """A row a frame: share measured, brightness, and changes from the frame before, if any."""
    rows, before = [], None
    for depth, color in images:
        is_repeated = before is not None and np.array_equal(depth, before)
        rows.append(
            ((depth > 0).mean(), color.mean() / 255, np.gcd.reduce(depth, None), is_repeated)
        )
        before = depth
    columns = ["measured", "brightness", "depth_step", "is_repeated"]
    frames = pd.DataFrame(rows, numbers, columns)
    levels = np.log(frames.brightness + 1e-3)  # 0 has none
    turns = Rotation.from_matrix(T[:-1, :3, :3].mT @ T[1:, :3, :3])
    moves = 1e3 * np.diff(T[:, :3, 3], axis=0)
    off_mm = np.linalg.norm(np.diff(moves, axis=0, append=np.nan), axis=1) / 2
    flicker = np.expm1(np.abs(np.diff(levels)))  # share of the darker one
    moved_mm, turned_deg = np.linalg.norm(moves, axis=1), np.degrees(turns.magnitude())
    steps = np.stack([moved_mm, turned_deg, flicker, off_mm], axis=1)
    names = ["moved_mm", "turned_deg", "flicker", "off_mm"]
    steps = pd.DataFrame(steps, frames.index[1:], names)
    return frames.join(steps[np.diff(frames.index) == 1])


def _cloud(convention: Convention, sequence: RgbdSequence) -> pd.DataFrame:
    """Coloured points of some frames, as the convention places them; depth along the axis."""
    some = sequence.select(slice(None, None, max(1, round(len(sequence) / _CLOUD_FRAMES))))
    stride = max(1, round((some.depths_mm[0].size / _POINTS_PER_FRAME) ** 0.5))
    points = convention.grid_points(some.depths_mm, stride).numpy()
    world = points @ some.T_world_camera[:, :3, :3].mT + some.T_world_camera[:, None, :3, 3]
    colors = some.colors[:, ::stride, ::stride].reshape(*points.shape)
    cloud = np.concatenate([world, colors, points[..., 2:]], axis=-1).reshape(-1, 7)
    frames = np.arange(len(some)).repeat(points.shape[1])
    cloud = pd.DataFrame(cloud, columns=[*_XYZ, *_RGB, "depth"]).assign(frame=frames)
    return cloud[cloud.depth > 0]
