"""What a checked recording's findings mean: warnings in sentences, and settings to start with."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from nbtrack.data.readers import Recording
from nbtrack.data.readings import FAR_APART, LEAST_OVERLAP, Fit, best_fit, fits_alike

_JUMP = 0.3  # m between consecutive frames; a hand moves 0.02
_PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, median of a depth camera's measurements
_EXPOSURE_STEP = 0.35  # share by which brightness may change between frames (our choice)
_LEAST_MEASURED = 0.3  # share of pixels with a depth, below which maps have holes (our choice)
# What the second-order tracker still followed, of a real recording thinned to every third frame.
_FOLLOWED_M, _FOLLOWED_DEG = 0.07, 3.6
# A step of the paper's trackers moves at most so far: the learning rates of their optimiser.
_STEP_M, _STEP_DEG = 5e-4, 0.1


@dataclass(frozen=True)
class Advice:
    """Sentences for a user."""

    warnings: tuple[str, ...]
    suggestion: str


def advise(
    fits: list[Fit],
    n_pairs: int,
    recording: Recording,
    median_depth: float,
    steps_m: Float[np.ndarray, "steps"],
    steps_deg: Float[np.ndarray, "steps"],
    step_starts: Int[np.ndarray, "steps"],
    exposure_step: float,
    measured: float,
    has_gpu: bool,
) -> Advice:
    """Judge a recording.

    Args:
        fits: of every reading, the declared one first.
        n_pairs: frame pairs that they rest on.
        median_depth: m, as declared.
        steps_m, steps_deg: motion between consecutive frames, as declared.
        step_starts: the frame before each of those steps.
        exposure_step: largest relative change of brightness between frames.
        measured: share of pixels with a depth.
    """
    warnings = _reading_warnings(fits, n_pairs, recording)
    if best_fit(fits) is fits[0]:
        warnings += _jump_warnings(steps_m, step_starts) + _depth_warnings(median_depth)
    if exposure_step > _EXPOSURE_STEP:
        warnings.append(
            f"brightness changes by {100 * exposure_step:.0f} % between two frames: fix exposure "
            "and white balance when recording, or track without colour: "
            "--set tracking.lm.lambda_color=0"
        )
    if measured < _LEAST_MEASURED:
        warnings.append(
            f"only {100 * measured:.0f} % of the pixels have a depth: stay within the camera's "
            "range, or record less glass and black; maps will have holes"
        )
    return Advice(tuple(warnings), _suggestion(recording, steps_m, steps_deg, has_gpu))


def _reading_warnings(fits: list[Fit], n_pairs: int, recording: Recording) -> list[str]:
    own, best = fits[0], best_fit(fits)
    file = recording.pose_file.name
    if n_pairs == 0:
        return [f"{file} is not proved: that takes two frames with a pose"]
    found = f"lie {1e3 * own.median_m:.0f} mm apart" if own.overlap else "never meet"
    if best is not own:
        verb = "look" if best.reading.subject == "poses" else "looks"
        return [
            f"your {best.reading.subject} {verb} like {best.reading.name}; {best.reading.remedy} "
            f"(surfaces that two frames see then lie {1e3 * best.median_m:.0f} mm apart; as "
            f"declared they {found})"
        ]
    if own.overlap < LEAST_OVERLAP or own.median_m > FAR_APART:
        return [
            f"surfaces that two frames see {found} (median, {100 * own.overlap:.0f} % of the "
            f"points overlap) and no other reading fits: check {recording.calibration.source.name},"
            f" the depth unit and {file}, and that image, depth and pose belong to one moment"
        ]
    alike = [fit for fit in fits[1:] if fit.reading.subject == "poses" and fits_alike(own, fit)]
    if not alike:
        return []
    return [
        f"{file} is not proved: the camera moves too little to tell {len(alike)} other readings "
        f"apart, such as {alike[0].reading.name}"
    ]


def _jump_warnings(
    steps_m: Float[np.ndarray, "steps"], step_starts: Int[np.ndarray, "steps"]
) -> list[str]:
    jumps = np.flatnonzero(steps_m > _JUMP)
    if len(jumps) == 0:
        return []
    worst = steps_m.argmax()
    return [
        f"{len(jumps)} of {len(steps_m)} steps between frames are longer than {_JUMP} m, the "
        f"longest {steps_m[worst]:.2f} m after frame {step_starts[worst]}: check the poses "
        "there, or leave the frames out with --frames"
    ]


def _depth_warnings(median_m: float) -> list[str]:
    low, high = _PLAUSIBLE_DEPTH
    if low <= median_m <= high:
        return []
    return [
        f"the median depth is {median_m:.3g} m, outside {low:g} to {high:g} m: set depth_scale, "
        "the depth values a metre, in sequence.toml"
    ]


def _suggestion(
    recording: Recording,
    steps_m: Float[np.ndarray, "steps"],
    steps_deg: Float[np.ndarray, "steps"],
    has_gpu: bool,
) -> str:
    """Options to start with. The preset goes by the machine, the rest by the motion."""
    preset = f"--preset {'paper' if has_gpu else 'smoke'} --field neus"
    if len(steps_m) == 0:
        return f"{preset} --tracker lm --steps 10"
    # Nearly all frames: a single jump is warned of elsewhere.
    far_m, far_deg = (float(np.quantile(steps, 0.95)) for steps in (steps_m, steps_deg))
    if far_m > _FOLLOWED_M or far_deg > _FOLLOWED_DEG:
        return (
            f"{preset} --tracker lm --steps 20, but frames are up to {100 * far_m:.0f} cm and "
            f"{far_deg:.1f} deg apart: record slower or at a higher rate"
        )
    steps = max(10, round(max(far_m / _STEP_M, far_deg / _STEP_DEG)))
    rate = min(30, max(1, round(recording.rate_hz)))
    return f"{preset} --tracker lm --rate {rate}, or --tracker sdf --steps {steps}"
