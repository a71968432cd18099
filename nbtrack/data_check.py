"""Validate a sequence folder, and prove from its own depth maps that its poses are read rightly."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from tqdm.auto import tqdm

from nbtrack.bounds import SceneBounds, observed_bounds
from nbtrack.camera import swap_opengl_opencv
from nbtrack.conventions import (
    FAR_APART,
    LAYOUT_CONVENTION,
    LEAST_OVERLAP,
    ConventionFit,
    best_fit,
    fit_conventions,
    fits_alike,
)
from nbtrack.data import MILLIMETRE, Sequence, list_frames, read_poses, read_sequence
from nbtrack.errors import DataError
from nbtrack.metrics import rotation_errors_deg, translation_errors

_FRAMES_AT_ONCE = 32  # read at a time: 50 MB at 640x480
_SPREAD_FRAMES = 60  # over the sequence, for its bounds; with the pairs at most 60 MB
_N_PAIRS = 20
_GAPS = (5, 10, 15)  # frames between the two of a pair: they moved, and still see the same
_JUMP = 0.3  # m between consecutive frames; a hand moves 0.02
_PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, median of a depth camera's measurements


@dataclass(frozen=True)
class Motion:
    """Motion between consecutive frames; NaN where there are none."""

    mean_mm: float
    max_mm: float
    mean_deg: float
    max_deg: float


@dataclass(frozen=True)
class DataReport:
    """What a sequence folder holds, and how well its frames agree with each other."""

    name: str
    frames: int
    excluded_frames: int  # without a pose
    size: tuple[int, int]  # pixels, width and height
    focal: float  # pixels
    field_of_view_deg: float  # horizontal
    depth_range: tuple[float, float]  # m, 1 % and 99 % of the measured pixels
    measured: float  # share of pixels with a depth
    motion: Motion
    bounds: SceneBounds
    median_overlap_m: float  # as the file stands; NaN for a single frame
    best_convention: str
    candidates: tuple[ConventionFit, ...]  # every reading of the pose file, the layout's own first
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        corners = (self.bounds.minimum, self.bounds.maximum)
        sides = [f"{high - low:.2f}" for low, high in zip(*corners, strict=True)]
        own, motion = self.candidates[0], self.motion
        middle = f"({self.size[0] / 2:g}, {self.size[1] / 2:g})"
        rows = [
            ("frames", f"{self.frames} ({self.excluded_frames} more without a pose)"),
            ("size", f"{self.size[0]} x {self.size[1]} px"),
            ("focal length", f"{self.focal:.2f} px ({self.field_of_view_deg:.1f} deg wide)"),
            ("principal point", f"{middle} px, the middle of the image (assumed)"),
            ("depth", f"{self.depth_range[0]:.2f} to {self.depth_range[1]:.2f} m (1 % and 99 %)"),
            ("measured", f"{100 * self.measured:.1f} % of the pixels"),
            ("motion", f"mean {motion.mean_mm:.1f} mm, {motion.mean_deg:.2f} deg a frame"),
            ("", f"max {motion.max_mm:.1f} mm, {motion.max_deg:.2f} deg a frame"),
            ("bounds", f"{' x '.join(sides)} m"),
            ("overlap", f"{1e3 * own.median_m:.1f} mm median, {100 * own.overlap:.0f} % of points"),
            ("poses fit as", self.best_convention),
        ]
        lines = [f"{self.name}", *(f"  {label:<16}{text}" for label, text in rows)]
        lines += ["  overlap by reading of the pose file (median, share of points)"]
        lines += [f"    {_fit_text(fit)}" for fit in self._closest(4)]
        lines += [f"  warning: {text}" for text in self.warnings]
        return "\n".join(lines)

    def _closest(self, count: int) -> list[ConventionFit]:
        """The layout's own reading and the nearest rivals with some overlap."""
        own, *others = self.candidates
        rivals = sorted((f for f in others if f.overlap > 0), key=lambda fit: fit.median_m)
        return [own, *rivals[: count - 1]]


def _fit_text(fit: ConventionFit) -> str:
    return f"{1e3 * fit.median_m:8.1f} mm {100 * fit.overlap:4.0f} %  {fit.convention.name}"


def check_sequence(
    folder: Path | str,
    depth_folder: str | None = None,
    pose_file: str = "poses.txt",
    progress: bool = False,
) -> DataReport:
    """Read every frame of a folder and report what is there and whether it fits together.

    Frames are read a few at a time: at 640x480 that takes 0.3 GB, however long the sequence is.

    Args:
        depth_folder, pose_file, progress: as `read_sequence` takes them.

    Raises:
        DataError, MissingError: as `read_sequence` raises them, or no pixel has a depth.
    """
    folder = Path(folder)
    scan = _scan(folder, depth_folder, pose_file, progress)
    kept, camera = scan.kept, scan.kept.intrinsics
    bounds = observed_bounds(kept)  # first: it refuses a sequence without any depth
    low, middle, high = (_quantile_m(scan.depth_counts, q) for q in (0.01, 0.5, 0.99))
    file_poses = swap_opengl_opencv(kept.T_world_camera)
    pairs = np.searchsorted(kept.frame_ids, scan.frame_ids[_pairs(len(scan.frame_ids))])
    fits = fit_conventions(camera, kept.depths_mm, file_poses, pairs)
    motion, jumps = _motion(scan.T_world_camera, scan.frame_ids)
    return DataReport(
        name=kept.name,
        frames=len(scan.frame_ids),
        excluded_frames=kept.excluded_frames,
        size=(camera.width, camera.height),
        focal=camera.fx,
        field_of_view_deg=2 * float(np.degrees(np.arctan(camera.cx / camera.fx))),
        depth_range=(low, high),
        measured=float(1 - scan.depth_counts[0] / scan.depth_counts.sum()),
        motion=motion,
        bounds=bounds,
        median_overlap_m=fits[0].median_m,
        best_convention=best_fit(fits).convention.name,
        candidates=tuple(fits),
        warnings=(*_pose_warnings(fits, len(pairs), pose_file), *jumps, *_depth_warnings(middle)),
    )


@dataclass(frozen=True)
class _Scan:
    """One pass over a folder: counts of all frames, pixels of a few."""

    frame_ids: Int[np.ndarray, "frames"]
    T_world_camera: Float[np.ndarray, "frames 4 4"]  # OpenCV camera axes
    depth_counts: Int[np.ndarray, "65536"]  # pixels by depth in mm
    kept: Sequence  # some of the frames; its colors are black


def _scan(folder: Path, depth_folder: str | None, pose_file: str, progress: bool) -> _Scan:
    image_files, _ = list_frames(folder, depth_folder)
    has_pose = np.isfinite(read_poses(folder / pose_file)).all(axis=(1, 2))
    wanted = np.flatnonzero(has_pose)[_kept_positions(int(has_pose.sum()))]
    depth_counts = np.zeros(1 << 16, np.int64)
    poses, depths, frame_ids, first = [], [], [], None
    starts = range(0, len(image_files), _FRAMES_AT_ONCE)
    bar = tqdm(
        starts, "checking", unit=f"{_FRAMES_AT_ONCE} frames", disable=not progress, delay=1.0
    )
    for start in bar:
        stretch = slice(start, start + _FRAMES_AT_ONCE)
        if not has_pose[stretch].any():
            continue
        part = read_sequence(folder, stretch, depth_folder, pose_file)
        first = first or part
        _check_same_size(first, part, image_files)
        depth_counts += np.bincount(part.depths_mm.ravel(), minlength=1 << 16)
        frame_ids.append(part.frame_ids)
        poses.append(part.T_world_camera)
        depths.append(part.depths_mm[np.isin(part.frame_ids, wanted)])
    if first is None:
        first = read_sequence(folder, slice(None), depth_folder, pose_file)  # says what is wrong
    all_ids, all_poses, kept_depths = map(np.concatenate, (frame_ids, poses, depths))
    black = np.broadcast_to(np.uint8(0), (*kept_depths.shape, 3))
    is_kept = np.isin(all_ids, wanted)
    kept = Sequence(
        first.name, first.intrinsics, black, kept_depths, all_poses[is_kept], all_ids[is_kept],
        len(image_files) - len(all_ids),
    )  # fmt: skip
    return _Scan(all_ids, all_poses, depth_counts, kept)


def _check_same_size(first: Sequence, part: Sequence, image_files: list[Path]) -> None:
    if part.intrinsics != first.intrinsics:
        found, wanted = part.intrinsics, first.intrinsics
        raise DataError(
            f"{image_files[part.frame_ids[0]]} is {found.width}x{found.height} but "
            f"{image_files[first.frame_ids[0]]} is {wanted.width}x{wanted.height}: all images "
            "and depth maps need one size; resize them first"
        )


def _pairs(n_frames: int) -> Int[np.ndarray, "pairs 2"]:
    """Positions of frame pairs, spread over the sequence, with all gaps alike."""
    pairs = set()
    for i in range(_N_PAIRS):
        gap = min(_GAPS[i % len(_GAPS)], n_frames - 1)
        first = round((n_frames - 1 - gap) * i / (_N_PAIRS - 1))
        pairs |= {(first, first + gap)} if gap > 0 else set()
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _kept_positions(n_frames: int) -> Int[np.ndarray, "kept"]:
    """The frames of the pairs, and enough others to know the room's extent."""
    spread = np.linspace(0, max(0, n_frames - 1), min(n_frames, _SPREAD_FRAMES)).astype(np.int64)
    return np.union1d(spread, _pairs(n_frames))


def _quantile_m(depth_counts: Int[np.ndarray, "65536"], share: float) -> float:
    cumulative = depth_counts[1:].cumsum()
    return float(1 + np.searchsorted(cumulative, share * cumulative[-1])) * MILLIMETRE


def _motion(
    T_world_camera: Float[np.ndarray, "frames 4 4"], frame_ids: Int[np.ndarray, "frames"]
) -> tuple[Motion, list[str]]:
    """Motion over the pairs of frames without a gap between, and warnings of jumps."""
    first = np.flatnonzero(np.diff(frame_ids) == 1)
    if len(first) == 0:
        return Motion(*[float("nan")] * 4), []
    before, after = T_world_camera[first], T_world_camera[first + 1]
    steps_m, steps_deg = translation_errors(after, before), rotation_errors_deg(after, before)
    motion = Motion(
        1e3 * float(steps_m.mean()), 1e3 * float(steps_m.max()),
        float(steps_deg.mean()), float(steps_deg.max()),
    )  # fmt: skip
    jumps = np.flatnonzero(steps_m > _JUMP)
    if len(jumps) == 0:
        return motion, []
    worst = steps_m.argmax()
    return motion, [
        f"{len(jumps)} of {len(first)} steps between frames are longer than {_JUMP} m, the "
        f"longest {steps_m[worst]:.2f} m after frame {frame_ids[first[worst]]}: check the poses "
        "there, or leave the frames out with --frames"
    ]


def _pose_warnings(
    fits: list[ConventionFit], n_pairs: int, pose_file: str
) -> list[str]:
    own, best = fits[0], best_fit(fits)
    if n_pairs == 0:
        return [f"{pose_file} is not proved: that takes two frames with a pose"]
    found = f"lie {1e3 * own.median_m:.0f} mm apart" if own.overlap else "never meet"
    if best is not own:
        return [
            f"{pose_file} fits {best.convention.name}: surfaces then lie {1e3 * best.median_m:.0f} "
            f"mm apart, but {found} as {LAYOUT_CONVENTION.name}, which the layout demands; "
            f"convert with poses = {best.convention.conversion}"
        ]
    if own.overlap < LEAST_OVERLAP or own.median_m > FAR_APART:
        return [
            f"surfaces that two frames see {found} (median, {100 * own.overlap:.0f} % of the "
            "points overlap) and no other reading of the poses fits: check focal.txt, the "
            "principal point (assumed in the middle), the depth unit (millimetres) and "
            f"{pose_file}"
        ]
    alike = [fit for fit in fits[1:] if fits_alike(own, fit)]
    if not alike:
        return []
    return [
        f"{pose_file} is not proved: the camera moves too little to tell {len(alike)} other "
        f"readings apart, such as {alike[0].convention.name}"
    ]


def _depth_warnings(median_m: float) -> list[str]:
    low, high = _PLAUSIBLE_DEPTH
    if low <= median_m <= high:
        return []
    return [
        f"the median depth is {median_m:.3g} m, outside {low:g} to {high:g} m: depth must be in "
        "millimetres; multiply other units by the factor between, and write the maps again"
    ]
