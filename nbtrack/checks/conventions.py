"""Hypotheses of how a recording is to be read: conventions of poses, depth and calibration.

Under the right one the surfaces that two frames both see coincide.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

from nbtrack.checks.readings import FramePairs, Reading
from nbtrack.machinery.settings import changed_settings
from nbtrack.recordings.formats import CAMERA_TO_WORLD, SPELLED_AXES, WORLD_TO_CAMERA
from nbtrack.recordings.recording import Recording

_CLEARLY_BETTER = 1.3  # times as many points agree (our choice)
_ALIKE = 0.95  # of the highest agreement: the first so good is named
PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, of a depth camera's median: units in doubt are told by it
_FAR_APART = 0.05  # m, median distance above which a map of the scene would be blurred (our choice)
_MIN_OVERLAP = 0.15  # share of points below which a median tells nothing (our choice)
# The common camera axes first: where several fit alike, the first is named.
AXES = {
    "opengl": "OpenGL axes", "opencv": "OpenCV axes", "forward left up": "robot axes",
    "right up forward": "left-handed axes", "left up forward": "PyTorch3D axes",
    "left down backward": "right-handed axes", "left down forward": "left-handed axes",
    "left up backward": "left-handed axes", "right down backward": "left-handed axes",
}  # fmt: skip
# Those that are in use: KITTI, millimetres, RealSense at 0.25 mm, TUM, Replica, 0.1 mm, SUN3D's
# millimetres and tenths times 8; and metres and micrometres, which 16 bits hold badly.
_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10_000.0, 8000.0, 80_000.0, 256.0, 100.0, 1.0, 1e6)
# Factors of focal lengths and principal point.
_CALIBRATIONS = {"one for images twice as large": 0.5, "one for images half as large": 2.0}
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}


@dataclass(frozen=True)
class Convention:
    """A way to read poses, depth and calibration, and how well pairs of frames then agree."""

    subject: str  # what is read otherwise than declared: poses, depth or calibration
    name: str  # completes "your ... look like"
    reading: Reading
    median_m: float  # median |z difference| over the points that overlap
    depth_m: float  # their median depth
    overlap: float  # share of all points that fall onto a measured, not nearer, surface
    agreement: float  # the same, where surfaces that coincide count 1 and those far apart 0

    def is_clearly_better(self, other: "Convention") -> bool:
        """Whether clearly more surfaces coincide than in the other."""
        return self.agreement > _CLEARLY_BETTER * other.agreement


def fit_all(pairs: FramePairs, own: Reading) -> tuple[list[Convention], Convention]:
    """All conventions, with how well pairs of frames agree under each, and the best of them.

    `own` is the declared reading, which comes first and is the best unless another is clearly
    better.
    """
    # Axes that have a name are called by it, so that one reading has one way to be written.
    named_axes = {words: name for name, words in SPELLED_AXES.items()}
    axes = named_axes.get(own.declared.camera_axes, own.declared.camera_axes)
    own = replace(own, declared=replace(own.declared, camera_axes=axes))
    conventions = [_fit(pairs, "poses", axes_name(axes, own.declared.poses), own)]
    for subject, name, reading in _hypotheses(own):
        if reading != own:
            conventions.append(_fit(pairs, subject, name, reading))
    return conventions, _best_of(conventions)


def _fit(pairs: FramePairs, subject: str, name: str, reading: Reading) -> Convention:
    """A convention with how well pairs of frames agree under it."""
    compared = pairs.compare(reading)
    is_valid = compared.is_valid
    n_points = (pairs.values > 0).sum().clamp(1)
    return Convention(
        subject, name, reading,
        median_m=float(compared.residual[is_valid].abs().median()),
        depth_m=float(compared.measured[is_valid].median()),
        overlap=float(is_valid.sum() / n_points),
        agreement=float(compared.agreement.sum() / n_points),
    )  # fmt: skip


def axes_name(camera_axes: str, poses: str) -> str:
    """For people: `OpenGL axes (x right, y up, z backward), camera-to-world`."""
    x, y, z = SPELLED_AXES.get(camera_axes, camera_axes).split()
    return f"{AXES.get(camera_axes, 'axes')} (x {x}, y {y}, z {z}), {poses}"


# Subject, name and what is declared otherwise of the mistakes that a `Declaration` can tell.
_DECLARED = [
    *(("poses", axes_name(axes, poses), {"camera_axes": axes, "poses": poses})
      for poses, axes in product((CAMERA_TO_WORLD, WORLD_TO_CAMERA), AXES)),
    *(("poses", f"quaternions in the order {order}", {"quaternion": order})
      for order in ("wxyz", "xyzw")),
    *(("depth", f"{scale:g} depth values a metre", {"depth_scale": scale}) for scale in _SCALES),
    ("depth", "depth along the optical axis", {"depth_along": "axis"}),
    ("depth", "distances along the ray, not z-depth", {"depth_along": "ray"}),
]  # fmt: skip


def _hypotheses(own: Reading) -> Iterator[tuple[str, str, Reading]]:
    """Subject, name and reading of the usual mistakes beside the declared reading, common first."""
    for subject, name, keys in _DECLARED:
        yield subject, name, replace(own, declared=replace(own.declared, **keys))
    camera = own.camera
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    centred = "one with its principal point in the middle of the image"
    yield "calibration", centred, replace(own, camera=replace(camera, **middle))
    for label, factor in _CALIBRATIONS.items():
        scaled = {key: factor * getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
        # A principal point scales too, unless it is the middle of the image at either size.
        for changed in (scaled, scaled | middle):
            yield "calibration", label, replace(own, camera=replace(camera, **changed))
    for unit, metres in _UNITS.items():
        yield "poses", f"ones in {unit}", replace(own, metres=metres)


def _best_of(conventions: list[Convention]) -> Convention:
    """The declared convention (the first), unless another is clearly better.

    Of the others those count whose surfaces meet and whose median depth is plausible for a depth
    camera: surfaces also meet if depths and positions are wrong by the same factor, and only the
    depth then tells which unit is right. Of these the first is taken whose agreement is about the
    highest.
    """
    own = conventions[0]
    near, far = PLAUSIBLE_DEPTH
    meeting = [c for c in conventions if c.overlap >= _MIN_OVERLAP and c.median_m < _FAR_APART]
    plausible = [c for c in meeting if near <= c.depth_m <= far]
    highest = max((c.agreement for c in plausible), default=0.0)
    best = next((c for c in plausible if c.agreement >= _ALIKE * highest), own)
    return best if best.is_clearly_better(own) else own


def diagnosis(
    conventions: list[Convention], best: Convention, recording: Recording, needs_proof: bool
) -> str:
    """What is wrong with how the numbers are read, in a sentence; empty where nothing is.

    The first of these that holds is told: another convention is better; two frames see too little
    of the same; their surfaces lie apart in every convention; and, where proof is needed, the
    camera moves too little to tell conventions apart.
    """
    own, *others = conventions
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
    if own.overlap < _MIN_OVERLAP:
        seen = f"{own.overlap:.0%} of the points, whose surfaces {apart}"
        found = f"{file} is not proved: two frames see too little of the same ({seen})"
        return f"{found}: check it, and a piece with smaller steps"
    if own.median_m > _FAR_APART:
        return (
            f"surfaces that two frames see {apart} (median, {own.overlap:.0%} of the points "
            f"overlap) and no other convention fits: check {recording.calibration.source.name}, "
            f"the depth unit and {file}, and that image, depth and pose belong to one moment"
        )
    alike = [c.name for c in others if c.subject == "poses" and not own.is_clearly_better(c)]
    if not (needs_proof and alike):
        return ""
    little = f"{file} is not proved: the camera moves too little to tell {len(alike)} other"
    return f"{little} conventions apart, such as {alike[0]}"


def _remedy(reading: Reading, own: Reading) -> str:
    """What a user is to change, so that `reading` becomes the declared one, which is now `own`."""
    if reading.metres != 1:
        return f"multiply the positions in the pose file by {reading.metres:g}"
    if (c := reading.camera) != own.camera:
        numbers = f"{c.fx:.6g} {c.fy:.6g} {c.cx - 0.5:.6g} {c.cy - 0.5:.6g}"
        return f"set fx fy cx cy in the calibration to {numbers} (the first pixel's centre at 0)"
    changes = changed_settings(reading.declared, own.declared)  # as `depth_scale=5000.0`
    said = " and ".join(text.replace("=", " = ", 1).removesuffix(".0") for text in changes)
    advice = f"set {said} in sequence.toml"
    if "quaternion" in said:
        advice += " if the pose file has quaternions, or make the matrices anew"
    return advice
