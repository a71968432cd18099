"""What a recording says of the map that it was tracked in: frames outside, and depths that misfit.

At a pose that is right but for a little, a measured point p (camera frame) has a distance r in the
map, whose gradient is q (camera frame). If all depths of the recording are too long by a share s,
r = -s (q . p) plus what a small motion of the camera explains; if its focal lengths are too long,
p changes across the axis alone. One number for all frames, and a motion for each, are a linear
least-squares problem: the motions are projected out of each frame.
"""

import math

import numpy as np
import torch
from jaxtyping import Float

from nbtrack.core.arrays import Pose, Poses, WorldPoints
from nbtrack.data.sequence import RgbdSequence
from nbtrack.fields import Field

_N_POINTS = 500  # measured ones of a frame
_MAX_DISTANCE = 0.1  # m; points farther from any surface tell nothing
_N_FRAMES = 40  # looked at
_MIN_FRAMES = 8  # that an estimate needs
_MIN_POINTS = 50  # the same, of each frame
_MOSTLY = 0.5  # share of a frame's points outside of the map's bounds, where the frame lies outside
_TINY = 1e-12
# What motions leave of a column, as a share of the points' distances from the camera: before a flat
# wall 1 %, which is noise of the map's gradients; in rooms 10 % and more.
_MIN_LEFT = 0.03
_NEGLIGIBLE = 0.01  # share by which depths may misfit (our choice)
_RESAMPLED = 200  # draws of a bootstrap
_INTERVAL = [0.025, 0.975]  # its quantiles
_EXPLANATIONS = {  # how a point changes with each: factors of its x, y and z
    "depths": np.array([1.0, 1.0, 1.0]),
    "focal lengths": np.array([-1.0, -1.0, 0.0]),
}


def look_in_map(field: Field, sequence: RgbdSequence, T_estimated: Poses) -> dict[str, float | str]:
    """Look at some frames, spread evenly: whether what they measured lies outside of the map, at
    their true poses where known, and how it misfits at the estimated ones.

    Returns `outside_map_share`, that of the frames that saw little of what was mapped, and
    `map_misfit`, a sentence, which is empty where nothing misfits.
    """
    outside = []
    sums = []
    low, high = np.array([field.bounds.minimum, field.bounds.maximum])
    for index in range(0, len(sequence), math.ceil(len(sequence) / _N_FRAMES)):
        frame = sequence[index]
        pixels = frame.measured_pixels()
        if not pixels.shape[1]:
            continue
        drawn = np.random.default_rng(index).permutation(pixels.shape[1])[:_N_POINTS]
        points = frame.points(*pixels[:, drawn])[0].double().numpy()
        T = sequence.T_world_camera[index]
        world = _moved(points, T if np.isfinite(T).all() else T_estimated[index])
        outside.append(((world < low) | (world > high)).any(axis=1).mean() > _MOSTLY)
        if field.is_distance:
            sums.append(_without_motion(field, points, T_estimated[index]))
    sums = [part for part in sums if part is not None]
    misfit = _misfit(np.array(sums)) if len(sums) >= _MIN_FRAMES else ""
    return {"outside_map_share": float(np.mean(outside or [0.0])), "map_misfit": misfit}


def _moved(points: WorldPoints, T_world_camera: Pose) -> WorldPoints:
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def _without_motion(field: Field, points: WorldPoints, T: Pose) -> Float[np.ndarray, "4 2"] | None:
    """A column an explanation, motions projected out: its products with residuals and with itself,
    the sum of squared distances, and the variance of residuals (m²); None of few. Points are in the
    camera's frame (m)."""
    x = torch.from_numpy(_moved(points, T)).float().to(field.device).requires_grad_()
    distance = field(x)[1]
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    r = distance.detach().cpu().double().numpy()
    near = np.abs(r) < _MAX_DISTANCE
    if near.sum() < _MIN_POINTS:
        return None
    q = (gradient.cpu().double().numpy() @ T[:3, :3])[near]
    p = points[near]
    motions, _ = np.linalg.qr(np.hstack([np.cross(p, q), q]))
    columns = np.column_stack([r[near], *((q * p) @ change for change in _EXPLANATIONS.values())])
    columns -= motions @ (motions.T @ columns)
    squares = (columns**2).sum(axis=0)
    products = columns[:, 1:].T @ columns[:, 0]
    return np.stack([products, squares[1:], 2 * [(p**2).sum()], 2 * [squares[0] / len(p)]])


def _misfit(sums: Float[np.ndarray, "frames 4 2"]) -> str:
    """A sentence on the explanation that takes most off the residuals, if it is not negligible."""
    drawn = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLED, len(sums)))
    products, squares, _, _ = np.moveaxis(sums[drawn].sum(axis=1), 1, 0)
    low, high = np.quantile(products / squares.clip(_TINY), _INTERVAL, axis=0)
    products, squares, far, variance = sums.sum(axis=0)
    shares = products / squares.clip(_TINY)
    # With up to three walls in view a motion does the same as a scale, which is then not known.
    error = np.sqrt(variance / len(sums) / squares.clip(_TINY))
    is_told = (error < _NEGLIGIBLE / 2) & (squares > _MIN_LEFT**2 * far)
    gains = np.where(is_told, products * shares, 0.0)
    best = int(gains.argmax())
    low, high = low[best], high[best]
    if not gains.any() or (low <= _NEGLIGIBLE and high >= -_NEGLIGIBLE):
        return ""
    name = [*_EXPLANATIONS][best]
    return (
        f"residuals in the map grow with depth, as if {name} were off by {shares[best]:+.1%} "
        f"({low:+.1%} to {high:+.1%}), or somewhat more, against those of the map: compare both by "
        "`data check`"
    )
