"""Where the frames of a map have measured surfaces: a coarse grid of yes and no.

A field says something everywhere. What it says of places that no frame has shown is invention,
and says nothing about whether the map belongs to a scene.
"""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nbtrack.core.bounds import SceneBounds
from nbtrack.core.camera import backproject
from nbtrack.core.geometry import transform_points
from nbtrack.data.sequence import RgbdSequence

SEEN_VOXEL = 0.2  # m: a room takes some kilobytes
_PIXELS_A_SIDE = 80  # of a frame, at most


@dataclass(frozen=True)
class SeenVolume:
    """Which cells of a grid that starts at the bounds' lower corner hold a measured point."""

    origin_world: tuple[float, ...]
    cells: Bool[Tensor, "nx ny nz"]

    def contains(self, points_world: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether points (m) lie in cells where something was measured."""
        where = _cell_of(points_world, self.origin_world)
        size = torch.tensor(self.cells.shape)
        is_inside = ((where >= 0) & (where < size)).all(dim=-1)
        clamped = torch.minimum(where.clamp_min(0), size - 1)
        return is_inside & self.cells[tuple(clamped.unbind(-1))]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON: one bit a cell, as base64."""
        bits = np.packbits(self.cells.numpy())
        return {
            "origin_world": list(self.origin_world),
            "shape": list(self.cells.shape),
            "bits": base64.b64encode(bits.tobytes()).decode("ascii"),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "SeenVolume":
        """What `to_dict` gave. Raises ValueError or another where it is not that."""
        bits = np.frombuffer(base64.b64decode(content["bits"], validate=True), np.uint8)
        shape = tuple(int(n) for n in content["shape"])
        origin = tuple(float(value) for value in content["origin_world"])
        n_cells = int(np.prod(shape))
        if not (len(shape) == len(origin) == 3 and 0 < n_cells <= 8 * len(bits)):
            raise ValueError(f"a grid of {shape} does not fit its {len(bits)} bytes")
        cells = np.unpackbits(bits, count=n_cells).astype(bool).reshape(shape)
        return cls(origin, torch.from_numpy(cells))


def seen_volume(
    sequence: RgbdSequence, frames: Int[np.ndarray, "frames"], bounds: SceneBounds
) -> SeenVolume:
    """The cells inside the bounds in which some of a sequence's frames measured a point."""
    low, high = torch.tensor(bounds.minimum), torch.tensor(bounds.maximum)
    shape = ((high - low) / SEEN_VOXEL).floor().int() + 1
    volume = SeenVolume(bounds.minimum, torch.zeros(*shape.tolist(), dtype=torch.bool))
    intrinsics = sequence.intrinsics
    stride = max(1, max(intrinsics.width, intrinsics.height) // _PIXELS_A_SIDE)
    rows, columns = torch.meshgrid(
        torch.arange(0, intrinsics.height, stride), torch.arange(0, intrinsics.width, stride),
        indexing="ij",
    )  # fmt: skip
    for index in frames.tolist():
        depth = torch.from_numpy(sequence.depth(index))[rows, columns]
        measured = depth > 0
        points = backproject(intrinsics, columns[measured], rows[measured], depth[measured])
        T_world_camera = torch.from_numpy(sequence.T_world_camera[index]).float()
        points = transform_points(T_world_camera, points)
        where = _cell_of(points[bounds.contain(points)], volume.origin_world)
        volume.cells[tuple(where.unbind(-1))] = True
    return volume


def _cell_of(
    points_world: Float[Tensor, "n 3"], origin_world: tuple[float, ...]
) -> Int[Tensor, "n 3"]:
    return ((points_world - torch.tensor(origin_world)) / SEEN_VOXEL).floor().long()
