"""Validate a recording, and find from its own depth maps whether its numbers are read rightly."""

import shlex
import textwrap
import zlib
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from nbtrack.checks import findings
from nbtrack.checks.conventions import MIN_OVERLAP, Convention, fit_all
from nbtrack.checks.misfits import CAUSES, Misfit, fit, main_misfits
from nbtrack.checks.readings import FramePairs, Pairs, Reading, on_grid
from nbtrack.core.arrays import Frames, Poses
from nbtrack.data.sequence import ARRAYS, RgbdSequence
from nbtrack.machinery.errors import DataError
from nbtrack.machinery.progress import ProgressBar
from nbtrack.recordings.images import images_of
from nbtrack.recordings.reading import far_limit, read_frames, select_frames
from nbtrack.recordings.recording import Recording

_FRAMES_AT_ONCE = 32  # 50 MB at 640x480
_POINTS_PER_FRAME = 3000
_N_PAIRS = 32  # of frames that are compared
_QUICK_PAIRS = 16  # of frames that are compared in a quick look
_MIN_FRAMES = 30  # without which pairs share too much to tell a small misfit
_GAPS = (5, 10, 20, 40)  # frames between the two of a pair: they moved, and still see the same
_TURNED_DEG = 30  # by which the camera may turn in between: half of what most cameras see
_PRINTED = ["measured", "brightness", "moved_mm", "turned_deg"]
_XYZ = ["x", "y", "z"]
_LINES = textwrap.TextWrapper(98, "", "    ", break_long_words=False, break_on_hyphens=False)


@dataclass(frozen=True, eq=False)
class DataReport:
    """What a recording holds, and how well its frames agree with each other."""

    recording: Recording
    frames: pd.DataFrame  # what `_read` tells of each
    T_world_camera: Poses  # of the frames that have one, as declared
    cloud: pd.DataFrame  # x y z (m, world), red green blue (0 to 255), depth (m); no outliers
    conventions: list[Convention]  # the declared one first
    best: Convention  # the declared one unless another is clearly better
    misfits: list[Misfit]  # what may be a little off; where there are frames enough to tell
    faults: list[str]  # what is wrong, each in a sentence; how numbers are read comes first
    doubts: list[str]  # why it cannot be told whether numbers are read rightly
    remarks: list[str]  # what is worth knowing of a recording that is right

    @property
    def warnings(self) -> list[str]:
        """All that is said of the recording, the gravest first."""
        return self.faults + self.doubts + self.remarks

    @property
    def verdict(self) -> str:
        """Whether the recording is read rightly."""
        if self.faults:
            return f"wrong, because {self.faults[0]}"
        return f"cannot be told: {self.doubts[0]}" if self.doubts else "read rightly"

    def __str__(self) -> str:
        recording, cloud = self.recording, self.cloud
        declared, *others = self.conventions
        rivals = sorted((c for c in others if c.overlap > 0), key=lambda c: -c.agreement)[:3]
        compared = [declared, *rivals]
        camera = declared.reading.camera
        wide_deg = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
        near, far = cloud.depth.quantile([0.01, 0.99])
        x, y, z = np.ptp(cloud[_XYZ].quantile([0.002, 0.998]), axis=0)  # as bounds
        facts = self.frames[_PRINTED].agg(["mean", "min", "max"]).T
        rows = [f"{1e3 * c.apart * c.depth_m:9.1f} mm {c.overlap:5.0%}  {c.name}" for c in compared]
        # The first fault or doubt is in the verdict.
        texts = [f"  warning: {text}" for text in (self.faults + self.doubts)[1:]]
        texts += [f"  note: {text}" for text in (*recording.notes, *self.remarks)]
        command = "data check" if self.faults else "track"
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
            f"  next: python -m nbtrack {command} {shlex.quote(str(recording.folder))}",
            "",
            _LINES.fill(f"verdict: {self.verdict}"),
        ]
        return "\n".join(lines)


def check_recording(recording: Recording, is_whole: bool = True) -> DataReport:
    """Read every frame of a recording and report what is there and whether it fits together.

    Unless `is_whole`, only some pairs of frames are read, in a second or two. Raises what
    `read_frames` does, and DataError where the whole has no depth.
    """
    ids = select_frames(recording, slice(None))
    T_world_camera = recording.T_world_camera[ids]
    T_world_camera[:, :3, 3] -= recording.origin
    pairs = _pairs(T_world_camera, _N_PAIRS if is_whole else _QUICK_PAIRS)
    kept = ids[np.union1d(pairs, [0])]  # those of pairs; the first is shown, also without a pair
    sequence, frames, counts = _read(recording, ids if is_whole else kept, kept)
    if is_whole and not frames.measured.any():
        raise DataError(f"no pixel of {recording.name} has a depth: check its folder and no_depth")
    own = Reading(recording.declared, sequence.intrinsics)
    shared = findings.shared_value(counts, frames)
    sequence.depths_mm[sequence.depths_mm == shared] = 0
    compared = FramePairs(recording, ids, sequence, pairs)
    conventions, best = fit_all(compared, own)
    cloud = _cloud(own, sequence)
    is_far = cloud.depth > far_limit(cloud.depth)
    is_own = best is conventions[0]
    causes = CAUSES if is_own and len(ids) >= _MIN_FRAMES and best.overlap >= MIN_OVERLAP else {}
    misfits = [fit(compared, own, *cause) for cause in ProgressBar("fitting", causes.items())]
    text, kind = findings.misreading(conventions[0], best, main_misfits(compared, own, misfits))
    texts = {name: [text] if kind == name else [] for name in ("fault", "doubt", "note")}
    faults = [*findings.of_images(frames, shared, counts[0]), *texts["fault"]]
    remarks, doubts = texts["note"], texts["doubt"]
    if is_own:  # else the numbers of poses and depths are read wrongly, and tell nothing
        faults += findings.of_poses(frames, recording) if kind != "fault" else []
        faults += findings.of_units(cloud.depth[~is_far])
        remarks += findings.of_depths(frames, cloud.depth, own.declared.depth_scale)
    if not (faults or doubts):
        doubts = list(findings.doubts_of_poses(conventions, recording.pose_file.name, is_whole))
    return DataReport(
        recording, frames, T_world_camera, cloud[~is_far], conventions=conventions, best=best,
        misfits=misfits, faults=faults, doubts=doubts, remarks=remarks,
    )  # fmt: skip


def quick_look(recording: Recording) -> str:
    """The gravest that a look at a few pairs of frames finds, as "warning: ..." or "note: ...".

    It is empty where nothing is found.
    """
    if recording.has_pose.sum() < 2:
        return ""
    report = check_recording(recording, is_whole=False)
    kind = "warning" if report.faults or report.doubts else "note"
    return next((f"{kind}: {text}" for text in report.warnings), "")


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


def _read(
    recording: Recording, looked_at: Frames, kept: Frames
) -> tuple[RgbdSequence, pd.DataFrame, np.ndarray]:
    """The frames `kept` as a sequence, a table with a row for each of `looked_at`, and counts.

    Counts (2, 65536) are how often each depth value occurs, and in how many frames many pixels
    share it. `depths_mm` are the files' values, for any reading of them. Images are read in parts,
    to bound the memory; those of a single part are kept for the next read.
    A row holds the share of pixels with depth, the brightness in [0, 1], the greatest common
    divisor of all depth values, and whether these are the same as in the row before. It also holds
    how far the camera moved and turned since the frame before, and how far it is off the middle
    between the frames before and after; NaN where one of these has no pose.
    """
    parts = []
    rows = []
    counts = np.zeros((2, 65536), int)
    with ProgressBar("reading frames", len(looked_at)) as bar:
        for ids in np.split(looked_at, range(_FRAMES_AT_ONCE, len(looked_at), _FRAMES_AT_ONCE)):
            part = read_frames(recording, ids, as_stored=True)
            for values, color in zip(part.depths_mm, part.colors, strict=True):
                step = np.gcd.reduce(values, axis=None)
                of_frame = np.bincount(values.ravel(), minlength=65536)
                counts += of_frame, of_frame > findings.SHARED * values.size
                rows.append(((values > 0).mean(), color.mean() / 255, step, zlib.crc32(values)))
            parts.append(part.select(np.isin(ids, kept)))
            if len(looked_at) > _FRAMES_AT_ONCE:
                images_of(recording).forget()
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
    counts[:, 0] = 0  # no depth
    return replace(parts[0], **arrays), frames, counts


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
