"""Relocalisation by small blurry views of a map's frames, for a camera that may be anywhere.

A view holds the blurred luma and depth that a camera saw along 20 x 15 fixed directions. So views
of cameras with other lenses can be compared.
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
_STEP = 0.05  # of x / z and y / z from one direction to the next: a view spans 53 by 41 degrees
_DEPTH_UNIT = 0.05  # m; a view's depths are bytes in this unit, and 0 if unknown
# Two depths with a larger |log ratio| are of different surfaces. Their ratio counts as this one.
_MAX_LOG_RATIO = 0.3
_DEPTH_WEIGHT = 2.0  # weight of the dissimilarity of depths; the dissimilarity of luma has 1
View = UInt8[Tensor, "2 15 20"]  # luma and depth


class Viewpoints(NamedTuple):
    """Some of the poses that a map was made from, and the views from them."""

    T_world_camera: Poses
    views: UInt8[Tensor, "n 2 15 20"]


def view_of(frame: Frame) -> View:
    """The view of a frame: luma and depth along fixed directions, in one byte each.

    The frame is averaged in cells of the size `_STEP`, and then interpolated along the view's
    directions. Luma is here the mean of red, green and blue, from 1 to 255, and 0 along directions
    outside of the picture. Depth is in `_DEPTH_UNIT`, at most 12.75 m, and 0 if half of a cell or
    less was measured.
    """
    camera = frame.camera
    luma, depth_mm = frame.color.float().mean(dim=-1), frame.depth_mm.float()
    # Unmeasured depths are 0. The mean measured depth of a cell is the mean of all its depths,
    # divided by the share of its pixels that are measured.
    parts = torch.stack([luma, depth_mm * (MILLIMETRE / _DEPTH_UNIT), (depth_mm > 0).float()])
    n_rows = max(1, round(camera.height / (camera.fy * _STEP)))
    n_columns = max(1, round(camera.width / (camera.fx * _STEP)))
    blurred = adaptive_avg_pool2d(parts.to("cpu"), (n_rows, n_columns))
    x = _STEP * (torch.arange(_COLUMNS).float() - (_COLUMNS - 1) / 2)
    y = _STEP * (torch.arange(_ROWS).float() - (_ROWS - 1) / 2)
    # Where the directions meet the picture, as `grid_sample` takes positions: it spans -1 to 1.
    u = 2 * (camera.fx * x + camera.cx) / camera.width - 1
    v = 2 * (camera.fy * y + camera.cy) / camera.height - 1
    uv = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    luma, depth, share = grid_sample(blurred[None], uv[None], align_corners=False)[0]
    luma_inside = luma.clamp(1, 255) * (uv.abs() < 1).all(dim=-1)
    mean_depth = torch.where(share > 0.5, depth / share, 0).clamp(0, 255)
    return torch.stack([luma_inside, mean_depth]).round().byte()


def spread_out(T_world_camera: Poses) -> Int[np.ndarray, "_"]:
    """Indices of at most 150 poses that are spread out over places and viewing directions.

    Farthest point sampling: the first pose is chosen, and then repeatedly the pose that is farthest
    from all chosen ones.
    """
    # Position (m) and optical axis: axes that differ by 1 count as much as positions 1 m apart.
    places = np.concatenate([T_world_camera[:, :3, 3], T_world_camera[:, :3, 2]], axis=1)
    chosen = [0]
    distances = np.full(len(places), np.inf)  # of each place from the nearest chosen one
    while len(chosen) < min(150, len(places)):  # 90 kB of views
        distances = np.minimum(distances, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(distances.argmax()))
    return np.array(chosen)


def retrieve(view: View, viewpoints: Viewpoints, n: int) -> Poses:
    """Poses from which a view may have been seen: those of the `n` most similar viewpoints.

    The most similar one comes first. The camera may be turned relative to a viewpoint. So the
    viewpoint's view is compared at several shifts by rows and columns, and its pose is turned about
    the camera's x and y axes by the angles of the best shift.
    """
    shifts = [(down, across) for across in range(-6, 7, 3) for down in range(-3, 4, 3)]  # in cells
    here, there = view.float(), viewpoints.views.float()
    costs = [_dissimilarity(_cropped(here, y, x), _cropped(there, -y, -x)) for y, x in shifts]
    minimum, best_shift = torch.stack(costs).min(dim=0)  # for each viewpoint
    order = minimum.argsort()[:n].numpy()
    # A camera that is turned up sees the same things lower: a positive turn about x. A camera that
    # is turned left sees them farther right: a negative turn about y.
    rotations = _STEP * np.array([[down, -across, 0.0] for down, across in shifts])
    poses = viewpoints.T_world_camera[order]
    poses[:, :3, :3] @= Rotation.from_rotvec(rotations[best_shift[order].numpy()]).as_matrix()
    return poses


def _cropped(view: Tensor, down: int, across: int) -> Tensor:
    """Crop a view to what another view shows `down` rows higher and `across` columns farther left.

    The matching cells of the other view are `_cropped(other, -down, -across)`.
    """
    rows = slice(max(0, down), _ROWS + min(0, down))
    columns = slice(max(0, across), _COLUMNS + min(0, across))
    return view[..., rows, columns]


def _dissimilarity(here: Float[Tensor, "2 _ _"], there: Float[Tensor, "n 2 _ _"]) -> Values:
    """The dissimilarities of a view from n others: luma's plus `_DEPTH_WEIGHT` times depth's.

    The dissimilarity of luma is 1 minus the correlation over the cells that both views see. The
    dissimilarity of depth is the mean of |log ratio| / `_MAX_LOG_RATIO`, of which each counts as at
    most 1, over the cells that both views measured. It is 1 if these are at most 30 of 300.
    """
    is_seen = ((here[0] > 0) & (there[:, 0] > 0)).float()
    first, second = _centred(here[0], is_seen), _centred(there[:, 0], is_seen)
    norms = first.norm(dim=(1, 2)) * second.norm(dim=(1, 2))
    correlation = (first * second).sum(dim=(1, 2)) / norms.clamp(min=1e-3)
    are_measured = ((here[1] > 0) & (there[:, 1] > 0)).float()
    n_measured = are_measured.sum(dim=(1, 2))
    log_ratio = (here[1].clamp(min=1) / there[:, 1].clamp(min=1)).log().abs()
    of_cells = (log_ratio / _MAX_LOG_RATIO).clamp(max=1) * are_measured
    of_depth = torch.where(n_measured > 30, of_cells.sum(dim=(1, 2)) / n_measured, 1.0)
    return 1 - correlation + _DEPTH_WEIGHT * of_depth


def _centred(luma: Tensor, is_seen: Float[Tensor, "n _ _"]) -> Float[Tensor, "n _ _"]:
    """Luma minus its mean over the cells where `is_seen` is 1; 0 in the cells where it is 0."""
    n_seen = is_seen.sum(dim=(1, 2), keepdim=True).clamp(min=1)
    mean = (luma * is_seen).sum(dim=(1, 2), keepdim=True) / n_seen
    return (luma - mean) * is_seen
