"""Small blurry views of a map's frames, by which a camera is found that may be anywhere in it.

A view is what a camera saw along fixed directions, whatever its lens: luma and depth, blurred.
Source: the small blurry images of PTAM (Klein and Murray 2008); views spread by place and
direction, and depth in them, as in Glocker et al. 2015. Sizes, weights and numbers: our choice.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from nbtrack.core.arrays import Poses, Values
from nbtrack.data.frame import MILLIMETRE, Frame

_COLUMNS = 20
_ROWS = 15
_STEP = 0.05  # between directions x / z and y / z of a view, which spans 53 by 41 degrees
_DEPTH_UNIT = 0.05  # m; depths are kept in a byte, 0 where less than half of a cell was measured
_MAX_LOG_RATIO = 0.3  # of depths; those that differ by more are of other surfaces
_DEPTH_WEIGHT = 2.0  # of the depths' unlikeness against the luma's
View = UInt8[Tensor, "2 15 20"]
Views = UInt8[Tensor, "n 2 15 20"]


class Viewpoints(NamedTuple):
    """Some of the poses that a map was made from, and what the camera saw from them."""

    T_world_camera: Poses
    views: Views


def view_of(frame: Frame) -> View:
    """Luma (1 to 255; 0 out of the picture) and depth (in `_DEPTH_UNIT`), in one byte each.

    Luma is here the mean of red, green and blue. The frame is averaged in cells as large as those
    of a view, then interpolated along a view's directions.
    """
    camera = frame.camera
    grey, depth_mm = frame.color.float().mean(dim=-1), frame.depth_mm.float()
    parts = torch.stack([grey, depth_mm * (MILLIMETRE / _DEPTH_UNIT), (depth_mm > 0).float()])
    n_rows = max(1, round(camera.height / (camera.fy * _STEP)))
    n_columns = max(1, round(camera.width / (camera.fx * _STEP)))
    blurred = adaptive_avg_pool2d(parts.to("cpu"), (n_rows, n_columns))
    x = _STEP * (torch.arange(_COLUMNS).float() - (_COLUMNS - 1) / 2)
    y = _STEP * (torch.arange(_ROWS).float() - (_ROWS - 1) / 2)
    # The directions' pixels, as `grid_sample` takes them: the picture spans -1 to 1.
    u = 2 * (camera.fx * x + camera.cx) / camera.width - 1
    v = 2 * (camera.fy * y + camera.cy) / camera.height - 1
    at = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    luma, depth, share = grid_sample(blurred[None], at[None], align_corners=False)[0]
    luma_inside = luma.clamp(1, 255) * (at.abs() < 1).all(dim=-1)
    mean_depth = torch.where(share > 0.5, depth / share, 0).clamp(0, 255)
    return torch.stack([luma_inside, mean_depth]).round().byte()


def spread_out(T_world_camera: Poses) -> Int[np.ndarray, "_"]:
    """Numbers of poses for views, spread by place and direction.

    The first pose is chosen, and then repeatedly the one that is farthest from all chosen ones.
    """
    # Poses whose optical axes differ by 1 are as far apart as if moved by 1 m.
    places = np.concatenate([T_world_camera[:, :3, 3], T_world_camera[:, :3, 2]], axis=1)
    chosen = [0]
    apart = np.full(len(places), np.inf)
    while len(chosen) < min(150, len(places)):  # 90 kB of views
        apart = np.minimum(apart, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return np.array(chosen)


def retrieve(view: View, viewpoints: Viewpoints, n: int) -> Poses:
    """Where a camera may be that saw a view: the poses of the `n` views most like it, in order.

    Each is turned about the camera's x and y as it fits best: shifts of a view's cells stand for
    turns.
    """
    # A camera may be turned against a view, by so many rows and columns.
    turns = [(down, across) for across in range(-6, 7, 3) for down in range(-3, 4, 3)]
    here, there = view.float(), viewpoints.views.float()
    unlikeness = [_unlikeness(_moved(here, y, x), _moved(there, -y, -x)) for y, x in turns]
    minimum, best = torch.stack(unlikeness).min(dim=0)
    order = minimum.argsort()[:n].numpy()
    # A turn down is about x, one across about y the other way.
    rotations = _STEP * np.array([[down, -across, 0.0] for down, across in turns])
    poses = viewpoints.T_world_camera[order]
    poses[:, :3, :3] @= Rotation.from_rotvec(rotations[best[order].numpy()]).as_matrix()
    return poses


def _moved(view: Tensor, down: int, across: int) -> Tensor:
    """The part of a view that overlaps with another one, which is shifted by so many cells.

    Of the other view it is `_moved(other, -down, -across)`.
    """
    rows = slice(max(0, down), _ROWS + min(0, down))
    columns = slice(max(0, across), _COLUMNS + min(0, across))
    return view[..., rows, columns]


def _unlikeness(here: Float[Tensor, "2 _ _"], there: Float[Tensor, "n 2 _ _"]) -> Values:
    """How unlike a view is to others: 1 - correlation of luma, plus `_DEPTH_WEIGHT` times how far
    depths are apart; 0 for the same.

    Depths are apart by their log ratio, as a share of `_MAX_LOG_RATIO` and at most 1, in the mean
    over cells where both are measured; by 1 if too few are.
    """
    is_seen = ((here[0] > 0) & (there[:, 0] > 0)).float()
    first, second = _centred(here[0], is_seen), _centred(there[:, 0], is_seen)
    norms = first.norm(dim=(1, 2)) * second.norm(dim=(1, 2))
    correlation = (first * second).sum(dim=(1, 2)) / norms.clamp(min=1e-3)
    are_measured = ((here[1] > 0) & (there[:, 1] > 0)).float()
    n_measured = are_measured.sum(dim=(1, 2))
    log_ratio = (here[1].clamp(min=1) / there[:, 1].clamp(min=1)).log().abs()
    apart = (log_ratio / _MAX_LOG_RATIO).clamp(max=1) * are_measured
    # Up to 30 cells with both depths say nothing.
    mean_apart = torch.where(n_measured > 30, apart.sum(dim=(1, 2)) / n_measured, 1.0)
    return 1 - correlation + _DEPTH_WEIGHT * mean_apart


def _centred(luma: Tensor, is_seen: Float[Tensor, "n _ _"]) -> Float[Tensor, "n _ _"]:
    """Luma less its mean over the cells that both views see (1, else 0); 0 in the others."""
    n_seen = is_seen.sum(dim=(1, 2), keepdim=True).clamp(min=1)
    mean = (luma * is_seen).sum(dim=(1, 2), keepdim=True) / n_seen
    return (luma - mean) * is_seen
