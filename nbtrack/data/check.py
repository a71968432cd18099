"""Validate a recording, and find from its own depth maps whether its numbers are read rightly."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.errors import DataError
from nbtrack.data.advice import Advice, advise
from nbtrack.data.readers import FORMATS, Recording, open_recording, ray_lengths
from nbtrack.data.readings import Fit, best_fit, fit_readings, readings
from nbtrack.data.scan import Cloud, Scan, scan_recording
from nbtrack.data.sequence import MILLIMETRE, RgbdSequence, observed_bounds
from nbtrack.tracking.metrics import rotation_errors_deg, translation_errors


@dataclass(frozen=True)
class Motion:
    """Motion between consecutive frames; NaN where there are none."""

    mean_mm: float
    max_mm: float
    mean_deg: float
    max_deg: float


@dataclass(frozen=True, eq=False)
class DataReport:
    """What a recording holds, and how well its frames agree with each other."""

    name: str
    format: str
    frames: int
    excluded_frames: int  # without a pose
    size: tuple[int, int]  # pixels, width and height
    focal: tuple[float, float]  # pixels, fx and fy
    principal_point: tuple[float, float]  # pixels; centres at integer + 0.5
    field_of_view_deg: float  # horizontal
    depth_range: tuple[float, float]  # m, 1 % and 99 % of the measured pixels
    measured: float  # share of pixels with a depth
    measured_least: float  # the same, of the frame that has the fewest
    motion: Motion
    rate_hz: float  # frames a second of the recording
    brightness: tuple[float, float]  # of the darkest and the brightest frame, 0 to 1
    brightness_step: float  # largest change between consecutive frames, as a share
    seen_thrice: float  # share of the surface (10 cm cells) that three of the kept frames saw
    bounds: SceneBounds
    fits: tuple[Fit, ...]  # every reading, the declared one first
    advice: Advice
    cloud: Cloud
    T_world_camera: Float[np.ndarray, "frames 4 4"]  # OpenCV camera axes

    @property
    def best(self) -> Fit:
        """The reading that fits: the declared one unless another is clearly better."""
        return best_fit(list(self.fits))

    @property
    def median_overlap_m(self) -> float:
        """Median distance between surfaces that two frames see, as declared; NaN for one frame."""
        return self.fits[0].median_m

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong, each in a sentence."""
        return self.advice.warnings

    @property
    def title(self) -> str:
        """The finding, for a picture."""
        agree = f"surfaces of two frames lie {1e3 * self.median_overlap_m:.1f} mm apart (median)"
        return f"{self.name}: {agree}" if self.best is self.fits[0] else self.warnings[0]

    def __str__(self) -> str:
        lines = [f"{self.name}", *(f"  {label:<16}{text}" for label, text in self._rows())]
        lines += ["  overlap by reading (median, share of points)"]
        lines += [f"    {_fit_text(fit)}" for fit in self._closest(4)]
        lines += [f"  warning: {text}" for text in self.warnings]
        return "\n".join([*lines, f"  start with: {self.advice.suggestion}"])

    def _rows(self) -> list[tuple[str, str]]:
        corners = (self.bounds.minimum, self.bounds.maximum)
        sides = [f"{high - low:.2f}" for low, high in zip(*corners, strict=True)]
        own, motion, (fx, fy) = self.fits[0], self.motion, self.focal
        focal = f"{fx:.2f}" if abs(fx - fy) < 5e-3 else f"{fx:.2f} and {fy:.2f}"
        is_middle = np.allclose(self.principal_point, np.array(self.size) / 2)
        where = ", the middle of the image" if is_middle else ""
        low, high = self.brightness
        return [
            ("format", FORMATS[self.format].label),
            ("frames", f"{self.frames} ({self.excluded_frames} more without a pose)"),
            ("size", f"{self.size[0]} x {self.size[1]} px"),
            ("focal length", f"{focal} px ({self.field_of_view_deg:.1f} deg wide)"),
            ("principal point", "({:g}, {:g}) px".format(*self.principal_point) + where),
            ("depth", f"{self.depth_range[0]:.2f} to {self.depth_range[1]:.2f} m (1 % and 99 %)"),
            ("measured", f"{100 * self.measured:.1f} % of the pixels, at least "
                         f"{100 * self.measured_least:.0f} % in a frame"),
            ("motion", f"mean {motion.mean_mm:.1f} mm, {motion.mean_deg:.2f} deg a frame"),
            ("", f"max {motion.max_mm:.1f} mm, {motion.max_deg:.2f} deg a frame"),
            ("exposure", f"brightness {low:.2f} to {high:.2f}, by at most "
                         f"{100 * self.brightness_step:.0f} % between frames"),
            ("bounds", f"{' x '.join(sides)} m"),
            ("coverage", f"{100 * self.seen_thrice:.0f} % of the surface seen by 3 of "
                         f"{len(np.unique(self.cloud.frames))} frames looked at"),
            ("overlap", f"{1e3 * own.median_m:.1f} mm median, {100 * own.overlap:.0f} % of points"),
            ("read as", own.reading.name),
            ("fits best as", self.best.reading.name),
        ]  # fmt: skip

    def _closest(self, count: int) -> list[Fit]:
        """The declared reading and the nearest rivals with some overlap."""
        own, *others = self.fits
        rivals = sorted((f for f in others if f.overlap > 0), key=lambda fit: fit.relative)
        return [own, *rivals[: count - 1]]


def _fit_text(fit: Fit) -> str:
    return f"{1e3 * fit.median_m:8.1f} mm {100 * fit.overlap:4.0f} %  {fit.reading.name}"


def check_sequence(
    folder: Path | str,
    depth_folder: str | None = None,
    pose_file: str | None = None,
    progress: bool = False,
    format: str | None = None,
) -> DataReport:
    """Read every frame of a recording and report what is there and whether it fits together.

    Args:
        folder, depth_folder, pose_file, progress, format: as `read_sequence` takes them.

    Raises:
        DataError, MissingError: as `read_sequence` raises them, or no pixel has a depth.
    """
    recording = open_recording(folder, format, depth_folder, pose_file)
    scan = scan_recording(recording, progress)
    if not scan.depth_counts[1:].any():
        raise DataError(
            f"no pixel of {recording.name} has a depth: all {len(scan.frame_ids)} depth maps are "
            "0; check the depth folder and no_depth"
        )
    camera = scan.intrinsics
    candidates = readings(recording.declared, camera)
    file_poses = recording.file_poses[scan.kept_ids]
    fits = fit_readings(candidates, scan.kept_depths, file_poses, scan.pairs)
    poses = recording.T_world_camera[scan.frame_ids]
    steps_m, steps_deg, first = _steps(poses, scan.frame_ids)
    low, middle, high = (_quantile_m(scan, recording, q) for q in (0.01, 0.5, 0.99))
    cloud = scan.cloud(recording)
    return DataReport(
        name=recording.name,
        format=recording.declared.format,
        frames=len(scan.frame_ids),
        excluded_frames=len(recording) - len(scan.frame_ids),
        size=(camera.width, camera.height),
        focal=(camera.fx, camera.fy),
        principal_point=(camera.cx, camera.cy),
        field_of_view_deg=float(np.degrees(
            np.arctan(camera.cx / camera.fx) + np.arctan((camera.width - camera.cx) / camera.fx)
        )),
        depth_range=(low, high),
        measured=float(1 - scan.depth_counts[0] / scan.depth_counts.sum()),
        measured_least=float(scan.measured.min()),
        motion=_motion(steps_m, steps_deg),
        rate_hz=recording.rate_hz,
        brightness=(float(scan.brightness.min()), float(scan.brightness.max())),
        brightness_step=_largest_step(scan),
        seen_thrice=cloud.seen_share(),
        bounds=_bounds(scan, recording),
        fits=tuple(fits),
        advice=advise(
            fits, len(scan.pairs), recording, middle, steps_m, steps_deg, scan.frame_ids[first],
            _largest_step(scan), float(scan.measured.mean()), torch.cuda.is_available(),
        ),
        cloud=cloud,
        T_world_camera=poses,
    )  # fmt: skip


def _quantile_m(scan: Scan, recording: Recording, share: float) -> float:
    """A quantile of the measured depths (m), as declared; along the ray where that is declared."""
    cumulative = scan.depth_counts[1:].cumsum()
    value = 1 + np.searchsorted(cumulative, share * cumulative[-1])
    return float(value / recording.declared.depth_scale)


def _bounds(scan: Scan, recording: Recording) -> SceneBounds:
    """As the mapper will find them, from the kept frames."""
    declared = recording.declared
    lengths = ray_lengths(scan.intrinsics) if declared.depth_along == "ray" else 1.0
    depths_mm = np.empty_like(scan.kept_depths)
    for values, depth_mm in zip(scan.kept_depths, depths_mm, strict=True):
        exact = values / (declared.depth_scale * lengths) / MILLIMETRE
        # A unit that leaves less than a millimetre is told as a warning, not here.
        depth_mm[:] = np.where(values > 0, np.rint(exact).clip(1, 65535), 0)
    black = np.broadcast_to(np.uint8(0), (*depths_mm.shape, 3))
    poses = recording.T_world_camera[scan.kept_ids]
    kept = RgbdSequence(recording.name, scan.intrinsics, black, depths_mm, poses, scan.kept_ids)
    return observed_bounds(kept)


def _steps(
    T_world_camera: Float[np.ndarray, "frames 4 4"], frame_ids: Int[np.ndarray, "frames"]
) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"], Int[np.ndarray, "steps"]]:
    """Motion (m, degrees) over the pairs of frames without a gap between, and where they start."""
    first = np.flatnonzero(np.diff(frame_ids) == 1)
    before, after = T_world_camera[first], T_world_camera[first + 1]
    if len(first) == 0:
        return np.zeros(0), np.zeros(0), first
    return translation_errors(after, before), rotation_errors_deg(after, before), first


def _motion(steps_m: Float[np.ndarray, "n"], steps_deg: Float[np.ndarray, "n"]) -> Motion:
    if len(steps_m) == 0:
        return Motion(*[float("nan")] * 4)
    return Motion(
        1e3 * float(steps_m.mean()), 1e3 * float(steps_m.max()),
        float(steps_deg.mean()), float(steps_deg.max()),
    )  # fmt: skip


def _largest_step(scan: Scan) -> float:
    """Largest relative change of brightness between consecutive frames."""
    levels = scan.brightness + 1e-3  # a black frame divides by nothing
    steps = np.abs(np.diff(levels)) / np.minimum(levels[1:], levels[:-1])
    return float(steps[np.diff(scan.frame_ids) == 1].max(initial=0.0))
