"""How far points are from the nearest surface that any frame has measured."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import backproject
from nbtrack.data.sequence import RgbdSequence

_LEAST_VOXEL = 0.05  # m; finer cells hold too few points to tell a surface from noise
_MOST_CELLS_A_SIDE = 256  # so that a large scene takes no more than some 60 MB
_LEAST_POINTS = 3  # measured points that make a cell part of a surface: single ones are noise
_POINTS_PER_FRAME = 10_000


class ObservedDistance:
    """Unsigned distance from the observed surface, on a grid over the scene's bounds.

    Cells that hold measured points are the surface; an exact Euclidean distance transform gives
    every other cell its distance from the nearest of them, and points between cell centres are
    interpolated. It is true to about a cell: for free space, not for the surface itself.
    """

    def __init__(
        self,
        sequence: RgbdSequence,
        frames: Int[np.ndarray, "frames"],
        bounds: SceneBounds,
        device: torch.device,
    ) -> None:
        self.voxel = max(_LEAST_VOXEL, 2 * bounds.metres_per_unit / _MOST_CELLS_A_SIDE)
        low, high = np.array(bounds.minimum), np.array(bounds.maximum)
        shape = np.ceil((high - low) / self.voxel).astype(int) + 1
        counts = np.zeros(shape.prod(), dtype=np.int64)
        for points_world in _observed_points(sequence, frames):
            cells = np.floor((points_world - low) / self.voxel).astype(int)
            inside = ((cells >= 0) & (cells < shape)).all(axis=1)
            flat = np.ravel_multi_index(cells[inside].T, shape)
            counts += np.bincount(flat, minlength=len(counts))
        # A short recording must not lose its surfaces to the demand for several points.
        is_surface = counts >= min(_LEAST_POINTS, counts.max())
        distance = distance_transform_edt(~is_surface.reshape(shape), sampling=self.voxel)
        self.distance = torch.from_numpy(distance.astype(np.float32)).to(device)
        self.low = torch.tensor(low, dtype=torch.float32, device=device)

    def __call__(self, points_world: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Distance (m) at points (m, world frame); outside the grid that of its border."""
        shape = torch.tensor(self.distance.shape, device=points_world.device)
        position = (points_world - self.low) / self.voxel - 0.5
        position = position.clamp_min(0).minimum((shape - 1).float() - 1e-3)
        # grid_sample takes x, y, z of a volume indexed z, y, x, from -1 to 1.
        normalized = (2 * position / (shape - 1) - 1).flip(-1)
        sampled = torch.nn.functional.grid_sample(
            self.distance[None, None], normalized[None, None, None], align_corners=True
        )
        return sampled.flatten()


def _observed_points(
    sequence: RgbdSequence, frames: Int[np.ndarray, "frames"]
) -> Iterator[Float[np.ndarray, "n 3"]]:
    """World points (m) of each frame, on a regular grid of its pixels."""
    intrinsics = sequence.intrinsics
    stride = max(1, round((intrinsics.width * intrinsics.height / _POINTS_PER_FRAME) ** 0.5))
    rows, columns = torch.meshgrid(
        torch.arange(0, intrinsics.height, stride),
        torch.arange(0, intrinsics.width, stride),
        indexing="ij",
    )
    for index in frames.tolist():
        depth = torch.from_numpy(sequence.depth(index))[rows, columns]
        seen = depth > 0
        points_camera = backproject(intrinsics, columns[seen], rows[seen], depth[seen]).numpy()
        T_world_camera = sequence.T_world_camera[index]
        yield points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
