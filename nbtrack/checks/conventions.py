"""Conventions of poses, depth and calibration, compared by how well frames agree under each.

Each convention is a `Reading` of the recording with one usual mistake undone. Under the right one
the surfaces that two frames both see coincide.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

from nbtrack.checks.readings import Agreement, FramePairs, Reading
from nbtrack.machinery.progress import ProgressBar
from nbtrack.machinery.settings import changed_settings
from nbtrack.recordings.formats import CAMERA_TO_WORLD, SPELLED_AXES, WORLD_TO_CAMERA

_CLEARLY_BETTER = 1.3  # ratio of two agreements (our choice)
_NEARER = 3  # ratio of two mean gaps (our choice)
_ALIKE = 0.95  # agreements above this share of the highest count as equal to it
PLAUSIBLE_DEPTH = (0.2, 20.0)  # m; a median depth outside of this range has a wrong unit
# The largest usual mean gap, as a share of the depth. Of the right recordings in docs/tried.md a
# Kinect with poses of KinectFusion has the largest gap, 0.0048; a HoloLens has 0.0019, and rendered
# rooms have at most 0.0018. The first 36 frames of the Kinect alone have 0.0083, so that a gap of
# up to twice the usual one is no evidence of a mistake by itself.
_USUAL_APART = 0.0055
_USUAL_M = 0.025  # m; a larger gap is unusual at any depth
MIN_OVERLAP = 0.15  # with a smaller share of points that overlap nothing is concluded (our choice)
_NAMES = {  # of axes, in sentences
    "opengl": "OpenGL axes", "opencv": "OpenCV axes", "forward left up": "robot axes",
    "left up forward": "PyTorch3D axes",
}  # fmt: skip
_OPPOSITES = [("left", "right"), ("up", "down"), ("forward", "backward")]
_IN_WORDS = [" ".join(words) for three in permutations(_OPPOSITES) for words in product(*three)]
# All 48 orders and directions of three axes. Those that have a name come first, since `_best_of`
# takes the first of conventions that fit alike.
AXES = [*_NAMES, *(w for w in _IN_WORDS if w not in (*_NAMES, *SPELLED_AXES.values()))]
# Depth values a metre, common ones first: 1000 is millimetres, 5000 TUM, 6553.5 Replica, 4000
# RealSense at 0.25 mm, 10,000 tenths of a millimetre, 8000 and 80,000 SUN3D (both times 8), 512
# 2D-3D-S, 256 KITTI, 100 centimetres. Metres (1) and micrometres (1e6) come last, since 16 bits
# hold them badly.
_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10_000.0, 8000.0, 80_000.0)
_SCALES += (512.0, 256.0, 100.0, 1.0, 1e6)
# What a calibration looks like, and the factor that its focal lengths and principal point need.
_CALIBRATIONS = {
    "one with its principal point in the middle of the image": 1.0,
    "one for images twice as large": 0.5, "one for images half as large": 2.0,
}  # fmt: skip
# What positions look like, and the metres of one unit of their x, y and z.
_UNITS = {
    "ones in millimetres": (1e-3, 1e-3, 1e-3), "ones in centimetres": (1e-2, 1e-2, 1e-2),
    "ones in kilometres": (1e3, 1e3, 1e3), "ones whose x is mirrored": (-1.0, 1.0, 1.0),
    "ones whose y is mirrored": (1.0, -1.0, 1.0), "ones whose z is mirrored": (1.0, 1.0, -1.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Convention(Agreement):
    """The declared reading, or one with a mistake undone, and how well pairs of frames agree."""

    subject: str  # what is read wrongly: "poses", "positions", "depth" or "calibration"
    name: str  # what the subject really is; it completes "your SUBJECT look like NAME"

    @property
    def usual_apart(self) -> float:
        """The largest mean gap of right recordings, as a share of the depth."""
        return min(_USUAL_APART, _USUAL_M / self.depth_m)

    @property
    def is_far_apart(self) -> bool:
        """Whether the mean gap is larger than in any part of a right recording, or is unknown."""
        # An unknown gap is NaN: every comparison is false, and its negation true.
        return not self.apart <= min(2 * _USUAL_APART, _USUAL_M / self.depth_m)

    def is_clearly_better(self, other: "Convention") -> bool:
        """Whether clearly more points agree than under the other convention."""
        return self.agreement > _CLEARLY_BETTER * other.agreement

    def __str__(self) -> str:
        verb = "look" if self.subject.endswith("s") else "looks"
        text = f"your {self.subject} {verb} like {self.name}"
        # If axes fit that nobody uses, the poses may be right and the images turned or mirrored.
        if "axes" in self.name and not self.name.startswith(("OpenGL", "OpenCV", "robot")):
            text += ", or the images, or those of depth alone, are turned or mirrored against them"
        return text


def fit_all(pairs: FramePairs, as_declared: Reading) -> tuple[list[Convention], Convention]:
    """Compare the frames under all conventions; returns these and the best of them.

    The declared convention comes first. It is the best one unless another is clearly better.
    """
    # Axes can be declared by a name, such as opengl, or by three words. Here they get their name if
    # they have one, as in `_hypotheses`. So the declared reading is found among the hypotheses, and
    # is not compared twice.
    names = {words: name for name, words in SPELLED_AXES.items()}
    axes = names.get(as_declared.declared.camera_axes, as_declared.declared.camera_axes)
    as_declared = replace(as_declared, declared=replace(as_declared.declared, camera_axes=axes))
    ways = [("poses", axes_name(axes, as_declared.declared.poses), as_declared)]
    ways += [way for way in _hypotheses(as_declared) if way[-1] != as_declared]
    conventions = [
        Convention(**vars(pairs.compare(reading)), subject=subject, name=name)
        for subject, name, reading in ProgressBar("comparing frames", ways)
    ]
    return conventions, _best_of(conventions)


def axes_name(camera_axes: str, poses: str) -> str:
    """A convention of poses in words: `OpenGL axes (x right, y up, z backward), camera-to-world`.

    `camera_axes` is a name or three words, and `poses` a direction, as in a `Declaration`.
    """
    x, y, z = SPELLED_AXES.get(camera_axes, camera_axes).split()
    return f"{_NAMES.get(camera_axes, 'axes')} (x {x}, y {y}, z {z}), {poses}"


# Mistakes that are undone by other entries of the `Declaration`: subject, name, and the entries.
_DECLARED = [
    *(("poses", axes_name(axes, poses), {"camera_axes": axes, "poses": poses})
      for poses, axes in product((CAMERA_TO_WORLD, WORLD_TO_CAMERA), AXES)),
    *(("poses", f"quaternions in the order {order}", {"quaternion": order})
      for order in ("wxyz", "xyzw")),
    *(("depth", f"{scale:g} depth values a metre", {"depth_scale": scale}) for scale in _SCALES),
    ("depth", "depth along the optical axis", {"depth_along": "axis"}),
    ("depth", "distances along the ray, not z-depth", {"depth_along": "ray"}),
]  # fmt: skip


def _hypotheses(as_declared: Reading) -> Iterator[tuple[str, str, Reading]]:
    """Subject, name and reading of each usual mistake, common mistakes first.

    `_best_of` relies on the order: it takes the first of those that fit alike.
    """
    declared, camera = as_declared.declared, as_declared.camera
    for subject, name, entries in _DECLARED:
        yield subject, name, replace(as_declared, declared=replace(declared, **entries))
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    for name, factor in _CALIBRATIONS.items():
        scaled = {key: factor * getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
        # The principal point is scaled with the focal lengths, or else is the image's middle.
        for changed in (scaled, scaled | middle):
            yield "calibration", name, replace(as_declared, camera=replace(camera, **changed))
    for name, metres in _UNITS.items():
        # Mirrored positions are rare, and the poses of a camera that moves in a plane cannot
        # exclude them. `doubts_of_poses` looks at the subject "poses" alone, so that they have
        # another one and raise no doubt.
        subject = "poses" if min(metres) > 0 else "positions"
        yield subject, name, replace(as_declared, metres=metres)
    for poses in (CAMERA_TO_WORLD, WORLD_TO_CAMERA):
        mixed = replace(as_declared, declared=replace(declared, poses=poses), is_mixed=True)
        yield "poses", f"{poses} ones whose rotations alone are of the other direction", mixed


def _best_of(conventions: list[Convention]) -> Convention:
    """The declared convention (the first), unless another one is clearly better.

    A convention is a candidate if surfaces meet under it and if the median depth is plausible for a
    depth camera. Surfaces alone are not enough: they meet as well if depths and positions are wrong
    by the same factor. Of the candidates with about the highest agreement the first is taken, since
    `conventions` have the common ones first.

    This candidate is clearly better if its mean gap is three times smaller than the declared one's,
    or if the declared one's is unusual, its own smaller, and clearly more points agree. The number
    of points alone is not enough: as many or more agree if positions are mirrored along an axis
    along which the camera hardly moved, or along which it looks, or if surfaces are flat.
    """
    declared = conventions[0]
    near, far = PLAUSIBLE_DEPTH
    meet = [c for c in conventions if c.overlap >= MIN_OVERLAP and not c.is_far_apart]
    plausible = [c for c in meet if near <= c.depth_m <= far]
    highest = max((c.agreement for c in plausible), default=0.0)
    best = next((c for c in plausible if c.agreement >= _ALIKE * highest), declared)
    is_usual = declared.apart <= declared.usual_apart
    times = 1 if best.is_clearly_better(declared) and not is_usual else _NEARER
    # If no surfaces meet as declared, its mean gap is NaN. The comparison is false, as it should.
    return declared if best.apart >= declared.apart / times else best


def remedy(reading: Reading, as_declared: Reading) -> str:
    """What a user is to change, so that the declared reading becomes `reading`.

    The two readings differ by one mistake: a convention of `fit_all`, or a cause of `misfits`.
    """
    if reading.is_mixed:
        return "transpose the rotations in the pose file, and declare its direction"
    if reading.metres != as_declared.metres:
        factors = "x, y and z by {:g}, {:g} and {:g}".format(*reading.metres)
        return f"multiply the positions in the pose file, {factors}"
    camera = reading.calibration
    if camera != as_declared.calibration:
        numbers = f"{camera.fx:.6g} {camera.fy:.6g} {camera.cx - 0.5:.6g} {camera.cy - 0.5:.6g}"
        return f"set fx fy cx cy in the calibration to {numbers} (the first pixel's centre at 0)"
    if reading.late:
        return "shift one of them against the other, and let both have one clock"
    if reading.depth_offset:
        return "add this to the depths, or find out from where the camera counts them"
    if reading.depth_share:
        scale = as_declared.declared.depth_scale / (1 + reading.depth_share)
        return f"set depth_scale = {scale:.6g} in sequence.toml, or scale the positions"
    if reading.depth_error_per_m:
        error_per_m = as_declared.declared.depth_error_per_m + reading.depth_error_per_m
        return f"set depth_error_per_m = {error_per_m:.5f} in sequence.toml"
    changes = changed_settings(reading.declared, as_declared.declared)  # as `depth_scale=5000.0`
    if not changes:  # the camera's pose on its body is what is left
        return "multiply each camera-to-world pose by this transform from the right"
    entries = " and ".join(text.replace("=", " = ", 1).removesuffix(".0") for text in changes)
    advice = f"set {entries} in sequence.toml"
    if "quaternion" in entries:
        advice += " if the pose file has quaternions, or make the matrices anew"
    return advice
