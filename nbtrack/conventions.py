"""Which way do the camera's axes point? Depth maps projected into each other give the answer.

Poses are only right if the surfaces that two frames see lie on each other. Each candidate reading
of a pose file is applied to pairs of frames, and the distance between the surfaces is measured.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt16

from nbtrack.camera import Intrinsics, backproject, project
from nbtrack.data import MILLIMETRE

# A point further than this behind what a frame measured is hidden there and says nothing. Points
# in front of the measured surface contradict the poses at any distance.
_HIDDEN_BEHIND = 0.25  # m, our choice: several times a depth camera's noise
_CLEARLY_BETTER = 0.5  # of the distance as the file stands (our choice)
_LEAST_GAIN = 1e-3  # m, depth's resolution on disk: no gain below it means anything
FAR_APART = 0.05  # m, median distance above which a map of the scene would be blurred (our choice)
LEAST_OVERLAP = 0.15  # share of points below which a median tells nothing (our choice)
_POINTS_PER_FRAME = 5000


@dataclass(frozen=True)
class Convention:
    """A reading of pose files: camera axes, and which way the matrix maps."""

    name: str
    axes: tuple[tuple[int, int, int], ...]  # columns: OpenCV's x, y, z in the file's camera axes
    world_to_camera: bool = False

    def to_opencv(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Camera-to-world poses with OpenCV camera axes, if `poses` follow this convention."""
        T_world_camera = np.linalg.inv(poses) if self.world_to_camera else poses
        return T_world_camera @ _homogeneous(self.axes)

    @property
    def conversion(self) -> str:
        """NumPy expression that turns `poses` of this convention into those of the layout."""
        change = _homogeneous(self.axes) @ _homogeneous(OPENGL.axes)
        matrix = "numpy.linalg.inv(poses)" if self.world_to_camera else "poses"
        text = matrix if np.array_equal(change, np.eye(4)) else f"{matrix} @ {_matrix_text(change)}"
        # Left-handed axes come with a mirrored world, which must be mirrored back.
        left_handed = np.linalg.det(change) < 0
        return f"numpy.diag([1, 1, -1, 1]) @ {text}" if left_handed else text


def _homogeneous(axes: tuple[tuple[int, int, int], ...]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    return matrix


def _matrix_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    whole = matrix.astype(int)
    diagonal = np.array_equal(whole, np.diag(whole.diagonal()))
    return (
        f"numpy.diag({whole.diagonal().tolist()})" if diagonal else f"numpy.array({whole.tolist()})"
    )


def _flipped(x: int, y: int, z: int) -> tuple[tuple[int, int, int], ...]:
    return ((x, 0, 0), (0, y, 0), (0, 0, z))


OPENGL = Convention("OpenGL axes (x right, y up, z backward)", _flipped(1, -1, -1))
_CAMERA_TO_WORLD = (
    OPENGL,
    Convention("OpenCV axes (x right, y down, z forward)", _flipped(1, 1, 1)),
    Convention("robot axes (x forward, y left, z up)", ((0, 0, 1), (-1, 0, 0), (0, -1, 0))),
    Convention("left-handed axes (x right, y up, z forward)", _flipped(1, -1, 1)),
    Convention("PyTorch3D axes (x left, y up, z forward)", _flipped(-1, -1, 1)),
    Convention("flipped axes (x left, y down, z backward)", _flipped(-1, 1, -1)),
    Convention("left-handed axes (x left, y down, z forward)", _flipped(-1, 1, 1)),
    Convention("left-handed axes (x left, y up, z backward)", _flipped(-1, -1, -1)),
    Convention("left-handed axes (x right, y down, z backward)", _flipped(1, 1, -1)),
)
# The common ones first: where several fit alike, the first is named.
CONVENTIONS = tuple(
    Convention(f"{c.name}, {'world-to-camera' if inverse else 'camera-to-world'}", c.axes, inverse)
    for inverse in (False, True)
    for c in _CAMERA_TO_WORLD
)
LAYOUT_CONVENTION = CONVENTIONS[0]  # what the Neural RGB-D layout demands


@dataclass(frozen=True)
class ConventionFit:
    """How well frames agree with each other when poses are read in one way."""

    convention: Convention
    median_m: float  # median |z difference| over the points that overlap; NaN if none does
    overlap: float  # share of all points that fall onto a measured, not nearer, pixel


def fit_conventions(
    intrinsics: Intrinsics,
    depths_mm: UInt16[np.ndarray, "frames height width"],
    poses: Float[np.ndarray, "frames 4 4"],
    pairs: Int[np.ndarray, "pairs 2"],
) -> list[ConventionFit]:
    """The fit of every candidate, in the order of `CONVENTIONS`.

    Args:
        poses: matrices as they stand in the file.
        pairs: indices (a, b): points that frame a measured are looked up in frame b.
    """
    clouds = [_points(intrinsics, depths_mm[a]) for a, _ in pairs]
    fits = []
    for convention in CONVENTIONS:
        T_world_camera = convention.to_opencv(poses)
        distances, n_points = [], 0
        for (a, b), points in zip(pairs, clouds, strict=True):
            T_b_a = np.linalg.inv(T_world_camera[b]) @ T_world_camera[a]
            points_b = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
            distances.append(_overlap_distances(intrinsics, points_b, depths_mm[b]))
            n_points += len(points)
        together = np.concatenate(distances) if distances else np.zeros(0)
        median_m = float(np.median(together)) if len(together) else float("nan")
        fits.append(ConventionFit(convention, median_m, len(together) / max(1, n_points)))
    return fits


def best_fit(fits: list[ConventionFit]) -> ConventionFit:
    """The layout's own reading, unless another one fits clearly better.

    Clearly means that surfaces meet, at half the distance or less and with no less than half the
    overlap: a reading that turns cameras away from each other may agree on the few points that
    are left, and where no reading fits, something other than the axes is wrong.
    """
    own = fits[0]
    most = max(fit.overlap for fit in fits)
    rivals = [f for f in fits if f.overlap >= max(most / 2, LEAST_OVERLAP)]
    least = min((fit.median_m for fit in rivals), default=float("inf"))
    needed = FAR_APART
    if own in rivals:
        needed = min(needed, _CLEARLY_BETTER * own.median_m, own.median_m - _LEAST_GAIN)
    if not least < needed:
        return own
    return next(fit for fit in rivals if fit.median_m <= max(1.1 * least, least + _LEAST_GAIN))


def fits_alike(own: ConventionFit, other: ConventionFit) -> bool:
    """Whether the data cannot tell a reading from the layout's own."""
    return other.overlap >= own.overlap / 2 and (
        own.median_m >= min(_CLEARLY_BETTER * other.median_m, other.median_m - _LEAST_GAIN)
    )


def _points(
    intrinsics: Intrinsics, depth_mm: UInt16[np.ndarray, "height width"]
) -> Float[np.ndarray, "n 3"]:
    """Points (m, camera frame, OpenCV axes) of a regular grid of measured pixels."""
    stride = max(1, round((depth_mm.size / _POINTS_PER_FRAME) ** 0.5))
    rows, columns = np.nonzero(depth_mm[::stride, ::stride])
    rows, columns = torch.from_numpy(rows * stride), torch.from_numpy(columns * stride)
    depth = torch.from_numpy(depth_mm.astype(np.float32) * np.float32(MILLIMETRE))[rows, columns]
    return backproject(intrinsics, columns, rows, depth).double().numpy()


def _overlap_distances(
    intrinsics: Intrinsics,
    points_camera: Float[np.ndarray, "n 3"],
    depth_mm: UInt16[np.ndarray, "height width"],
) -> Float[np.ndarray, "overlapping"]:
    """|z difference| (m) between points and what the frame measured in their direction."""
    in_front = points_camera[points_camera[:, 2] > 1e-3]
    columns, rows, depth = (v.numpy() for v in project(intrinsics, torch.from_numpy(in_front)))
    height, width = depth_mm.shape
    inside = (np.abs(columns - (width - 1) / 2) < width / 2) & (
        np.abs(rows - (height - 1) / 2) < height / 2
    )
    columns, rows = columns[inside].round().astype(int), rows[inside].round().astype(int)
    measured = depth_mm[rows.clip(0, height - 1), columns.clip(0, width - 1)] * MILLIMETRE
    behind = depth[inside] - measured
    return np.abs(behind[(measured > 0) & (behind < _HIDDEN_BEHIND)])
