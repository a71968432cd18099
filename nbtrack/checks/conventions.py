"""Hypotheses of how a recording is to be read: conventions of poses, depth and calibration.

Under the right one the surfaces that two frames both see coincide.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

from nbtrack.checks.readings import Agreement, FramePairs, Reading
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.settings import changed_settings
from nbtrack.recordings.formats import CAMERA_TO_WORLD, SPELLED_AXES, WORLD_TO_CAMERA

_CLEARLY_BETTER = 1.3  # times as many points agree (our choice)
_NEARER = 3  # times as near lie surfaces (our choice)
_ALIKE = 0.95  # of the highest agreement: the first so good is named
PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, of the median: where units are in doubt, it decides
# Of the depth, in the mean over areas of images. Of 21 right recordings at hand 5.0 mm a metre at
# most, a Kinect's with poses of KinectFusion; 2.0 of a HoloLens, and 1.7 of rendered rooms.
_USUAL_APART = 0.0055
# Parts of real_room's 36 frames have 9.9, so that up to twice as much is no evidence by itself.
_USUAL_M = 0.025  # and m, whatever the depth
MIN_OVERLAP = 0.15  # share of points below which nothing is concluded (our choice)
_NAMES = {
    "opengl": "OpenGL axes", "opencv": "OpenCV axes", "forward left up": "robot axes",
    "left up forward": "PyTorch3D axes",
}  # fmt: skip
_WORDS = [("left", "right"), ("up", "down"), ("forward", "backward")]
# All 48 ways of three axes, those that have a name first: where several fit alike, the first is
# named.
AXES = list(_NAMES) + [
    words
    for three in permutations(_WORDS)
    for words in map(" ".join, product(*three))
    if words not in (*_NAMES, *SPELLED_AXES.values())
]
# Those that are in use: KITTI, millimetres, RealSense at 0.25 mm, TUM, Replica, 0.1 mm, SUN3D's
# millimetres and tenths times 8; and metres and micrometres, which 16 bits hold badly.
_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10_000.0, 8000.0, 80_000.0, 256.0, 100.0, 1.0, 1e6)
# Factors of focal lengths and principal point.
_CALIBRATIONS = {
    "one with its principal point in the middle of the image": 1.0,
    "one for images twice as large": 0.5, "one for images half as large": 2.0,
}  # fmt: skip
# Metres of one unit of x, y and z.
_UNITS = {
    "ones in millimetres": (1e-3, 1e-3, 1e-3), "ones in centimetres": (1e-2, 1e-2, 1e-2),
    "ones in kilometres": (1e3, 1e3, 1e3), "ones whose x is mirrored": (-1.0, 1.0, 1.0),
    "ones whose y is mirrored": (1.0, -1.0, 1.0), "ones whose z is mirrored": (1.0, 1.0, -1.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Convention(Agreement):
    """A way to read poses, depth and calibration, and how well pairs of frames then agree."""

    subject: str  # what is read otherwise than declared: poses, positions, depth or calibration
    name: str  # completes "your ... look like"

    @property
    def usual_apart(self) -> float:
        """By how much surfaces of right recordings lie apart at most, as a share of the depth."""
        return min(_USUAL_APART, _USUAL_M / self.depth_m)

    @property
    def is_far_apart(self) -> bool:
        """Whether surfaces lie farther apart than in any part of a right recording."""
        # Also true for NaN: of nothing that is known it cannot be said that it agrees.
        return not self.apart <= min(2 * _USUAL_APART, _USUAL_M / self.depth_m)

    def is_clearly_better(self, other: "Convention") -> bool:
        """Whether clearly more surfaces coincide than in the other."""
        return self.agreement > _CLEARLY_BETTER * other.agreement

    def __str__(self) -> str:
        verb = "look" if self.subject.endswith("s") else "looks"
        text = f"your {self.subject} {verb} like {self.name}"
        # Images that are turned or mirrored fit as well as axes that nobody uses.
        if "axes" in self.name and not self.name.startswith(("OpenGL", "OpenCV", "robot")):
            text += ", or the images, or those of depth alone, are turned or mirrored against them"
        return text


def fit_all(pairs: FramePairs, own: Reading) -> tuple[list[Convention], Convention]:
    """All conventions, with how well pairs of frames agree under each, and the best of them.

    `own` is the declared reading, which comes first and is the best unless another is clearly
    better.
    """
    # Axes that have a name are called by it, so that one reading has one way to be written.
    named_axes = {words: name for name, words in SPELLED_AXES.items()}
    axes = named_axes.get(own.declared.camera_axes, own.declared.camera_axes)
    own = replace(own, declared=replace(own.declared, camera_axes=axes))
    ways = [("poses", axes_name(axes, own.declared.poses), own)]
    ways += [way for way in _hypotheses(own) if way[-1] != own]
    conventions = [
        Convention(**vars(pairs.compare(reading)), subject=subject, name=name)
        for subject, name, reading in ProgressBar("comparing frames", ways)
    ]
    return conventions, _best_of(conventions)


def axes_name(camera_axes: str, poses: str) -> str:
    """For people: `OpenGL axes (x right, y up, z backward), camera-to-world`."""
    x, y, z = SPELLED_AXES.get(camera_axes, camera_axes).split()
    return f"{_NAMES.get(camera_axes, 'axes')} (x {x}, y {y}, z {z}), {poses}"


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
    for label, factor in _CALIBRATIONS.items():
        scaled = {key: factor * getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
        # A principal point scales too, unless it is the middle of the image at either size.
        for changed in (scaled, scaled | middle):
            yield "calibration", label, replace(own, camera=replace(camera, **changed))
    for name, metres in _UNITS.items():
        # Mirrored positions are rare, and a camera that moves in a plane cannot exclude them: with
        # another subject than "poses" they raise no doubt.
        yield "poses" if min(metres) > 0 else "positions", name, replace(own, metres=metres)
    for poses in (CAMERA_TO_WORLD, WORLD_TO_CAMERA):
        mixed = replace(own, declared=replace(own.declared, poses=poses), is_mixed=True)
        yield "poses", f"{poses} ones whose rotations alone are of the other direction", mixed


def _best_of(conventions: list[Convention]) -> Convention:
    """The declared convention (the first), unless with another surfaces agree clearly better.

    More points then agree, or surfaces lie three times as near. With positions mirrored along an
    axis that the camera hardly moved along, most points still agree. Only those count whose
    surfaces meet and whose median depth is plausible for a depth camera. Surfaces also meet where
    depths and positions are wrong by the same factor, and then only the depth shows which unit is
    right. The first one with about the highest agreement is the best.
    """
    own = conventions[0]
    near, far = PLAUSIBLE_DEPTH
    meet = [c for c in conventions if c.overlap >= MIN_OVERLAP and not c.is_far_apart]
    plausible = [c for c in meet if near <= c.depth_m <= far]
    highest = max((c.agreement for c in plausible), default=0.0)
    best = next((c for c in plausible if c.agreement >= _ALIKE * highest), own)
    return best if best.is_clearly_better(own) or best.apart < own.apart / _NEARER else own


def remedy(reading: Reading, own: Reading) -> str:
    """What a user is to change, so that `reading` becomes the declared one, which is now `own`."""
    if reading.is_mixed:
        return "transpose the rotations in the pose file, and declare its direction"
    if reading.metres != own.metres:
        factors = "x, y and z by {:g}, {:g} and {:g}".format(*reading.metres)
        return f"multiply the positions in the pose file, {factors}"
    if (camera := reading.calibration) != own.calibration:
        numbers = f"{camera.fx:.6g} {camera.fy:.6g} {camera.cx - 0.5:.6g} {camera.cy - 0.5:.6g}"
        return f"set fx fy cx cy in the calibration to {numbers} (the first pixel's centre at 0)"
    if reading.late:
        return "shift one of them against the other, and let both have one clock"
    if reading.depth_offset:
        return "add this to the depths, or find out from where the camera counts them"
    if reading.depth_share:
        scale = own.declared.depth_scale / (1 + reading.depth_share)
        return f"set depth_scale = {scale:.6g} in sequence.toml, or scale the positions"
    if reading.depth_error_per_m:
        error_per_m = own.declared.depth_error_per_m + reading.depth_error_per_m
        return f"set depth_error_per_m = {error_per_m:.5f} in sequence.toml"
    changes = changed_settings(reading.declared, own.declared)  # as `depth_scale=5000.0`
    if not changes:
        return "multiply each camera-to-world pose by this transform from the right"
    entries = " and ".join(text.replace("=", " = ", 1).removesuffix(".0") for text in changes)
    advice = f"set {entries} in sequence.toml"
    if "quaternion" in entries:
        advice += " if the pose file has quaternions, or make the matrices anew"
    return advice
