"""What a recording says of the map that it was tracked in: frames outside, and depths that misfit.

At a pose that is right but for a little, a measured point p (camera frame) has a distance r in the
map, whose gradient is q (camera frame). If all depths of the recording are too long by a share s,
r = -s (q . p) plus what a small motion of the camera explains; if its focal lengths are too long,
p changes across the axis alone. One number for all frames, and a motion for each, are a linear
least-squares problem: the motions are projected out of each frame.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.core.arrays import Points, Pose, Poses
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field

# Measured points of a frame; those farther than the second (m) from any surface tell nothing.
_N_POINTS, _MAX_DISTANCE = 500, 0.1
_N_FRAMES, _MIN_FRAMES, _MIN_POINTS = 40, 8, 50  # looked at, and what an estimate needs
_MOSTLY = 0.5  # share of a frame's points outside of the map's bounds, where the frame lies outside
_TINY = 1e-12
_NEGLIGIBLE = 0.01  # share by which depths may misfit (our choice)
_RESAMPLED, _INTERVAL = 200, [0.025, 0.975]
_EXPLANATIONS = {  # how a point changes with each: factors of its x, y and z
    "depths": np.array([1.0, 1.0, 1.0]),
    "focal lengths": np.array([-1.0, -1.0, 0.0]),
}


@dataclass(frozen=True)
class InMap:
    """How a tracked recording lies in a map."""

    outside_share: float  # of frames that saw little of what was mapped
    misfit: str  # a sentence; empty where nothing misfits


def look_in_map(field: Field, sequence: RgbdSequence, T_estimated: Poses) -> InMap:
    """Look at some frames, spread evenly: whether what they measured lies outside of the map, at
    their true poses where known, and how it misfits at the estimated ones."""
    outside, parts = [], []
    low, high = (torch.tensor(corner) for corner in (field.bounds.minimum, field.bounds.maximum))
    for index in range(0, len(sequence), math.ceil(len(sequence) / _N_FRAMES)):
        points, T = _points_of(sequence, index), sequence.T_world_camera[index]
        if not len(points):
            continue
        x = _moved(points, T if np.isfinite(T).all() else T_estimated[index])
        is_inside = ((x >= low) & (x <= high)).all(dim=-1)
        outside.append(float(is_inside.float().mean()) < _MOSTLY)
        if field.is_distance:
            parts.append(_without_motion(field, points, T_estimated[index]))
    parts = [part for part in parts if part is not None]
    return InMap(float(np.mean(outside or [0.0])), _misfit(np.array(parts)))


def _points_of(sequence: RgbdSequence, index: int) -> Points:
    """Random measured points (m, camera frame) of a frame."""
    frame = sequence[index]
    pixels = frame.measured_pixels()
    order = torch.randperm(pixels.shape[1], generator=torch.Generator().manual_seed(index))
    return frame.points(*pixels[:, order[:_N_POINTS]])[0]


def _moved(points: Points, T_world_camera: Pose) -> Points:
    pose = torch.from_numpy(T_world_camera).float()
    return points @ pose[:3, :3].T + pose[:3, 3]


def _without_motion(field: Field, points: Points, T: Pose) -> Float[np.ndarray, "3 2"] | None:
    """A column an explanation, motions projected out: its products with residuals and with itself,
    and the variance of residuals (m²)."""
    x = _moved(points, T).to(field.device).requires_grad_()
    distance = field(x)[1]
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    r, q = distance.detach().cpu().double().numpy(), gradient.cpu().double().numpy() @ T[:3, :3]
    near = np.abs(r) < _MAX_DISTANCE
    if near.sum() < _MIN_POINTS:
        return None
    r, q, p = r[near], q[near], points.double().numpy()[near]
    motions, _ = np.linalg.qr(np.hstack([np.cross(p, q), q]))
    columns = np.column_stack([r, *((q * p) @ change for change in _EXPLANATIONS.values())])
    columns -= motions @ (motions.T @ columns)
    squares = (columns**2).sum(axis=0)
    return np.stack([columns[:, 1:].T @ columns[:, 0], squares[1:], 2 * [squares[0] / len(r)]])


def _misfit(sums: Float[np.ndarray, "frames 3 2"]) -> str:
    """A sentence on the explanation that takes most off the residuals, if it is not negligible."""
    if len(sums) < _MIN_FRAMES:
        return ""
    drawn = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLED, len(sums)))
    products, squares, variance = sums.sum(axis=0)
    # With up to three walls in view a motion does the same as a scale, which is then not known.
    error = np.sqrt(variance / len(sums) / squares.clip(_TINY))
    gains = np.where(error < _NEGLIGIBLE / 2, products**2 / squares.clip(_TINY), 0.0)
    best = int(gains.argmax())
    of_draws = sums[drawn].sum(axis=1)[:, :, best]
    low, high = np.quantile(of_draws[:, 0] / of_draws[:, 1].clip(_TINY), _INTERVAL)
    if not gains.any():
        return ""
    if not (low > _NEGLIGIBLE or high < -_NEGLIGIBLE):
        return ""
    off, name = products[best] / squares[best], [*_EXPLANATIONS][best]
    return (
        f"residuals in the map grow with depth, as if {name} were off by {off:+.1%} ({low:+.1%} to "
        f"{high:+.1%}), or somewhat more, against those of the map: compare both by `data check`"
    )
