"""Ways to read a recording's numbers, and how well the depth maps agree under each.

Poses, calibration and depth are only right together if the surfaces that two frames see lie on
each other. Each reading is applied to pairs of frames, and the surfaces' distance is measured.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt16
from scipy.spatial.transform import Rotation

from nbtrack.core.camera import Intrinsics
from nbtrack.data.conventions import CONVENTIONS, OPENCV, OPENGL, Convention
from nbtrack.data.readers import ray_lengths
from nbtrack.data.readers.declaration import Declaration

# A point further than this behind what a frame measured is hidden there and says nothing. Points
# in front of the measured surface contradict a reading at any distance.
_HIDDEN_BEHIND = 0.25  # m, our choice: several times a depth camera's noise
_SAME_SURFACE = 0.05  # of the depth: neighbours further apart lie on different surfaces
_POINTS_PER_FRAME = 1000  # 20 pairs of frames have enough for a median
_CLEARLY_BETTER = 0.5  # of the distance as declared (our choice)
_LEAST_GAIN = 5e-4  # of the depth: 1 mm at 2 m, depth's resolution on disk
FAR_APART = 0.05  # m, median distance above which a map of the scene would be blurred (our choice)
LEAST_OVERLAP = 0.15  # share of points below which a median tells nothing (our choice)
# Depth values a metre that are in use: KITTI, millimetres, RealSense at 0.25 mm, TUM, Replica, 0.1
# mm; and metres and micrometres, which 16 bits hold badly.
_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10_000.0, 256.0, 100.0, 1.0, 1e6)
_OTHER_SCALE = 1.1  # factors nearer to 1 than this are calibration, not another unit


@dataclass(frozen=True)
class Reading:
    """One way to understand poses, depth and calibration."""

    name: str  # completes "your ... look like"
    subject: str  # what is read otherwise than declared: poses, depth or calibration
    remedy: str  # what to change, so that this reading is the declared one
    convention: Convention
    depth_scale: float | int  # raw values a metre
    along_ray: bool
    intrinsics: Intrinsics
    quaternion_turn: int = 0  # by how many places the file's quaternions, as read, must be rolled

    def to_opencv(self, file_poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Camera-to-world poses with OpenCV axes, if this reading is right."""
        if self.quaternion_turn:
            file_poses = _with_rolled_quaternions(file_poses, self.quaternion_turn)
        return self.convention.to_opencv(file_poses)


@dataclass(frozen=True)
class Fit:
    """How well frames agree with each other under one reading."""

    reading: Reading
    median_m: float  # median |z difference| over the points that overlap; NaN if none does
    relative: float  # the same as a share of the depth, which no choice of unit makes small
    overlap: float  # share of all points that fall onto a measured, not nearer, surface


def readings(declared: Declaration, intrinsics: Intrinsics) -> list[Reading]:
    """The declared reading first, then the usual mistakes one at a time, common ones first."""
    own_convention = declared.convention
    own = Reading(
        own_convention.name, "poses", "", own_convention, declared.depth_scale,
        declared.depth_along == "ray", intrinsics,
    )  # fmt: skip
    others = [
        replace(own, name=c.name, convention=c, remedy=_set_convention(c, own_convention))
        for c in CONVENTIONS
        if c != own_convention
    ]
    found = [own, *others, *_quaternion_readings(own, declared.quaternion)]
    return found + _depth_readings(own) + _camera_readings(own)


def _set_convention(wanted: Convention, own: Convention) -> str:
    keys = []
    if wanted.camera_axes != own.camera_axes:
        keys.append(f'camera_axes = "{wanted.camera_axes}"')
    if wanted.world_to_camera != own.world_to_camera:
        keys.append(f'poses = "{wanted.direction}"')
    return f"set {' and '.join(keys)} in sequence.toml"


def _quaternion_readings(own: Reading, order: str) -> list[Reading]:
    """Poses made from quaternions in the other order, alone or with other axes."""
    other = "wxyz" if order == "xyzw" else "xyzw"
    # Numbers a b c d read as xyzw that are wxyz: x y z w is b c d a.
    turn = -1 if order == "xyzw" else 1
    swapped = [replace(own, name=f"quaternions in the order {other}", quaternion_turn=turn)]
    swapped += [
        replace(
            own, name=f"quaternions in the order {other}, and {c.name}", convention=c,
            quaternion_turn=turn,
        )
        for axes in (OPENCV, OPENGL)
        for c in (axes, replace(axes, world_to_camera=True))
        if c != own.convention
    ]  # fmt: skip
    return [
        replace(r, remedy=", ".join(filter(None, [
            f'set quaternion = "{other}" in sequence.toml if the pose file has quaternions, or '
            "make the matrices anew",
            "" if r.convention == own.convention else _set_convention(r.convention, own.convention),
        ])))
        for r in swapped
    ]  # fmt: skip


def _depth_readings(own: Reading) -> list[Reading]:
    """Depth in other units, or along the other direction."""
    scales = [*_SCALES, own.depth_scale / 1000, own.depth_scale * 1000]
    distinct: list[float] = []
    for scale in scales:
        known = [own.depth_scale, *distinct]
        if all(max(scale / k, k / scale) > _OTHER_SCALE for k in known):
            distinct.append(float(scale))
    along = "axis" if own.along_ray else "ray"
    words = {"axis": "depth along the optical axis", "ray": "distances along the ray, not z-depth"}
    other_scales = [
        replace(
            own, subject="depth", name=f"{scale:g} depth values a metre", depth_scale=scale,
            remedy=f"set depth_scale = {scale:g} in sequence.toml",
        )
        for scale in distinct
    ]  # fmt: skip
    other_direction = replace(
        own, subject="depth", name=words[along], along_ray=not own.along_ray,
        remedy=f'set depth_along = "{along}" in sequence.toml',
    )  # fmt: skip
    return [*other_scales, other_direction]


def _camera_readings(own: Reading) -> list[Reading]:
    """A calibration for images of another size, or without a principal point."""
    camera = own.intrinsics
    middle = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
    found = []
    away = max(abs(camera.cx - middle.cx) / middle.cx, abs(camera.cy - middle.cy) / middle.cy)
    if away > 0.1:
        found.append(("one with its principal point in the middle of the image", middle))
    for factor, size in ((0.5, "twice as large"), (2.0, "half as large")):
        scaled = replace(
            camera, fx=factor * camera.fx, fy=factor * camera.fy, cx=factor * camera.cx,
            cy=factor * camera.cy,
        )  # fmt: skip
        centred = replace(scaled, cx=middle.cx, cy=middle.cy)
        found.append((f"one for images {size}", centred if away <= 0.1 else scaled))
    return [
        replace(
            own, subject="calibration", name=name, intrinsics=other,
            remedy=f"set fx fy cx cy in the calibration to {other.fx:.6g} {other.fy:.6g} "
            f"{other.cx - 0.5:.6g} {other.cy - 0.5:.6g} (the first pixel's centre at 0)",
        )
        for name, other in found
    ]  # fmt: skip


def fit_readings(
    candidates: list[Reading],
    depths: UInt16[np.ndarray, "frames height width"],
    file_poses: Float[np.ndarray, "frames 4 4"],
    pairs: Int[np.ndarray, "pairs 2"],
) -> list[Fit]:
    """The fit of every candidate, in their order.

    Args:
        depths: as in the files, 0 = no measurement.
        file_poses: matrices as they stand in the file; no NaN.
        pairs: indices (a, b): points that frame a measured are looked up in frame b.
    """
    stride = math.ceil((depths[0].size / _POINTS_PER_FRAME) ** 0.5)
    grid = depths[pairs[:, 0], ::stride, ::stride]
    pair, rows, columns = np.nonzero(grid)
    samples = _Samples(pair, rows * stride, columns * stride, grid[pair, rows, columns])
    return [_fit(reading, samples, depths, file_poses, pairs) for reading in candidates]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Measured pixels of a regular grid in the first frame of every pair."""

    pair: Int[np.ndarray, "n"]
    rows: Int[np.ndarray, "n"]
    columns: Int[np.ndarray, "n"]
    values: UInt16[np.ndarray, "n"]  # depth, as in the file


def _fit(
    reading: Reading,
    samples: _Samples,
    depths: UInt16[np.ndarray, "frames height width"],
    file_poses: Float[np.ndarray, "frames 4 4"],
    pairs: Int[np.ndarray, "pairs 2"],
) -> Fit:
    camera, metres = reading.intrinsics, _metres_per_value(reading)
    z = samples.values * metres[samples.rows, samples.columns]
    x = (samples.columns + 0.5 - camera.cx) / camera.fx
    y = (samples.rows + 0.5 - camera.cy) / camera.fy
    points_a = np.stack([x * z, y * z, z], axis=1)
    T_world_camera = reading.to_opencv(file_poses)
    T_world_a, T_world_b = T_world_camera[pairs[:, 0]], T_world_camera[pairs[:, 1]]
    T_b_a = np.linalg.solve(T_world_b, T_world_a)[samples.pair]
    points_b = np.einsum("nij,nj->ni", T_b_a[:, :3, :3], points_a) + T_b_a[:, :3, 3]
    frames_b = pairs[:, 1][samples.pair]
    behind, measured = _behind_surface(camera, points_b, frames_b, depths, metres)
    if len(behind) == 0:
        return Fit(reading, float("nan"), float("nan"), 0.0)
    apart = np.abs(behind)
    return Fit(
        reading, float(np.median(apart)), float(np.median(apart / measured)),
        len(apart) / len(samples.values),
    )  # fmt: skip


def _metres_per_value(reading: Reading) -> Float[np.ndarray, "height width"]:
    lengths = ray_lengths(reading.intrinsics)
    return (1.0 / lengths if reading.along_ray else np.ones_like(lengths)) / reading.depth_scale


def _with_rolled_quaternions(
    poses: Float[np.ndarray, "n 4 4"], places: int
) -> Float[np.ndarray, "n 4 4"]:
    rolled = poses.copy()
    q_read = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rolled[:, :3, :3] = Rotation.from_quat(np.roll(q_read, places, axis=1)).as_matrix()
    return rolled


def _behind_surface(
    camera: Intrinsics,
    points_camera: Float[np.ndarray, "n 3"],
    frames: Int[np.ndarray, "n"],
    depths: UInt16[np.ndarray, "frames height width"],
    metres: Float[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "seen"], Float[np.ndarray, "seen"]]:
    """How far (m) points lie behind what a frame measured in their direction, and that depth (m).

    The measured depth is interpolated between four pixels, in 1/z: for planes that is exact.
    Points are left out where the four lie on different surfaces, and where they are hidden.

    Args:
        points_camera: m, in the axes of the frame that each is looked up in.
        frames: that frame, by its index in `depths`.
        metres: that a depth value of 1 stands for, by pixel.
    """
    in_front = points_camera[:, 2] > 1e-6
    (x, y, z), frames = points_camera[in_front].T, frames[in_front]
    columns = camera.fx * x / z + camera.cx - 0.5
    rows = camera.fy * y / z + camera.cy - 0.5
    height, width = metres.shape
    inside = (columns >= 0) & (columns < width - 1) & (rows >= 0) & (rows < height - 1)
    columns, rows, z, frames = columns[inside], rows[inside], z[inside], frames[inside]
    left, top = columns.astype(int), rows.astype(int)
    corners = np.stack([
        depths[frames, top + down, left + right] * metres[top + down, left + right]
        for down in (0, 1) for right in (0, 1)
    ])  # fmt: skip
    smooth = corners.min(axis=0) > (1 - _SAME_SURFACE) * corners.max(axis=0)
    right, down = (columns - left)[smooth], (rows - top)[smooth]
    weights = np.stack(
        [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    )
    measured = 1 / (weights / corners[:, smooth]).sum(axis=0)
    behind = z[smooth] - measured
    seen = behind < _HIDDEN_BEHIND
    return behind[seen], measured[seen]


def best_fit(fits: list[Fit]) -> Fit:
    """The declared reading (the first), unless another one fits clearly better.

    Clearly means that surfaces meet, at half the distance or less and with no less than half the
    overlap: a reading that turns cameras away from each other may agree on the few points that
    are left, and where no reading fits, something else is wrong.
    """
    own = fits[0]
    most = max(fit.overlap for fit in fits)
    rivals = [
        f for f in fits if f.overlap >= max(most / 2, LEAST_OVERLAP) and f.median_m < FAR_APART
    ]
    least = min((fit.relative for fit in rivals), default=float("inf"))
    meets = own.overlap >= max(most / 2, LEAST_OVERLAP)
    if not rivals or (meets and least > _needed(own.relative)):
        return own
    return next(f for f in rivals if f.relative <= max(1.1 * least, least + _LEAST_GAIN))


def fits_alike(own: Fit, other: Fit) -> bool:
    """Whether the data cannot tell a reading from the declared one."""
    return other.overlap >= own.overlap / 2 and own.relative >= _needed(other.relative)


def _needed(relative: float) -> float:
    """What a better reading must reach."""
    return min(_CLEARLY_BETTER * relative, relative - _LEAST_GAIN)
