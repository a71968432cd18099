"""Conventions under which a recording can be read: of poses, depth and calibration.

Under the right convention the surfaces that two frames both see coincide.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from nbtrack.checks.readings import FramePairs, Reading
from nbtrack.core.camera import Intrinsics
from nbtrack.core.settings import changed_settings
from nbtrack.recordings.formats import CAMERA_TO_WORLD, SPELLED_AXES, WORLD_TO_CAMERA, Declaration
from nbtrack.recordings.recording import Recording

_CLEARLY_BETTER = 0.5  # of the distance as declared (our choice)
_MIN_GAIN = 5e-4  # of the depth: 1 mm at 2 m, depth's resolution on disk
PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, of a depth camera's median: units in doubt are told by it
_FAR_APART = 0.05  # m, median distance above which a map of the scene would be blurred (our choice)
_FAR_APART_OF_FEW = 0.15  # the same where less than the first share overlaps (our choice)
_MIN_OVERLAP = 0.15  # share of points below which a median tells nothing (our choice)
# Share below which not even a large median tells anything: of a right recording hardly a point lies
# in front of what another frame sees there (our choice).
_MIN_CONTRADICTION = 0.02
# Those that are in use: KITTI, millimetres, RealSense at 0.25 mm, TUM, Replica, 0.1 mm, SUN3D's
# millimetres and tenths times 8; and metres and micrometres, which 16 bits hold badly.
_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10_000.0, 8000.0, 80_000.0, 256.0, 100.0, 1.0, 1e6)
_DEPTHS = {f"{scale:g} depth values a metre": {"depth_scale": scale} for scale in _SCALES}
_DEPTHS["depth along the optical axis"] = {"depth_along": "axis"}
_DEPTHS["distances along the ray, not z-depth"] = {"depth_along": "ray"}
_CALIBRATIONS = {  # factors of focal lengths
    "one with its principal point in the middle of the image": 1.0,
    "one for images twice as large": 0.5,
    "one for images half as large": 2.0,
}
_UNITS = {"ones in millimetres": 1e-3, "ones in centimetres": 1e-2, "ones in kilometres": 1e3}
# The common camera axes first: where several fit alike, the first is named.
_USUAL = {
    "right up backward": "OpenGL axes",
    "right down forward": "OpenCV axes",
    "forward left up": "robot axes",
    "right up forward": "left-handed axes",
    "left up forward": "PyTorch3D axes",
    "left down backward": "right-handed axes",
    "left down forward": "left-handed axes",
    "left up backward": "left-handed axes",
    "right down backward": "left-handed axes",
}


def _convention_name(camera_axes: str, poses: str) -> str:
    """For people: `OpenGL axes (x right, y up, z backward), camera-to-world`."""
    words = SPELLED_AXES.get(camera_axes, camera_axes)
    return "{} (x {}, y {}, z {}), {}".format(_USUAL.get(words, "axes"), *words.split(), poses)


_SHORT = {words: name for name, words in SPELLED_AXES.items()}
CONVENTIONS = {  # by name: what `sequence.toml` says of it
    _convention_name(axes, poses): {"camera_axes": _SHORT.get(axes, axes), "poses": poses}
    for poses in (CAMERA_TO_WORLD, WORLD_TO_CAMERA)
    for axes in _USUAL
}


@dataclass(frozen=True)
class Convention:
    """A way to read poses, depth and calibration, and how well pairs of frames then agree."""

    subject: str  # what is read otherwise than declared: poses, depth or calibration
    name: str  # completes "your ... look like"
    reading: Reading
    median_m: float  # median |z difference| over the points that overlap
    relative: float  # the same as a share of the depth, which no unit makes small
    depth_m: float  # their median depth
    overlap: float  # share of all points that fall onto a measured, not nearer, surface


def fit_all(
    pairs: FramePairs, declared: Declaration, camera: Intrinsics
) -> tuple[list[Convention], Convention]:
    """All conventions, the declared one first, with how well pairs of frames agree under each; and
    the best: the declared one, unless another is clearly better."""
    conventions = []
    for subject, name, reading in _candidates(declared, camera):
        apart, measured, counts, _ = pairs.differences(reading)
        apart = apart.abs()[counts]
        measured = measured[counts]
        numbers = apart.median(), (apart / measured).median(), measured.median()
        overlap = counts.sum() / (pairs.values > 0).sum().clamp(1)
        conventions.append(Convention(subject, name, reading, *map(float, (*numbers, overlap))))
    return conventions, _best_of(conventions)


def _candidates(declared: Declaration, camera: Intrinsics) -> list[tuple[str, str, Reading]]:
    """Subject, name and reading: as declared, then the usual mistakes, common ones first."""
    name = _convention_name(declared.camera_axes, declared.poses)
    declared = replace(declared, **CONVENTIONS.get(name, {}))  # `opencv` for `right down forward`
    own = Reading(declared, camera)
    order = "wxyz" if declared.quaternion == "xyzw" else "xyzw"
    orders = {f"quaternions in the order {order}": {"quaternion": order}}
    table = [
        (subject, name, replace(own, declared=replace(declared, **keys)))
        for subject, named in (("poses", CONVENTIONS | orders), ("depth", _DEPTHS))
        for name, keys in named.items()
    ]
    lengths = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for label, factor in _CALIBRATIONS.items():
        # The principal point scales with the rest, or is in the middle of any image.
        scaled = Intrinsics(camera.width, camera.height, *(factor * lengths).tolist())
        middle = replace(scaled, cx=camera.width / 2, cy=camera.height / 2)
        table += [("calibration", label, replace(own, camera=c)) for c in (scaled, middle)]
    table += [("poses", label, replace(own, metres=metres)) for label, metres in _UNITS.items()]
    return [("poses", name, own), *(row for row in table if row[2] != own)]


def _best_of(results: list[Convention]) -> Convention:
    """The declared convention (the first), unless another fits clearly better.

    Another fits clearly better if its surfaces are at most half as far apart and overlap at least
    half as much. The second condition is needed because cameras that are turned away from each
    other may agree on the few points that remain. Its median depth is that of a depth camera, since
    no other number tells a unit of depth from one of positions.
    """
    own = results[0]
    half = max(convention.overlap / 2 for convention in results)
    enough = max(_MIN_OVERLAP, half)
    near, far = PLAUSIBLE_DEPTH
    meeting = [r for r in results if r.overlap >= enough and r.median_m < _FAR_APART]
    meeting = [r for r in meeting if near <= r.depth_m <= far]
    minimum = min((convention.relative for convention in meeting), default=math.inf)
    if own.overlap >= half and not _is_clearly_less(minimum, own.relative):
        return own
    alike = max(1.1 * minimum, minimum + _MIN_GAIN)  # the common ones come first
    return next((convention for convention in meeting if convention.relative <= alike), own)


def _is_clearly_less(relative: float, other: float) -> bool:
    return relative <= min(_CLEARLY_BETTER * other, other - _MIN_GAIN)


def diagnosis(
    results: list[Convention], best: Convention, recording: Recording, needs_proof: bool
) -> str:
    """What is wrong with how the numbers are read, in a sentence; empty where nothing is.

    Where proof is needed, a camera that moves too little to tell conventions apart is wrong too.
    """
    own = results[0]
    file = recording.pose_file.name
    apart = f"lie {1e3 * own.median_m:.0f} mm apart" if own.overlap else "never meet"
    if best is not own:
        look = "look" if best.subject == "poses" else "looks"
        # Depth upside down, or turned by 180 degrees, fits like mirrored or turned axes.
        is_rare = "axes" in best.name and not best.name.startswith(("Open", "robot"))
        turned = "; or the depth images are turned against the colour images" if is_rare else ""
        return (
            f"your {best.subject} {look} like {best.name}; {_remedy(best.reading, own.reading)} "
            f"(surfaces that two frames see then lie {1e3 * best.median_m:.0f} mm apart; as "
            f"declared they {apart}){turned}"
        )
    # Of few points, such as key frames share, not even a right convention's lie close.
    few = own.overlap < _MIN_OVERLAP
    is_far = own.median_m > (_FAR_APART_OF_FEW if few else _FAR_APART)
    if own.overlap < (_MIN_CONTRADICTION if is_far else _MIN_OVERLAP):
        return (
            f"{file} is not proved: two frames see too little of the same ({own.overlap:.0%} of "
            f"the points, whose surfaces {apart}): check it, and a piece with smaller steps"
        )
    if is_far:
        return (
            f"surfaces that two frames see {apart} (median, {own.overlap:.0%} of the points "
            f"overlap) and no other convention fits: check {recording.calibration.source.name}, "
            f"the depth unit and {file}, and that image, depth and pose belong to one moment"
        )
    poses = [r for r in results[1:] if r.subject == "poses" and r.overlap >= own.overlap / 2]
    alike = [r.name for r in poses if not _is_clearly_less(own.relative, r.relative)]
    if not (needs_proof and alike):
        return ""
    little = f"{file} is not proved: the camera moves too little to tell {len(alike)} other"
    return f"{little} conventions apart, such as {alike[0]}"


def _remedy(reading: Reading, own: Reading) -> str:
    """What to change, so that a reading is the declared one."""
    if reading.metres != 1:
        return f"multiply the positions in the pose file by {reading.metres:g}"
    if (c := reading.camera) != own.camera:
        numbers = f"{c.fx:.6g} {c.fy:.6g} {c.cx - 0.5:.6g} {c.cy - 0.5:.6g}"
        return f"set fx fy cx cy in the calibration to {numbers} (the first pixel's centre at 0)"
    changes = changed_settings(reading.declared, own.declared)
    said = " and ".join(text.replace("=", " = ", 1).removesuffix(".0") for text in changes)
    advice = f"set {said} in sequence.toml"
    if "quaternion" in said:
        advice += " if the pose file has quaternions, or make the matrices anew"
    return advice
