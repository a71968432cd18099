"""Conventions under which a recording can be read: of poses, depth and calibration.

Under the right convention the surfaces that two frames both see coincide.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int, UInt16
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import grid_sample

from nbtrack.core.arrays import Poses
from nbtrack.core.camera import Intrinsics, pixel_directions, project
from nbtrack.core.settings import changed_settings
from nbtrack.data.formats import CAMERA_TO_WORLD, SPELLED_AXES, WORLD_TO_CAMERA, Declaration
from nbtrack.data.recording import Recording
from nbtrack.data.sequence import RgbdSequence

_HIDDEN_BEHIND = 0.25  # m behind a surface points are hidden: several times a camera's noise
_SAME_SURFACE = 0.025  # of the depth: where neighbours blend to more, they lie on two surfaces
_POINTS_PER_FRAME = 1000  # 20 pairs of frames have enough for a median
_CLEARLY_BETTER = 0.5  # of the distance as declared (our choice)
_MIN_GAIN = 5e-4  # of the depth: 1 mm at 2 m, depth's resolution on disk
PLAUSIBLE_DEPTH = (0.2, 20.0)  # m, of a depth camera's median: units in doubt are told by it
_FAR_APART = 0.05  # m, median distance above which a map of the scene would be blurred (our choice)
_FAR_APART_OF_FEW = 0.15  # the same where less than the first share overlaps (our choice)
# Shares of points below which a median tells nothing, and below which not even a large one does: of
# a right recording hardly a point lies in front of what another frame sees there (our choice).
_MIN_OVERLAP, _MIN_CONTRADICTION = 0.15, 0.02
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
    """One way to understand poses, depth and calibration, and how well frames then agree."""

    subject: str  # what is read otherwise than declared: poses, depth or calibration
    name: str  # completes "your ... look like"
    declared: Declaration
    camera: Intrinsics
    median_m: float = math.nan  # median |z difference| over the points that overlap
    relative: float = math.nan  # the same as a share of the depth, which no unit makes small
    depth_m: float = math.nan  # their median depth
    overlap: float = 0.0  # share of all points that fall onto a measured, not nearer, surface
    metres: float = 1.0  # of one unit of the poses' positions

    def points(self, columns: Tensor, rows: Tensor, values: Tensor) -> Tensor:
        """Points (..., 3; m, camera frame) of pixels with depth values as in the files."""
        directions = pixel_directions(self.camera, columns, rows)
        if self.declared.depth_along == "ray":
            directions = directions / directions.norm(dim=-1, keepdim=True)
        return directions * (values / self.declared.depth_scale)[..., None]

    def grid_points(self, values: UInt16[np.ndarray, "frames h w"], stride: int) -> Tensor:
        """Points (frames, n, 3) of every `stride`-th row and column; 0 if unmeasured."""
        values = torch.from_numpy(values[:, ::stride, ::stride].astype(np.float32))
        rows, columns = (stride * torch.from_numpy(np.indices(values.shape[1:]))).flatten(1)
        return self.points(columns, rows, values.flatten(1))

    def T_world_camera(self, file_poses: Poses, order: str) -> Poses:
        """Camera-to-world poses with OpenCV axes, of a file read with this order of quaternions."""
        T = file_poses.copy()
        if self.declared.quaternion != order:
            # Numbers a b c d read as xyzw that are wxyz: x y z w is b c d a.
            q = np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(), 1 - 2 * (order == "xyzw"), 1)
            T[:, :3, :3] = Rotation.from_quat(q).as_matrix()
        T[:, :3, 3] *= self.metres
        return self.declared.poses_to_opencv(T)


def fit_all(
    sequence: RgbdSequence, recording: Recording, pairs: Int[np.ndarray, "2 pairs"]
) -> list[Convention]:
    """All conventions, the declared one first, with how well pairs of frames agree under each.

    The sequence has depth values as in the files; pairs are positions in it.
    """
    declared, poses = recording.declared, recording.file_poses[sequence.frame_ids[pairs.ravel()]]
    in_files = read_pairs(sequence.depths_mm[pairs]), poses, declared.quaternion
    return [_fitted(c, *in_files) for c in _candidates(declared, sequence.intrinsics)]


def _candidates(declared: Declaration, camera: Intrinsics) -> list[Convention]:
    """The declared convention first, then the usual mistakes, common ones first."""
    name = _convention_name(declared.camera_axes, declared.poses)
    declared = replace(declared, **CONVENTIONS.get(name, {}))  # `opencv` for `right down forward`
    own = Convention("poses", name, declared, camera)
    order = "wxyz" if declared.quaternion == "xyzw" else "xyzw"
    orders = {f"quaternions in the order {order}": {"quaternion": order}}
    table = [
        (subject, name, {"declared": replace(declared, **keys)})
        for subject, named in (("poses", CONVENTIONS | orders), ("depth", _DEPTHS))
        for name, keys in named.items()
    ]
    lengths = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for name, factor in _CALIBRATIONS.items():
        # The principal point scales with the rest, or is in the middle of any image.
        scaled = Intrinsics(camera.width, camera.height, *(factor * lengths).tolist())
        middle = replace(scaled, cx=camera.width / 2, cy=camera.height / 2)
        table += [("calibration", name, {"camera": c}) for c in (scaled, middle)]
    table += [("poses", name, {"metres": metres}) for name, metres in _UNITS.items()]
    return [own] + [
        replace(own, subject=subject, name=name, **changes)
        for subject, name, changes in table
        if any(getattr(own, key) != value for key, value in changes.items())
    ]


class Pairs(NamedTuple):
    """Depth of frames in pairs that see much the same, with values as in the files."""

    columns: Tensor  # (points,), of pixels of the first frames, on a grid
    rows: Tensor
    values: Tensor  # (pairs, points), of the first frames there
    inverse: Tensor  # (pairs, 1, height, width), 1 / value of the second frames


def read_pairs(values: UInt16[np.ndarray, "2 pairs h w"]) -> Pairs:
    """The first frames of pairs on a grid, and the second ones whole."""
    stride = math.ceil((math.prod(values.shape[2:]) / _POINTS_PER_FRAME) ** 0.5)
    some = torch.from_numpy(values[0, :, ::stride, ::stride].astype(np.float32))
    rows, columns = (stride * torch.from_numpy(np.indices(some.shape[1:]))).flatten(1)
    inverse = 1 / torch.from_numpy(values[1, :, None].astype(np.float32))
    return Pairs(columns, rows, some.flatten(1), inverse)


def depth_differences(
    pairs: Pairs, convention: "Convention", T_world_a: Poses, T_world_b: Poses
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How far (m) points of the first frames lie behind the surface that the second ones measured.

    Also the depth (m) measured there, whether a point counts, each (pairs, points), and where the
    second frames see it: (pairs, 1, points, 2), -1 at the first pixel, 1 at the last. Depth is
    interpolated between four pixels, in 1/z, which is exact for planes. Points do not count where
    the four lie on different surfaces, and where they are hidden.
    """
    points_a = convention.points(pairs.columns, pairs.rows, pairs.values)
    T_b_a = torch.from_numpy(np.linalg.solve(T_world_b, T_world_a)).float()
    points_b = points_a @ T_b_a[:, :3, :3].mT + T_b_a[:, None, :3, 3]
    columns, rows, depth = project(convention.camera, points_b)
    height, width = pairs.inverse.shape[2:]
    at = 2 * torch.stack([columns / (width - 1), rows / (height - 1)], dim=-1)[:, None] - 1
    blended = 1 / grid_sample(pairs.inverse, at, "bilinear", align_corners=True)[:, 0, 0]
    nearest = 1 / grid_sample(pairs.inverse, at, "nearest", align_corners=True)[:, 0, 0]
    measured = convention.points(columns, rows, blended)[..., 2]
    counts = (pairs.values > 0) & (depth > 1e-6) & (at.abs() <= 1).all(dim=-1)[:, 0]
    counts &= (blended / nearest - 1).abs() < _SAME_SURFACE  # false where there is no depth
    counts &= depth - measured < _HIDDEN_BEHIND  # but in front is a contradiction, however far
    return depth - measured, measured, counts, at


def _fitted(convention: Convention, pairs: Pairs, file_poses: Poses, order: str) -> Convention:
    """How far points that the first frames of pairs measured lie from the second ones' surfaces.

    Poses are as in the file, those of the first frames before those of the second ones.
    """
    T_world_cameras = np.split(convention.T_world_camera(file_poses, order), 2)
    apart, measured, counts, _ = depth_differences(pairs, convention, *T_world_cameras)
    apart, measured = apart.abs()[counts], measured[counts]
    return replace(
        convention,
        median_m=float(apart.median()),
        relative=float((apart / measured).median()),
        depth_m=float(measured.median()),
        overlap=float(counts.sum() / (pairs.values > 0).sum().clamp(1)),
    )


def best_convention(results: list[Convention]) -> Convention:
    """The declared convention (the first), unless another fits clearly better.

    Another fits clearly better if its surfaces are at most half as far apart and overlap at least
    half as much. The second condition is needed because cameras that are turned away from each
    other may agree on the few points that remain. Its median depth is that of a depth camera, since
    no other number tells a unit of depth from one of positions.
    """
    own, half = results[0], max(convention.overlap / 2 for convention in results)
    enough = max(_MIN_OVERLAP, half)
    near, far = PLAUSIBLE_DEPTH
    meeting = [
        r
        for r in results
        if r.overlap >= enough and r.median_m < _FAR_APART and near <= r.depth_m <= far
    ]
    minimum = min((convention.relative for convention in meeting), default=math.inf)
    if own.overlap >= half and not _is_clearly_less(minimum, own.relative):
        return own
    alike = max(1.1 * minimum, minimum + _MIN_GAIN)  # the common ones come first
    return next((convention for convention in meeting if convention.relative <= alike), own)


def _is_clearly_less(relative: float, other: float) -> bool:
    return relative <= min(_CLEARLY_BETTER * other, other - _MIN_GAIN)


def diagnosis(results: list[Convention], recording: Recording, needs_proof: bool) -> str:
    """What is wrong with how the numbers are read, in a sentence; empty where nothing is.

    Where proof is needed, a camera that moves too little to tell conventions apart is wrong too.
    """
    own, best, file = results[0], best_convention(results), recording.pose_file.name
    apart = f"lie {1e3 * own.median_m:.0f} mm apart" if own.overlap else "never meet"
    if best is not own:
        look = "look" if best.subject == "poses" else "looks"
        # Depth upside down, or turned by 180 degrees, fits like mirrored or turned axes.
        is_rare = "axes" in best.name and not best.name.startswith(("Open", "robot"))
        turned = "; or the depth images are turned against the colour images" if is_rare else ""
        return (
            f"your {best.subject} {look} like {best.name}; {_remedy(best, own)} (surfaces that two "
            f"frames see then lie {1e3 * best.median_m:.0f} mm apart; as declared they {apart})"
            f"{turned}"
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


def _remedy(convention: Convention, own: Convention) -> str:
    """What to change, so that a convention is the declared one."""
    if convention.metres != 1:
        return f"multiply the positions in the pose file by {convention.metres:g}"
    if (c := convention.camera) != own.camera:
        numbers = f"{c.fx:.6g} {c.fy:.6g} {c.cx - 0.5:.6g} {c.cy - 0.5:.6g}"
        return f"set fx fy cx cy in the calibration to {numbers} (the first pixel's centre at 0)"
    changes = changed_settings(convention.declared, own.declared)
    said = " and ".join(text.replace("=", " = ", 1).removesuffix(".0") for text in changes)
    advice = f"set {said} in sequence.toml"
    if "quaternion" in said:
        advice += " if the pose file has quaternions, or make the matrices anew"
    return advice
