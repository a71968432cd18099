"""Validate a recording, and find from its own depth maps whether its numbers are read rightly."""

import textwrap
import zlib
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from nbtrack.checks import findings
from nbtrack.checks.conventions import MIN_OVERLAP, Convention, fit_all
from nbtrack.checks.misfits import Misfit, fit_causes, main_misfits
from nbtrack.checks.readings import FramePairs, Pairs, Reading, mean_apart, on_grid
from nbtrack.core.arrays import Frames, Poses
from nbtrack.data.sequence import ARRAYS, RgbdSequence
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.registry import command_line
from nbtrack.recordings.images import images_of
from nbtrack.recordings.pose_files import shifted
from nbtrack.recordings.reading import far_limit, read_frames, select_frames
from nbtrack.recordings.recording import Recording

_FRAMES_AT_ONCE = 32  # frames that are read at once; 50 MB at 640x480
_POINTS_PER_FRAME = 3000  # about, in the cloud
_N_PAIRS = 32  # pairs of frames that are compared
_QUICK_PAIRS = 16  # pairs of frames that are compared in a quick look
# Share of the depth. Smaller gaps are rounding errors, as between equal frames, and need no cause.
_ROUNDING = 1e-4
_MIN_FRAMES = 30  # with fewer, pairs share too many frames to tell a small misfit
_STRIDES = (5, 10, 20, 40)  # frames from the first to the second of a pair: both see much the same
_TURNED_DEG = 30  # a camera may turn so far within a pair: half of what most cameras see
_PRINTED = ["measured", "brightness", "moved_mm", "turned_deg"]  # columns of `DataReport.frames`
_XYZ = ["x", "y", "z"]
_LINES = textwrap.TextWrapper(98, "", "    ", break_long_words=False, break_on_hyphens=False)


@dataclass(frozen=True, eq=False)
class DataReport:
    """What a recording holds, and how well its frames agree with each other."""

    recording: Recording
    frames: pd.DataFrame  # a row for each frame that was read: see `_read`
    T_world_camera: Poses  # of all frames that have a pose, read as declared, from the origin
    # Measured points without outliers: x y z (m, world, from the recording's origin), red green
    # blue (0 to 255), depth (m).
    cloud: pd.DataFrame
    conventions: list[Convention]  # all that were compared, the declared one first
    best: Convention  # the declared one unless another is clearly better
    misfits: list[Misfit]  # fits of all causes; empty if there are too few frames to tell
    faults: list[str]  # sentences that say what is wrong
    doubts: list[str]  # sentences that say why it is unknown whether numbers are read rightly
    remarks: list[str]  # sentences about what is worth knowing of a right recording

    @property
    def warnings(self) -> list[str]:
        """All sentences about the recording, the gravest first."""
        return self.faults + self.doubts + self.remarks

    @property
    def verdict(self) -> str:
        """Whether the recording is read rightly, with the gravest reason against it."""
        if self.faults:
            return f"wrong, because {self.faults[0]}"
        return f"cannot be told: {self.doubts[0]}" if self.doubts else "read rightly"

    def __str__(self) -> str:
        recording, cloud = self.recording, self.cloud
        declared, *others = self.conventions
        # The declared convention, and the three best of the others.
        rivals = sorted((c for c in others if c.overlap > 0), key=lambda c: -c.agreement)
        compared = [declared, *rivals[:3]]
        camera = declared.reading.camera
        wide_deg = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
        near, far = cloud.depth.quantile([0.01, 0.99])
        x, y, z = np.ptp(cloud[_XYZ].quantile([0.002, 0.998]), axis=0)  # as a map's bounds
        facts = self.frames[_PRINTED].agg(["mean", "min", "max"]).T
        rows = [f"{1e3 * c.apart * c.depth_m:9.1f} mm {c.overlap:5.0%}  {c.name}" for c in compared]
        # The first fault or doubt is in the verdict.
        texts = [f"  warning: {text}" for text in (self.faults + self.doubts)[1:]]
        texts += [f"  note: {text}" for text in (*recording.notes, *self.remarks)]
        words = ["track"] if self.verdict == "read rightly" else ["data", "check"]
        lines = [
            f"{recording.name}: {recording.format.label}, {len(self.frames)} of {len(recording)} "
            f"frames have a pose, {camera.width} x {camera.height} px",
            f"  camera: focal lengths {camera.fx:.2f} and {camera.fy:.2f} px ({wide_deg:.1f} deg "
            f"wide), principal point ({camera.cx:g}, {camera.cy:g})",
            f"  depth: {near:.2f} to {far:.2f} m (1 to 99%), scene: {x:.2f} x {y:.2f} x {z:.2f} m",
            facts.to_string(float_format="{:10.2f}".format),
            "  surfaces of two frames (mm apart in the mean, share of points), read as",
            "  > (in use) " + "\n             ".join(rows),
            *map(_LINES.fill, texts),
            f"  next: {command_line(*words, str(recording.folder))}",
            "",
            _LINES.fill(f"verdict: {self.verdict}"),
        ]
        return "\n".join(lines)


def check_recording(recording: Recording, is_whole: bool = True) -> DataReport:
    """Check all frames of a recording, or without `is_whole` a few pairs of them, within seconds.

    Raises the errors of `read_frames`, and DataError if `is_whole` and no pixel has a depth.
    """
    ids = select_frames(recording, slice(None))
    T_world_camera = shifted(recording.T_world_camera[ids], -recording.origin)
    pairs = _pairs(T_world_camera, _N_PAIRS if is_whole else _QUICK_PAIRS)
    paired_ids = ids[np.union1d(pairs, [0])]  # the first frame, too: the cloud needs at least one
    sequence, frames, counts = _read(recording, ids if is_whole else paired_ids, paired_ids)
    if is_whole and not frames.measured.any():
        raise DataError(f"no pixel of {recording.name} has a depth: check its folder and no_depth")
    as_declared = Reading(recording.declared, sequence.intrinsics)
    no_depth = findings.no_depth_values(counts, len(frames), _looks_deg(T_world_camera))
    sequence.depths_mm[np.isin(sequence.depths_mm, no_depth)] = 0
    frame_pairs = FramePairs(recording, ids, sequence, pairs)
    conventions, best = fit_all(frame_pairs, as_declared)
    declared = conventions[0]
    cloud = _cloud(as_declared, sequence)
    is_far = cloud.depth > far_limit(cloud.depth)
    has_gap = best.overlap >= MIN_OVERLAP and best.apart > _ROUNDING  # that causes may explain
    has_enough = len(ids) >= _MIN_FRAMES or declared.is_far_apart  # few frames tell a large gap
    misfits = fit_causes(frame_pairs, best.reading) if has_gap and has_enough else []
    main = main_misfits(frame_pairs, best.reading, misfits)
    step_m = findings.steps_of(frames, cloud.depth, recording.declared.depth_scale)
    misread = findings.misreading(declared, best, main, step_m)  # a list of sentences by their kind
    faults = [*findings.of_images(frames, no_depth, counts[0]), *misread.get("fault", [])]
    doubts, remarks = misread.get("doubt", []), misread.get("note", [])
    if best is declared:  # otherwise the numbers of poses and depths mean nothing
        if "fault" not in misread:
            odd = _contradicted(findings.odd_poses(frames), recording, ids, no_depth, declared)
            faults += findings.of_poses(odd, len(frames), recording)
        doubts += findings.of_units(cloud.depth[~is_far])
        remarks += [*findings.of_depths(cloud.depth), *findings.of_held_poses(frames)]
    if not faults + doubts:
        doubts += list(findings.doubts_of_poses(conventions, recording, is_whole, frames))
    return DataReport(
        recording, frames, T_world_camera, cloud[~is_far], conventions=conventions, best=best,
        misfits=misfits, faults=faults, doubts=doubts, remarks=remarks,
    )  # fmt: skip


def quick_look(recording: Recording) -> str:
    """The gravest finding in a few pairs of frames, as "warning: ..." or "note: ...".

    It is an empty text if there is nothing to say, or if fewer than two frames have a pose.
    """
    if recording.has_pose.sum() < 2:
        return ""
    report = check_recording(recording, is_whole=False)
    kind = "warning" if report.faults or report.doubts else "note"
    # The recording's notes come after the check: they are complete only after images were read.
    texts = report.warnings + recording.notes
    return f"{kind}: {texts[0]}" if texts else ""


def _turned_deg(T_world_camera: Poses) -> Float[np.ndarray, "_"]:
    """The angle (degrees) by which the camera turns from each frame to the next."""
    R = T_world_camera[:, :3, :3]
    cosine = ((R[:-1] * R[1:]).sum(axis=(1, 2)) - 1) / 2  # the sum is the trace of R_a^T R_b
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def _looks_deg(T_world_camera: Poses) -> float:
    """The mean angle (degrees) between the camera's optical axis and its mean direction."""
    axes = T_world_camera[:, :3, 2]
    mean = axes.mean(axis=0)
    cosines = axes @ mean / max(np.linalg.norm(mean), 1e-9)  # of opposite axes the mean is 0
    return float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean())


def _contradicted(
    odd: pd.Series, recording: Recording, ids: Frames, no_depth: list[int], declared: Convention
) -> pd.Series:
    """The rows of `odd` whose frames' surfaces lie apart from those of the frame before or after.

    So a wrong pose is told from a camera that was moved between two frames. Surfaces lie apart if
    the mean gap is three times that of all pairs and 1 mm a metre, or unusual (our choice). Only
    the `_N_PAIRS` poses that are farthest off are looked at, which bounds the memory.
    """
    if odd.empty:
        return odd
    odd = odd.nlargest(_N_PAIRS).sort_index()
    at = np.searchsorted(ids, odd.index)
    pairs = np.hstack([[at - 1, at], [at, at + 1]])
    stored = read_frames(recording, ids[np.unique(pairs)], as_stored=True)
    depths = np.where(np.isin(stored.depths_mm, no_depth), np.uint16(0), stored.depths_mm)
    seen = FramePairs(recording, ids, replace(stored, depths_mm=depths), pairs)
    apart = [mean_apart(gaps) for gaps in seen.compare(declared.reading).area_gaps]
    limit = min(max(3 * declared.apart, 1e-3), declared.usual_apart)
    return odd[(np.reshape(apart, (2, -1)) > limit).any(axis=0)]


def _pairs(T_world_camera: Poses, maximum: int) -> Pairs:
    """At most `maximum` pairs of frames that see much the same, as indices of their poses.

    The pairs are spread over the sequence. Each of `_STRIDES` occurs about equally often, but is
    shortened if the camera usually turns by more than `_TURNED_DEG` within it. The poses may be of
    any convention, since the angles between frames are the same in all.
    """
    n_frames = len(T_world_camera)
    if n_frames < 2:
        return np.empty((2, 0), int)
    # A camera that turns less than 1 degree a frame counts as if it turned 1 degree, so that
    # nothing is divided by 0.
    step_deg = max(1.0, np.median(_turned_deg(T_world_camera)))
    longest = max(1, min(n_frames - 1, int(_TURNED_DEG / step_deg)))
    strides = np.minimum(np.resize(_STRIDES, maximum), longest)  # `resize` repeats them in turn
    first = np.rint(np.linspace(0, 1, maximum) * (n_frames - 1 - strides)).astype(int)
    return np.unique([first, first + strides], axis=1)


def _read(
    recording: Recording, ids: Frames, ids_kept: Frames
) -> tuple[RgbdSequence, pd.DataFrame, np.ndarray]:
    """Read the frames `ids`. Returns the frames `ids_kept` as a sequence, a table, and counts.

    The sequence's `depths_mm` are the depth values as the files have them, in the files' unit. The
    table has a row for each of `ids`:

    - `measured`: the share of pixels with depth; `brightness`: the mean colour, in [0, 1];
    - `depth_step`: the greatest common divisor of the frame's depth values;
    - `is_repeated`: whether the depth image is that of the row before;
    - `moved_mm`, `turned_deg`: how far a frame the camera moved and turned since the recording's
      last frame with a pose, and `off_mm`, how far it is off an even motion from there to the next
      such frame; NaN where there is none before or after.

    Of the counts (2, 65536) the first row tells how often each depth value occurs, and the second
    in how many frames a share of the pixels above `findings.SHARED` has it. Images are read in
    parts, which bounds the memory.
    """
    parts, rows = [], []
    counts = np.zeros((2, 65536), int)
    with ProgressBar("reading frames", len(ids)) as bar:
        for part_ids in np.split(ids, range(_FRAMES_AT_ONCE, len(ids), _FRAMES_AT_ONCE)):
            part = read_frames(recording, part_ids, as_stored=True)
            for values, color in zip(part.depths_mm, part.colors, strict=True):
                step = np.gcd.reduce(values, axis=None)
                n_pixels = np.bincount(values.ravel(), minlength=65536)  # by depth value
                counts[0] += n_pixels
                counts[1] += n_pixels > findings.SHARED * values.size
                rows.append(((values > 0).mean(), color.mean() / 255, step, zlib.crc32(values)))
            parts.append(part.select(np.isin(part_ids, ids_kept)))
            if len(ids) > _FRAMES_AT_ONCE:  # a single part is kept: mapping reads it again
                images_of(recording).forget()
            bar.update(len(part))
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    frames = pd.DataFrame(rows, ids, ["measured", "brightness", "depth_step", "checksum"])
    frames["is_repeated"] = frames.pop("checksum").diff() == 0
    _add_motion(frames, recording.T_world_camera)
    counts[:, 0] = 0  # the value 0 is no depth
    return replace(parts[0], **arrays), frames, counts


def _add_motion(frames: pd.DataFrame, T_world_camera: Poses) -> None:
    """Add the columns `moved_mm`, `turned_deg` and `off_mm` to the table of `_read`.

    The index of the table holds numbers of frames. `T_world_camera` has the poses of all frames.
    """
    numbers = np.flatnonzero(np.isfinite(T_world_camera[:, 0, 0]))  # of frames with a pose
    T = T_world_camera[numbers]
    moves_mm = 1e3 * np.diff(T[:, :3, 3], axis=0, prepend=np.nan)
    gaps = np.diff(numbers, prepend=-1)[:, None]  # in frames
    # From the place between both neighbours at which the frame lies in time.
    speeds = moves_mm / gaps  # mm a frame
    off_mm = (speeds - np.roll(speeds, -1, 0)) / (1 / gaps + 1 / np.roll(gaps, -1, 0))
    motion = pd.DataFrame(index=numbers)
    motion["moved_mm"] = np.linalg.norm(speeds, axis=1)
    motion["turned_deg"] = np.array([np.nan, *_turned_deg(T)]) / gaps[:, 0]
    motion["off_mm"] = np.linalg.norm(off_mm, axis=1)
    frames[motion.columns] = motion


def _cloud(as_declared: Reading, stored: RgbdSequence) -> pd.DataFrame:
    """The table `DataReport.cloud` of a sequence, but with outliers.

    `stored.depths_mm` are the depth values as the files have them. Points without depth are left
    out.
    """
    stride = max(1, round((stored.depths_mm[0].size / _POINTS_PER_FRAME) ** 0.5))
    points_camera = as_declared.points(*on_grid(stored.depths_mm, stride)).numpy()
    T = stored.T_world_camera
    points_world = points_camera @ T[:, :3, :3].mT + T[:, None, :3, 3]
    colors = stored.colors[:, ::stride, ::stride].reshape(points_camera.shape)
    table = np.concatenate([points_world, colors, points_camera[..., 2:]], axis=-1).reshape(-1, 7)
    cloud = pd.DataFrame(table, columns=[*_XYZ, "red", "green", "blue", "depth"])
    return cloud[cloud.depth > 0]
