"""Small blurry views of a map's frames, by which a camera is found that may be anywhere in it.

A view is what a camera saw along fixed directions, whatever its lens: luma and depth, blurred.
Source: the small blurry images of PTAM (Klein and Murray 2008), with depth as in Glocker et al.
2015. Sizes, weights and numbers: our choice.
"""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, grid_sample

from nbtrack.core.arrays import Poses
from nbtrack.data.frame import MILLIMETRE, Frame

# Directions x / z and y / z of a view: so many columns and rows, so far apart, 53 by 41 degrees.
_COLUMNS, _ROWS, _STEP = 20, 15, 0.05
_DEPTH_UNIT = 0.05  # m; depths are kept in one byte, 0 where little was measured
_MAX_VIEWS = 150  # 360 kB
_RADIAN = 1.0  # m; of how far apart two poses are: as much as turning the optical axis so far
# A camera may be turned against a view: by so many columns and rows, and in steps of so many.
_TURNS, _TURN_STEP = (6, 3), 3
_MAX_LOG_RATIO = 0.3  # of depths; those that differ by more are of other surfaces
View = UInt8[Tensor, "2 rows columns"]


def view_of(frame: Frame) -> View:
    """Luma and depth of a frame along the directions; luma 0 is out of its picture."""
    camera = frame.camera
    height, width = (
        max(1, round(n / (f * _STEP)))
        for n, f in ((camera.height, camera.fy), (camera.width, camera.fx))
    )
    luma = frame.color.float().mean(dim=-1)
    depth = frame.depth_mm.float() * MILLIMETRE / _DEPTH_UNIT
    parts = torch.stack([luma, depth, (depth > 0).float()])
    blurred = adaptive_avg_pool2d(parts, (height, width))
    x = _STEP * (torch.arange(_COLUMNS) - (_COLUMNS - 1) / 2)
    y = _STEP * (torch.arange(_ROWS) - (_ROWS - 1) / 2)
    u = 2 * (camera.fx * x + camera.cx) / camera.width - 1
    v = 2 * (camera.fy * y + camera.cy) / camera.height - 1
    at = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    luma, depth, share = grid_sample(blurred[None], at[None], align_corners=False)[0]
    inside = (at.abs() < 1).all(dim=-1)
    depth = torch.where(share > 0.5, depth / share.clamp(min=0.5), 0)
    return torch.stack([luma.clamp(1, 255) * inside, depth.clamp(0, 255)]).round().byte()


def spread_out(T_world_camera: Poses, n: int = _MAX_VIEWS) -> np.ndarray:
    """Numbers of so many poses, spread by place and direction: each the farthest from those before.
    """
    places = np.concatenate([T_world_camera[:, :3, 3], _RADIAN * T_world_camera[:, :3, 2]], axis=1)
    chosen, apart = [0], np.full(len(places), np.inf)
    while len(chosen) < min(n, len(places)):
        apart = np.minimum(apart, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return np.array(chosen)


def likeliest(view: View, views: UInt8[Tensor, "n 2 rows columns"], T_world_camera: Poses, n: int) -> Poses:
    """Where a camera may be that saw a view: the poses of those most like it, turned as they fit.

    Unlikeness is that of luma, whose mean and contrast may differ, plus that of depths.
    """
    unlikeness, turned = [], []
    seen = view.float()
    for across in range(-_TURNS[0], _TURNS[0] + 1, _TURN_STEP):
        for down in range(-_TURNS[1], _TURNS[1] + 1, _TURN_STEP):
            here = seen[:, max(0, down): _ROWS + min(0, down), max(0, across): _COLUMNS + min(0, across)]
            there = views[:, :, max(0, -down): _ROWS - max(0, down), max(0, -across): _COLUMNS - max(0, across)].float()
            unlikeness.append(_unlikeness(here, there))
            turned.append(Rotation.from_rotvec(_STEP * np.array([down, -across, 0])).as_matrix())
    unlikeness = torch.stack(unlikeness)  # a row a turn
    best, turn = unlikeness.min(dim=0)
    order = best.argsort()[:n].numpy()
    poses = T_world_camera[order].copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ np.stack(turned)[turn[order].numpy()]
    return poses


def _unlikeness(here, there):
    has_luma = (here[0] > 0) & (there[:, 0] > 0)
    count = has_luma.sum(dim=(1, 2)).clamp(min=1)
    a, b = here[0] * has_luma, there[:, 0] * has_luma
    mean_a, mean_b = a.sum(dim=(1, 2)) / count, b.sum(dim=(1, 2)) / count
    cov = (a * b).sum(dim=(1, 2)) / count - mean_a * mean_b
    var = ((a**2).sum(dim=(1, 2)) / count - mean_a**2) * ((b**2).sum(dim=(1, 2)) / count - mean_b**2)
    luma = 1 - cov / var.clamp(min=1e-3).sqrt()
    has_depth = (here[1] > 0) & (there[:, 1] > 0)
    ratio = (here[1].clamp(min=1) / there[:, 1].clamp(min=1)).log().abs().clamp(max=_MAX_LOG_RATIO) / _MAX_LOG_RATIO
    count = has_depth.sum(dim=(1, 2))
    depth = (ratio * has_depth).sum(dim=(1, 2)) / count.clamp(min=1)
    depth = torch.where(count > 0.1 * _COLUMNS * _ROWS, depth, 1)
    return luma + 2 * depth
